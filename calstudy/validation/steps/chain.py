"""Steps 4.0 and 4.1: the whole chain, from the sky to the power spectrum.

Step 4.0: recovery of the EoR in each bin, from the sky to the power spectrum.

Pulls (P^R - P^S) / sigma outside wedge and buffer are computed with two definitions of sigma: the paper's error bar
sigma_N + sigma_S, and the error of the difference, without the sample variance that P^R and P^S share
(`calstudy.power.spectra.SphericalSpectrum.difference_error`). The second is the more severe. P^R / P^S is reported as
it is, and without the flux scale s of the fit, by whose square P^R is divided.

Step 4.1: the signal-loss budget: the part of the EoR that each stage removes, per band of k.

The spectrum of the EoR alone is followed through the chain, with each entry in units of the input:

- *sky*: P_in - P of the middle integration by itself, without taper: this sky is a sample;
- *averaging*: all integrations averaged without fringe stopping: fringes wash out;
- *fringe-stop*: the gain from stopping the fringes first;
- *taper*: the window instead of none;
- *calibration*: absorption by the fit: the EoR is replaced by T s^2 of it, the response D of the residual
  (`calstudy.power.transfer`) without the flux scale s;
- *flux-scale*: the effect of the flux scale of the fit: T in place of T s^2;
- *mask*: modes outside the wedge in place of all modes of the band;
- *left*: the residual without EoR, noise and foregrounds, which is in P^R but is no signal (negative).

Each stage starts from the power that the one before leaves, so that the sum is P_in less the power of the response D
less that of the residual without EoR, whatever the single entries are. It must agree with the end-to-end loss, P_in -
P^R of the whole chain: the difference is the cross term of the EoR's response and the residual without EoR. Its mean is
zero, and its error comes from leaving out antennas (`calstudy.power.clusters`). The budget itself is reported.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from calstudy.base.table import Table
from calstudy.base.visibilities import from_cube, to_cube
from calstudy.claims.bins import recovered, used_bins
from calstudy.experiment.model import Variant
from calstudy.instrument.beams import make_beam
from calstudy.power.average import fringe_stop_and_average
from calstudy.power.clusters import Clusters
from calstudy.power.interface import estimate_spectra
from calstudy.power.spectra import DelaySpectra, outside_wedge, skies
from calstudy.power.transfer import BANDS
from calstudy.products import corruption, signal_loss, spectra
from calstudy.products.files import DATA, read_visibilities
from calstudy.products.graph import Graph
from calstudy.run.task import Task
from calstudy.validation.step import MINREDUNDANT, REDUNDANT, Findings, Limit, Step, StepInput, largest, required
from calstudy.verdicts.criterion import AtLeast, AtMost, Finding

SIGMAS = 2
EXPECTED = 0.954
"""Fraction of a normal distribution within two sigma."""


class EndToEnd(Step):
    """The fraction of the bins of every experiment with a pull within two sigma, for both definitions of sigma."""

    kind: str = "end-to-end"
    version: ClassVar[int] = 2
    number = "4.0"
    proves = "P^R recovers P^S outside wedge and buffer, on both arrays"
    experiments: ClassVar = {"minredundant": MINREDUNDANT, "redundant": REDUNDANT}
    limits: ClassVar = {
        "minredundant_bars": Limit(
            "minimally redundant array, fraction of bins with |P^R - P^S| within 2 sigma; sigma of the paper (sigma_N "
            "+ sigma_S)",
            AtLeast(0.9),
            "95 % are expected; 10 % may miss",
        ),
        "redundant_bars": Limit("redundant array, the same", AtLeast(0.9), "as above"),
        "minredundant_difference": Limit(
            "minimally redundant array, the same with the error of the difference, since both contain the same EoR",
            AtLeast(0.9),
            "as above; stricter, because the paper's error bars contain sample variance that both share",
        ),
        "redundant_difference": Limit("redundant array, the same", AtLeast(0.9), "as above"),
    }

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        transfer = signal_loss.transfer(graph)
        return {"spectra": spectra.spectra(graph), **({} if transfer is None else {"transfer": transfer})}

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        values, remarks = {}, []
        for name, run in runs.items():
            residual, signal = (run.spherical(variant, "outside-wedge") for variant in ("residual", "eor"))
            # A bin without a number in the residual is a miss.
            used = used_bins(signal)
            difference = (residual.power - signal.power).real[used]
            for reading, error in (("bars", residual.error), ("difference", residual.difference_error)):
                within = np.abs(difference / error[used]) <= SIGMAS
                sampling = np.sqrt(EXPECTED * (1 - EXPECTED) / within.size)
                values[f"{name}_{reading}"] = Finding(float(within.mean()), float(sampling))
            ratio = recovered(residual, signal, 0.0)
            values[f"{name}_ratio"] = ratio
            remarks.append(f"{name}: {_ratio_sentence(ratio, int(used.sum()), run.flux_scale)}")
        return Findings(values, tuple(remarks))


def _ratio_sentence(ratio: Finding, n_bins: int, scale: float | None) -> str:
    text = f"P^R / P^S = {ratio.value:.3f} ± {ratio.uncertainty:.3f} in {n_bins} bins"
    if scale is None:
        return f"{text}; the flux scale is not known"
    free = f"{scale**2 * ratio.value:.3f} ± {scale**2 * ratio.uncertainty:.3f}"
    return f"{text}; without the flux scale, {scale:.3f}: {free}"


STAGES = ("sky", "averaging", "fringe-stop", "taper", "calibration", "flux-scale", "mask", "left")


@dataclass(frozen=True)
class Band:
    """The budget of one band of k (h/Mpc), in units of P_in.

    `losses` are those of the `STAGES`, and `total` is their sum. `measured` is 1 - P^R / P_in, with the error of its
    difference from the sum.
    """

    low: float
    high: float
    losses: tuple[float, ...]
    total: float
    measured: Finding

    @property
    def pull(self) -> float:
        """Difference of sum and end-to-end loss in units of its error."""
        return (self.measured.value - self.total) / self.measured.uncertainty


class SignalLossBudget(Step):
    """The largest pull of any band of k, for every experiment."""

    kind: str = "signal-loss-budget"
    version: ClassVar[int] = 2
    number = "4.1"
    proves = "P^R is P^D and the residual without EoR, with no cross term"
    experiments: ClassVar = {"minredundant": MINREDUNDANT, "redundant": REDUNDANT}
    sections: ClassVar = ("instrument", "power", "sky")
    limits: ClassVar = {
        "minredundant_worst_pull": Limit(
            "minimally redundant array, |P^R - P^D - P^R without EoR| in sigma; largest value of all bands of k",
            AtMost(3),
            "within the errors; 3 sigma, for the largest of four bands",
        ),
        "redundant_worst_pull": Limit("redundant array, the same", AtMost(3), "as above"),
    }

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        eor = Variant(components=("eor",))
        transfer = required(signal_loss.transfer(graph), "the variants of signal loss")
        return {
            "levels": corruption.levels(graph),
            "data": corruption.data(graph, eor, "even"),
            "eor": spectra.variant_power(graph, "eor", eor),
            "residual": spectra.power(graph, "residual"),
            "left": spectra.power(graph, "residual_without_eor"),
            "transfer": transfer,
            "response": transfer.inputs["response"],
        }

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        values, remarks, rows = {}, [], []
        for name, run in runs.items():
            bands = budget(run)
            rows += [
                (name, band.low, band.high, *band.losses, band.total, band.measured.value, band.measured.uncertainty)
                for band in bands
            ]
            values[f"{name}_worst_pull"] = Finding(largest(abs(band.pull) for band in bands), 1.0)
            remarks += [f"{name}: {_band_sentence(band)}" for band in bands]
        columns = ("experiment", "k from [h/Mpc]", "k to [h/Mpc]", *STAGES, "sum", "end to end", "error")
        Table(columns, rows).write_csv(output / "signal_loss_budget.csv")
        return Findings(values, tuple(remarks))


def _band_sentence(band: Band) -> str:
    parts = ", ".join(f"{stage} {100 * loss:.1f} %" for stage, loss in zip(STAGES, band.losses, strict=True))
    return (
        f"k from {band.low:g} to {band.high:g} h/Mpc: {parts}; sum {100 * band.total:.1f} %, end to end "
        f"{100 * band.measured.value:.1f} ± {100 * band.measured.uncertainty:.1f} %"
    )


def budget(run: StepInput) -> list[Band]:
    """Return the budget of one experiment, band by band."""
    settings = run.experiment.power
    followed = [*_before_calibration(run), run.delay_spectra("eor")]
    response, residual, left = (run.delay_spectra(product) for product in ("response", "residual", "left"))
    # Without a known flux scale, its share is reported as loss of the calibration.
    scale = run.flux_scale or 1.0
    outside = outside_wedge(response, settings.wedge_buffer)
    k = np.hypot(response.k_perp[:, None], response.k_parallel)
    bands = []
    for low, high in itertools.pairwise(BANDS):
        inside = (k > low) & (k <= high)
        both = inside & outside
        if not both.any():
            continue
        put_in = float(run.input_power(np.array((low + high) / 2)))
        after, kept, rest = (
            _mean(modes, used).value / put_in for modes, used in ((response, inside), (response, both), (left, both))
        )
        earlier = (_mean(modes, inside).value / put_in for modes in followed)
        powers = [1.0, *earlier, after * scale**2, after, kept, kept + rest]
        losses, total = tuple(one - other for one, other in itertools.pairwise(powers)), 1 - powers[-1]
        difference = _mean(residual, both, minus=(response, left))
        measured = Finding(total - difference.value / put_in, difference.uncertainty / put_in)
        bands.append(Band(low, high, losses, total, measured))
    return bands


def _mean(modes: DelaySpectra, used: np.ndarray, minus: Sequence[DelaySpectra] = ()) -> Finding:
    """Return the mean power of the chosen modes, each once per pair, and its error by leaving out antennas."""
    bins = np.where(used, 0, -1)
    clusters = Clusters.of(modes, bins, np.broadcast_to(skies(modes)[0][:, None], bins.shape), 1)
    power = clusters.powers(modes)
    for other in minus:
        power = power - clusters.powers(other)
    value, error = power.ratio(clusters.counts)
    return Finding(float(value[0]), float(error[0]))


def _before_calibration(run: StepInput) -> list[DelaySpectra]:
    """Return the EoR's spectra without taper: one integration, the plain average, the fringe-stopped average."""
    data = read_visibilities(run.products["data"] / DATA)
    stopped, cube = fringe_stop_and_average(data), to_cube(data)
    versions = [
        from_cube(stopped, values[None].astype(complex)) for values in (cube[len(cube) // 2], cube.mean(axis=0))
    ]
    settings = run.experiment.power.model_copy(update={"taper": "none"})
    instrument = run.experiment.instrument
    beam = make_beam(instrument.beam, instrument.channels)
    return [estimate_spectra(version, version, beam, settings) for version in (*versions, stopped)]
