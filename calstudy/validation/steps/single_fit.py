"""Steps 2.0 and 2.1: the fit of one integration, where a perfect one exists and along its degeneracies.

Step 2.0: noiseless data whose foregrounds lie in the basis: the product of gains and model must equal the data.

The foregrounds are the simulated ones projected on the fit's basis, so that a perfect fit exists. In single precision
the data are rounded to complex64, as stored data are, and the solver is that of the experiment. In double precision the
data are not rounded, and the solver also has double precision and continues until its residual is at rounding.

Step 2.1: directions of gains and foregrounds to which the data are insensitive.

Each of these exchanges leaves g_a g_b* F_ab, and so the likelihood, unchanged:

- *phase*: g_a -> g_a exp(i phi(nu)), any phase in every channel, the same for all antennas;
- *scale*: g_a -> g_a sqrt(s), F -> F / s;
- *tilt*: g_a -> g_a exp(i k.x_a), F_ab -> F_ab exp(i k.(x_b - x_a)): a shift of the sky;
- *smooth*: g_a -> g_a s_a(nu), F_ab -> F_ab / (s_a s_b*), with s_a so smooth that the model stays within its basis.

Two statements are measured, on noisy data:

- at the true gains: the misfit V - g_a g_b* F with the best F of the basis is the same after the exchange (*exact*).
  For the smooth exchange the true foregrounds are those of a narrower basis, without the buffer;
- the fit: started from gains moved along the direction, it ends at the same residual (*fitted*). Phase and scale are
  fixed by convention, so that R = V / (g_a g_b*) - F itself must be the same. Tilt and smooth exchanges are not fixed,
  and R contains their factor; there V - g_a g_b* F, R times the gains by which it was divided, must be the same.

Differences are rms over the rms of the data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field
from pyuvdata import UVCal, UVData

from calstudy.base.errors import InputError
from calstudy.base.gains import make_uvcal
from calstudy.base.observation import Observation
from calstudy.base.visibilities import baseline_vectors, from_cube, to_cube
from calstudy.calibrate.basis import ForegroundBasis, dpss_vectors, make_basis
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.problem import FitStructure, gain_products, make_structure
from calstudy.calibrate.records import CalibrationResult
from calstudy.calibrate.settings import ForegroundFit
from calstudy.corrupt.levels import rms
from calstudy.products import corruption, simulation
from calstudy.products.files import VISIBILITIES, read_visibilities
from calstudy.products.graph import Graph
from calstudy.products.selection import read_gains
from calstudy.run.task import Task
from calstudy.validation.step import MINREDUNDANT, Findings, Limit, Step, StepInput, largest, only, required
from calstudy.verdicts.criterion import AtMost, Finding


def first_integrations(uvd: UVData, count: int = 1) -> UVData:
    """Return the first integrations of a rectangular data set."""
    return uvd.select(blt_inds=np.arange(count * uvd.Nbls), inplace=False, run_check=False)


@dataclass(frozen=True)
class SingleIntegration:
    """One integration of one polarization, and its parts.

    `numbers` are the antenna numbers of the indices in `structure`. `noise_std` is the standard deviation of the
    complex noise of one sample, Jy. `true_gains` are (Nants, Nfreqs), in the order of the fit's antennas.
    """

    foregrounds: UVData
    structure: FitStructure
    numbers: np.ndarray
    settings: ForegroundFit
    noise_std: float
    true_gains: np.ndarray

    @classmethod
    def of(cls, run: StepInput, antennas: int | None, channels: int | None) -> SingleIntegration:
        """Return the first integration of the products "foregrounds", "gains" and "levels" of an experiment.

        Of antennas and channels it has the first ones, or all if None.
        """
        settings = run.experiment.calibration
        if not isinstance(settings, ForegroundFit):
            raise InputError(f"{settings.label}: the measurement needs a calibrator with foregrounds, such as calamity")
        whole = first_integrations(read_visibilities(run.products["foregrounds"] / VISIBILITIES))
        numbers, used = Observation(whole).numbers[:antennas], np.arange(whole.Nfreqs)[:channels]
        foregrounds = whole.select(antenna_nums=numbers, freq_chans=used, inplace=False, run_check=False)
        frame = Observation(foregrounds)
        return cls(
            foregrounds=foregrounds,
            structure=make_structure(frame, settings),
            numbers=frame.numbers,
            settings=settings,
            noise_std=run.levels.noise_std,
            true_gains=read_gains(run.products["gains"]).at(0, frame.numbers)[:, used],
        )

    @property
    def modelled(self) -> np.ndarray:
        """The projection of the foregrounds on the basis of the fit, (Nbls, Nfreqs), which can be fitted exactly."""
        return self.projected(self.structure.basis)

    def projected(self, basis: ForegroundBasis) -> np.ndarray:
        """Return the projection of the foregrounds on a basis, (Nbls, Nfreqs)."""
        cube = to_cube(self.foregrounds)[0, :, :, 0]
        projected = np.empty_like(cube)
        for bucket in basis.buckets:
            projected[bucket.members] = cube[bucket.members] @ bucket.vectors @ bucket.vectors.T
        return projected

    def data(self, visibilities: np.ndarray) -> UVData:
        """Return visibilities, (Nbls, Nfreqs), as a data set."""
        return from_cube(self.foregrounds, visibilities[None, :, :, None])

    def products(self, gains: np.ndarray) -> np.ndarray:
        """Return g_a g_b* of each baseline, (Nbls, Nfreqs)."""
        return gain_products(gains, self.structure.antennas)

    def uvcal(self, gains: np.ndarray) -> UVCal:
        """Return gains, (Nants, Nfreqs), as initial gains for a fit."""
        telescope = self.foregrounds.telescope
        values = np.ones((telescope.Nants, gains.shape[1], 1, 1), complex)
        values[np.searchsorted(telescope.antenna_numbers, self.numbers), :, 0, 0] = gains
        return make_uvcal(self.foregrounds, values)

    def calibrate(
        self,
        visibilities: np.ndarray,
        settings: ForegroundFit | None = None,
        start: np.ndarray | None = None,
        sky_model: bool = True,
    ) -> CalibrationResult:
        """Calibrate visibilities, (Nbls, Nfreqs), Jy, from gains (Nants, Nfreqs) or as the settings say.

        The foregrounds are the sky model, which fixes the scale.
        """
        gains = None if start is None else self.uvcal(start)
        sky = self.foregrounds if sky_model else None
        return run_calibrator(settings or self.settings, self.data(visibilities), sky, gains)

    def misfit(self, result: CalibrationResult, visibilities: np.ndarray) -> np.ndarray:
        """Return V - g_a g_b* F of a result, (Nbls, Nfreqs): the residual in the unit and gauge of the data."""
        gains = result.gains.gain_array[np.searchsorted(result.gains.ant_array, self.numbers), :, 0, 0]
        return visibilities - self.products(gains) * to_cube(result.model)[0, :, :, 0]


class SingleIntegrationStep(Step):
    """Base class of steps that measure on the first integration of the step's single experiment."""

    experiments: ClassVar = {"minredundant": MINREDUNDANT}
    sections: ClassVar = ("calibration",)

    antennas: int | None = Field(None, ge=3, description="How many are used, the first ones; null: all.")
    channels: int | None = Field(None, ge=1, description="How many are used, the first ones; null: all.")

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        return {
            "foregrounds": required(simulation.foregrounds(graph), "foregrounds"),
            "gains": corruption.gains(graph),
            "levels": corruption.levels(graph),
        }

    def integration(self, runs: Mapping[str, StepInput]) -> SingleIntegration:
        return SingleIntegration.of(only(runs), self.antennas, self.channels)


PATIENT = {"precision": "double", "tolerance": 1e-14, "max_steps": 300}


class Noiseless(SingleIntegrationStep):
    """The rms of V - g_a g_b* F over that of V, for both precisions."""

    kind: str = "noiseless"
    number = "2.0"
    proves = "if the foregrounds are inside the basis, the product of gains and model equals the data"
    small_parameters: ClassVar = {"antennas": 10}
    limits: ClassVar = {
        "single": Limit(
            "rms of V - g g* F over rms of V, data in single precision",
            AtMost(1e-5),
            "float32 resolves 6e-8; 1e-5 is a tenth of the EoR",
        ),
        "double": Limit(
            "the same, data in double precision, solved until the solver makes no more progress",
            AtMost(1e-9),
            "float64 resolves 1e-16; a solver that reaches the minimum has no floor near the EoR",
        ),
    }

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        integration = self.integration(runs)
        exact = integration.products(integration.true_gains) * integration.modelled
        patient = integration.settings.solver.model_copy(update=PATIENT)
        cases = {
            "single": (exact.astype(np.complex64).astype(complex), integration.settings),
            "double": (exact, integration.settings.model_copy(update={"solver": patient})),
        }
        values, remarks = {}, []
        for precision, (visibilities, settings) in cases.items():
            result = integration.calibrate(visibilities, settings)
            values[precision] = Finding(rms(integration.misfit(result, visibilities)) / rms(visibilities), 0.0)
            record = result.solutions[0]
            remarks.append(f"{precision}: {record.status} after {record.steps} steps: {record.message}")
        return Findings(values, tuple(remarks))


SMALLEST_TOLERANCE = 1e-13
"""Tolerance of the solver: residuals should agree to 1e-6 of the data, far below the noise."""
SMOOTH_DELAY = 10e-9
"""Largest delay of a smooth exchange, s: inside the buffer of the basis."""


class Degeneracies(SingleIntegrationStep):
    """The largest difference of any exchange, before and after a fit."""

    kind: str = "degeneracies"
    version: ClassVar[int] = 2
    number = "2.1"
    proves = (
        "overall phase, scale, tip-tilt and exchanges of smooth gains with foregrounds leave the residual unchanged"
    )
    small_parameters: ClassVar = {"draws": 5, "antennas": 10}
    limits: ClassVar = {
        "exact": Limit(
            "rms change of V - g g* F by an exchange at the true gains, over rms V; largest value of all draws and "
            "kinds",
            AtMost(1e-6),
            "the exchanges are exact; 1e-6 is far below noise and EoR",
        ),
        "fitted": Limit(
            "rms change of the fitted residual when the fit starts along a degenerate direction, over rms V; largest "
            "value of all kinds",
            AtMost(1e-6),
            "the fit must end with the same residual, wherever along the degeneracy it starts",
        ),
    }

    draws: int = Field(20, ge=1, description="Random exchanges of each kind.")

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        integration, rng = self.integration(runs), np.random.default_rng(20220422)
        gains = integration.true_gains
        noise = integration.noise_std * (rng.standard_normal((2, *integration.modelled.shape)) / np.sqrt(2))
        visibilities = integration.products(gains) * narrow_model(integration) + noise[0] + 1j * noise[1]
        solver = integration.settings.solver.model_copy(update={"tolerance": SMALLEST_TOLERANCE})
        settings = integration.settings.model_copy(update={"solver": solver})
        reference = integration.calibrate(visibilities, settings)
        before = best_misfit(integration, visibilities, gains)
        exact, fitted, remarks = {}, {}, []
        for kind, draw in EXCHANGES.items():
            changes = []
            for _ in range(self.draws):
                after = best_misfit(integration, visibilities, gains * draw(integration, rng))
                changes.append(rms(after - before) / rms(visibilities))
            exact[kind] = largest(changes)
            moved = integration.calibrate(visibilities, settings, start=draw(integration, rng))
            change = residual(integration, kind, moved, visibilities) - residual(
                integration, kind, reference, visibilities
            )
            fitted[kind] = rms(change) / rms(visibilities)
            record = moved.solutions[0]
            remarks.append(
                f"{kind}: exact {exact[kind]:.1e}, fitted {fitted[kind]:.1e} ({record.status}, {record.steps} steps)"
            )
        remarks.append(f"noise {integration.noise_std / rms(visibilities):.1e} of the data")
        values = {"exact": largest(exact.values()), "fitted": largest(fitted.values())}
        values |= {f"fitted_{kind}": value for kind, value in fitted.items()}
        return Findings({name: Finding(value, 0.0) for name, value in values.items()}, tuple(remarks))


def residual(
    integration: SingleIntegration, kind: str, result: CalibrationResult, visibilities: np.ndarray
) -> np.ndarray:
    """Return the residual that an exchange must not change: R if its gauge is fixed, else V - g_a g_b* F."""
    if kind in ("phase", "scale"):
        return to_cube(result.residual)[0, :, :, 0]
    return integration.misfit(result, visibilities)


def narrow_model(integration: SingleIntegration) -> np.ndarray:
    """Return the foregrounds in the basis without its buffer, (Nbls, Nfreqs)."""
    settings = integration.settings.basis.model_copy(update={"buffer": 0.0})
    lengths = np.linalg.norm(baseline_vectors(integration.foregrounds), axis=1)
    return integration.projected(make_basis(lengths, integration.foregrounds.freq_array, settings))


def best_misfit(integration: SingleIntegration, visibilities: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Return V - g_a g_b* F, (Nbls, Nfreqs), with F by linear least squares on the basis for each baseline."""
    products = integration.products(gains)
    misfit = np.empty_like(visibilities)
    for bucket in integration.structure.basis.buckets:
        for baseline in bucket.members:
            design = products[baseline][:, None] * bucket.vectors
            orthonormal, _ = np.linalg.qr(design)
            values = visibilities[baseline]
            misfit[baseline] = values - orthonormal @ (orthonormal.conj().T @ values)
    return misfit


def _phase(integration: SingleIntegration, rng: np.random.Generator) -> np.ndarray:
    phases = rng.uniform(0, 2 * np.pi, integration.structure.n_frequencies)
    return np.exp(1j * np.tile(phases, (integration.structure.n_antennas, 1)))


def _scale(integration: SingleIntegration, rng: np.random.Generator) -> np.ndarray:
    shape = (integration.structure.n_antennas, integration.structure.n_frequencies)
    return np.full(shape, np.exp(rng.uniform(-0.5, 0.5)), complex)


def _tilt(integration: SingleIntegration, rng: np.random.Generator) -> np.ndarray:
    telescope = integration.foregrounds.telescope
    rows = np.searchsorted(telescope.antenna_numbers, integration.numbers)
    east_north = telescope.get_enu_antpos()[rows, :2]
    # At most one turn across 100 m.
    slope = rng.uniform(-1, 1, 2) * 2 * np.pi / 100
    return np.exp(1j * np.tile((east_north @ slope)[:, None], (1, integration.structure.n_frequencies)))


def _smooth(integration: SingleIntegration, rng: np.random.Generator) -> np.ndarray:
    count, n_frequencies = integration.structure.n_antennas, integration.structure.n_frequencies
    width = float(np.diff(integration.foregrounds.freq_array).mean())
    vectors = dpss_vectors(n_frequencies, n_frequencies * width * SMOOTH_DELAY, 0.5)
    coefficients = rng.standard_normal((2, count, vectors.shape[1])) * 0.1 * np.sqrt(n_frequencies)
    return np.exp((coefficients[0] + 1j * coefficients[1]) @ vectors.T / np.sqrt(vectors.shape[1]))


EXCHANGES: dict[str, Callable[[SingleIntegration, np.random.Generator], np.ndarray]] = {
    "phase": _phase,
    "scale": _scale,
    "tilt": _tilt,
    "smooth": _smooth,
}
"""Random factors on the gains, (Nants, Nfreqs)."""
