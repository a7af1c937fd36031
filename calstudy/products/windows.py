"""Windows of a calibrated power spectrum, and the spectrum without what the calibration did to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from calstudy.base.resources import COMPLEX128, Cost
from calstudy.base.table import Table
from calstudy.experiment.model import Experiment, Variant
from calstudy.power.settings import PowerSettings
from calstudy.power.spectra import SphericalSpectrum
from calstudy.power.tables import load_spectrum, save_spectrum
from calstudy.power.transfer import TransferFunction
from calstudy.power.windows import UnbiasedSpectrum, Windows
from calstudy.products import corruption, signal_loss, simulation, spectra
from calstudy.products.corruption import PARITIES
from calstudy.products.expected_loss import NOT_OF_THE_FIT, Solved, baseline_modes, solved, why_no_response
from calstudy.products.files import DATA, VISIBILITIES, spectrum_file
from calstudy.products.graph import Graph, memoize, size_of
from calstudy.products.table import StudyTable
from calstudy.run.task import Input, Task

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from calstudy.power.windows import Responses
    from calstudy.products.expected_loss import Solution

RESPONSES, WINDOWS, UNBIASED = "responses.npz", "windows.h5", "unbiased.outside-wedge.h5"
LARGEST_K = 1.0
"""End of the bins, h/Mpc: calibration acts on every k alike beyond, and each bin costs a response of each fit."""
INTEGRATIONS = 3
"""Number of fits, evenly over the run, of which the responses are averaged."""
OTHER_SEED = 1_000_003
"""What is added to the seed of the EoR, so that the windows know nothing of the EoR in the data."""
NOTE = (
    "Power outside the wedge in mK^2 h^-3 Mpc^3: of the EoR that was put in; estimated from the residual with the "
    "windows of the calibration, for a P(k) that is linear within a bin; and the residual's power over T of a flat EoR. "
    "Bins are missing where the calibration leaves less than half, or not what its linear response leaves. One "
    "standard deviation about the EoR that was put in, for a flux scale that is known; neighbouring bins are correlated."
)


@memoize
def windows(graph: Graph) -> MeasureWindows | None:
    """Return the task of the windows, or None if they cannot be known."""
    experiment = graph.experiment
    if why_no_windows(experiment):
        return None
    eor = experiment.sky.eor
    other = eor.with_defaults("spectrum", "index", "path").model_copy(update={"seed": eor.seed + OTHER_SEED})
    injected = Graph(experiment.model_copy(update={"sky": experiment.sky.model_copy(update={"eor": other})}))
    count = experiment.instrument.times.count
    numbers = min(INTEGRATIONS, count)
    shared: dict[str, Any] = {
        "integrations": [(2 * number + 1) * count // (2 * numbers) for number in range(numbers)],
        "injected": simulation.eor(injected),
        "signal": corruption.data(graph, Variant(components=("eor",)), "even"),
        "power": experiment.power.with_defaults(*NOT_OF_THE_FIT, "length_bin"),
    }
    even, odd = (
        BandResponses(f"responses to bands of k, {parity}", **shared, **solved(graph, parity), temporary=True)
        for parity in PARITIES
    )
    return MeasureWindows(
        "windows of the calibration",
        power=shared["power"],
        even=even,
        odd=odd,
        transfer=signal_loss.transfer(graph),
        spectra=spectra.spectra(graph),
    )


def why_no_windows(experiment: Experiment) -> str:
    """Return why the windows of a calibration cannot be known; empty if they can."""
    if not experiment.measures_signal_loss:
        return "needs the variants residual, residual_without_eor and eor, from which the signal loss is measured"
    if len(bin_edges(experiment.power)) < 3:
        return f"needs two bins of power.bins or more below {LARGEST_K:g} h/Mpc"
    return why_no_response(experiment)


class WindowsTable(StudyTable):
    """The power spectrum without what the calibration did to it."""

    def refusal(self, experiment: Experiment) -> str | None:
        """Return why an experiment cannot have the table."""
        return why_no_windows(experiment) or None

    def products(self, graph: Graph) -> Sequence[Task | None]:
        """Return the product."""
        return [windows(graph)]


class BandResponses(Solved, stage="band-responses", version=1):
    """What some calibrated integrations leave of a simulated EoR in each band of k, and of the EoR in the data."""

    injected: Input
    signal: Input
    integrations: Sequence[int]

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write A, the level of the EoR in each bin, and the amplitudes of all responses outside the wedge.

        Integrations that were not solved in all antennas and channels are left out.
        """
        import numpy as np

        solutions = {number: self.solution(number) for number in self.integrations}
        found = {number: self._responses(one, number) for number, one in solutions.items() if one}
        np.savez(
            output / RESPONSES,
            allow_pickle=False,
            **{f"{name}_{number}": array for number, one in found.items() for name, array in one.items()},
        )
        return {"integrations": list(found)}

    def _responses(self, solution: Solution, integration: int) -> dict[str, np.ndarray]:
        import numpy as np

        from calstudy.calibrate.expected_loss import DelayModes, linear_responses
        from calstudy.power.spectra import outside_wedge
        from calstudy.power.windows import bins_of, parts_in_k, power_in_bins

        delays = DelayModes(solution.frequency, self.power.taper)
        modes = baseline_modes(delays.delay, solution.lengths, float(solution.frequency.mean()), self.power)
        edges = bin_edges(self.power)
        bins, n_bins = bins_of(modes, edges), edges.size - 1
        inside = (bins >= 0) & (bins < n_bins)
        used = outside_wedge(modes, self.power.wedge_buffer) & inside
        signals = [
            self.signal_at(solution, path, integration) for path in (self.injected / VISIBILITIES, self.signal / DATA)
        ]
        k = np.hypot(modes.k_perp[:, None], modes.k_parallel)
        parts = [*parts_in_k(signals[0], k, (edges[1:] + edges[:-1]) / 2), signals[1]]
        answers = linear_responses(solution.problem, solution.gains, solution.model, parts)
        put_in, left = (np.stack([delays.amplitudes(one)[used] for one in found]) for found in (parts, answers))
        whole = delays.amplitudes(signals[0])[inside][None]
        return {
            "bins": bins[used],
            "put_in": power_in_bins(put_in, put_in, bins[used], n_bins),
            "level": power_in_bins(whole, whole, bins[inside], n_bins)[:, 0],
            "left": left,
        }

    def _cost(self) -> Cost:
        size, parts = size_of(self), len(bin_edges(self.power))
        disk = len(self.integrations) * parts * size.baselines * size.channels.count * COMPLEX128
        return replace(self.cost_of(len(self.integrations) * parts), disk=disk)


class MeasureWindows(Task, stage="windows", version=1, cost=Cost(2, disk=1e6)):
    """The windows of a calibration, and the unbiased spectrum."""

    power: PowerSettings
    even: Input
    odd: Input
    transfer: Input
    spectra: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the windows and the spectrum."""
        import numpy as np

        from calstudy.power.windows import unbiased
        from calstudy.power.windows import windows as windows_of

        loss = load_spectrum(self.transfer / spectrum_file(signal_loss.TRANSFER, "outside-wedge"), TransferFunction)
        edges = bin_edges(self.power)
        found = windows_of(edges, self._responses(), loss.scale_free_transfer[: edges.size - 1])
        residual, signal = (
            load_spectrum(self.spectra / spectrum_file(name, "outside-wedge"), SphericalSpectrum)
            for name in ("residual", "eor")
        )
        save_spectrum(output / WINDOWS, found)
        with np.errstate(divide="ignore", invalid="ignore"):
            error = loss.transfer_error / loss.transfer
        save_spectrum(output / UNBIASED, unbiased(found, residual, signal, error, loss.flux_scale))
        return {"bins": int(found.estimated.sum())}

    def _responses(self) -> Responses:
        """Return the mean over the integrations that were solved in both realizations; NaN if there is none."""
        import numpy as np

        from calstudy.power.windows import Responses, power_in_bins

        n_bins = len(bin_edges(self.power)) - 1
        found: list[tuple[np.ndarray, ...]] = []
        with np.load(self.even / RESPONSES) as even, np.load(self.odd / RESPONSES) as odd:
            for number in (name.removeprefix("left_") for name in even if name.startswith("left_") and name in odd):
                bins, left, put_in, level = (even[f"{name}_{number}"] for name in ("bins", "left", "put_in", "level"))
                found.append((put_in, power_in_bins(left, odd[f"left_{number}"], bins, n_bins), level))
        if not found:
            empty = np.full((n_bins, n_bins + 1), np.nan)
            return Responses(empty, empty, empty[:, 0])
        return Responses(*(np.mean(arrays, axis=0) for arrays in zip(*found, strict=True)))

    def shown(self, folder: Path) -> Sequence[Table]:
        """Return the estimated spectrum, a row for each bin that is estimated."""
        found, spectrum = load_spectrum(folder / WINDOWS, Windows), load_spectrum(folder / UNBIASED, UnbiasedSpectrum)
        columns = ("k (h/Mpc)", "put in", "estimated", "over T of a flat EoR", "T of a flat EoR")
        rows = [
            (
                f"{found.bin_edges[bin_]:.2f} to {found.bin_edges[bin_ + 1]:.2f}",
                f"{spectrum.signal[bin_]:.3g}",
                f"{spectrum.power[bin_]:.3g} ± {spectrum.error[bin_]:.2g}",
                f"{spectrum.divided[bin_]:.3g}",
                f"{found.transfer[bin_]:.3f}",
            )
            for bin_ in range(found.k.size)
            if found.estimated[bin_]
        ]
        note = NOTE if rows else f"{NOTE} No bin is left, or no integration was solved in all antennas and channels."
        return [Table(columns, rows, "Power spectrum without the calibration's part", note)]


def bin_edges(power: PowerSettings) -> np.ndarray:
    """Return the edges of the bins, h/Mpc: those of spectra up to `LARGEST_K`."""
    from calstudy.power.binned import make_bin_edges

    edges = make_bin_edges(power.bins)
    return edges[: max(2, int((edges <= LARGEST_K * (1 + 1e-9)).sum()))]
