"""Steps 2.3 to 3.0: calibration of noisy data with flags, with errors of its gains, and of effects below the noise.

Step 2.3: flagged samples must have no influence, and the others must be calibrated without bias.

*influence*: the data are calibrated twice, with different values under the flags; the largest difference of any gain,
model or residual must be exactly zero.

*bias*: foregrounds and noise are calibrated for two realizations of the noise. The part that both residuals share is
not noise: the mean of Re R_even* R_odd over unflagged samples, in units of its standard error (each baseline one
sample), is the residual of the foregrounds due to gain errors.

Step 2.4: as many gains are within their errors of the true ones as should be.

Deviations from the true gains, without what no fit can know, in units of their errors by noise; both noise realizations
of every integration are realizations of the noise.

Step 3.0: reflections below the noise of a baseline, which the calibration must remove.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field
from pyuvdata import UVData

from calstudy.base.visibilities import flag_cube, to_cube
from calstudy.calibrate.agreement import ALLOWED, PARTS, pooled
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.interface import Calibrator
from calstudy.calibrate.records import CalibrationResult
from calstudy.claims.bins import at_reflections
from calstudy.experiment.model import Variant
from calstudy.products import corruption, simulation, spectra
from calstudy.products.corruption import PARITIES
from calstudy.products.files import DATA, VISIBILITIES, read_visibilities
from calstudy.products.gain_errors import gain_coverage, read_coverage
from calstudy.products.graph import Graph
from calstudy.run.task import Task
from calstudy.validation.step import (
    MINREDUNDANT,
    Case,
    Findings,
    Limit,
    Step,
    StepInput,
    largest,
    mean_over,
    only,
    required,
)
from calstudy.validation.steps.single_fit import first_integrations
from calstudy.verdicts.criterion import AtLeast, AtMost, Finding, Within

HUGE = 1e6
VARIANT = Variant(components=("foregrounds", "noise"), effects=True, calibrate=True)


class Flags(Step):
    """The largest influence, and the largest bias in sigma, of all patterns of flags."""

    kind: str = "flags"
    version: ClassVar[int] = 2
    number = "2.3"
    proves = "flagged data (single channels, bands, 30 % at random) have no influence, and the residual is unbiased"
    experiments: ClassVar = {"minredundant": MINREDUNDANT}
    sections: ClassVar = ("calibration",)
    parameters: ClassVar = {"integrations": 4}
    small_parameters: ClassVar = {"integrations": 1}
    limits: ClassVar = {
        "influence": Limit(
            "largest change of any gain, model or residual if flagged data have other values (1e6, NaN)",
            AtMost(0),
            "the influence must be exactly zero",
        ),
        "bias": Limit(
            "|mean Re R_even* R_odd| without EoR, in standard errors; largest value of all patterns",
            AtMost(2),
            "a part common to both realizations is not noise; 2 sigma, at small scale 3 for a single integration",
            small=AtMost(3),
        ),
    }

    integrations: int = Field(1, ge=1, description="How many are calibrated, the first ones.")

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        data = {parity: corruption.data(graph, VARIANT, parity) for parity in PARITIES}
        return {"foregrounds": required(simulation.foregrounds(graph), "foregrounds"), **data}

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        run = only(runs)
        settings = run.experiment.calibration
        data = {parity: self._read(run.products[parity] / DATA) for parity in PARITIES}
        sky = self._read(run.products["foregrounds"] / VISIBILITIES)
        influences, biases, remarks = [], {}, []
        for pattern, flags in patterns(data["even"]).items():
            results = {parity: run_calibrator(settings, flagged(uvd, flags), sky) for parity, uvd in data.items()}
            influences.append(_influence(data["even"], flags, results["even"], settings, sky))
            biases[pattern] = bias(results["even"].residual, results["odd"].residual)
            statuses = {record.status for result in results.values() for record in result.solutions}
            remarks.append(
                f"{pattern} ({100 * flags.mean():.0f} % flagged): bias {biases[pattern].value:.2f} sigma, "
                f"{', '.join(sorted(statuses))}"
            )
        worst = largest(abs(finding.value) for finding in biases.values())
        values = {"influence": Finding(largest(influences), 0.0), "bias": Finding(worst, 1.0)}
        return Findings(values, tuple(remarks))

    def _read(self, path: Path) -> UVData:
        return first_integrations(read_visibilities(path), self.integrations)


def patterns(data: UVData) -> dict[str, np.ndarray]:
    """Return the patterns of flags, (Ntimes, Nbls, Nfreqs) each: single channels, bands, 30 % at random."""
    shape = to_cube(data).shape[:3]
    single, bands = np.zeros(shape, bool), np.zeros(shape, bool)
    single[..., [shape[2] // 5, shape[2] // 2, (4 * shape[2]) // 5]] = True
    for start in (shape[2] // 4, (2 * shape[2]) // 3):
        bands[..., start : start + max(2, shape[2] // 32)] = True
    random = np.random.default_rng(7).random(shape) < 0.3
    return {"single channels": single, "bands": bands, "30 % at random": random}


def flagged(data: UVData, flags: np.ndarray, value: complex | None = None) -> UVData:
    """Return a copy of data with additional flags, (Ntimes, Nbls, Nfreqs), and `value` (Jy) under them if given."""
    changed = data.copy()
    flag_cube(changed)[flags] = True
    if value is not None:
        to_cube(changed)[flags] = value
    return changed


def _influence(data: UVData, flags: np.ndarray, result: CalibrationResult, settings: Calibrator, sky: UVData) -> float:
    changes = []
    for value in (HUGE * (1 + 2j), complex(np.nan, np.nan)):
        other = run_calibrator(settings, flagged(data, flags, value), sky)
        changes += [np.abs(mine - its).max() for mine, its in zip(_arrays(result), _arrays(other), strict=True)]
    return largest(changes)


def _arrays(result: CalibrationResult) -> tuple[np.ndarray, ...]:
    return result.gains.gain_array, result.model.data_array, result.residual.data_array


def bias(even: UVData, odd: UVData) -> Finding:
    """Return the mean of Re R_even* R_odd over unflagged samples in units of its standard error."""
    used = ~(flag_cube(even) | flag_cube(odd))
    product = (to_cube(even).conj() * to_cube(odd)).real
    # One sample per baseline: its times and channels share gains and model.
    found = mean_over(*(cube.transpose(1, 0, 2, 3).reshape(cube.shape[1], -1) for cube in (product, used)))
    return Finding(found.value / found.uncertainty, 1.0)


NAMES = ("within_1", "within_2")
MANY = {"instrument.times.count": 20, "calibration.weights": "gains", "sky.eor.nside": 64}
FEW = {"instrument.times.count": 12, "calibration.weights": "gains"}

FAILING = (
    "errors that are 7 % too small or too large fail",
    "errors that are 8 % too small or 11 % too large fail",
)
"""What the limits find, for 1 and 1.96 errors."""


class GainErrors(Step):
    """The fractions of amplitudes and phases within 1 and 1.96 errors, of `calamity`."""

    kind: str = "gain-errors"
    number = "2.4"
    proves = "the errors of the gains by noise cover the deviations from the true gains"
    # The member calamity of gain-errors.yaml, whose products it has.
    experiments: ClassVar = {"calamity": Case("minredundant.yaml", MANY, small=FEW)}
    limits: ClassVar = {
        f"{part}_{name}": Limit(
            f"fraction of the {part}s of all gains within {sigmas} sigma",
            Within(right - allowed, right + allowed),
            f"{100 * right:.3g} % of a normal distribution; {why}",
        )
        for part in PARTS
        for name, sigmas, (right, allowed), why in zip(NAMES, ("1", "1.96"), ALLOWED, FAILING, strict=True)
    }

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        return {parity: gain_coverage(graph, VARIANT, parity) for parity in PARITIES}

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        run = only(runs)
        found = pooled([read_coverage(run.products[parity]) for parity in PARITIES])
        values = {
            f"{part}_{name}": Finding(float(found.within[place, limit]), float(found.within_error[place, limit]))
            for place, part in enumerate(PARTS)
            for limit, name in enumerate(NAMES)
        }
        worst = ", ".join(f"{100 * value:.1f}" for value in found.worst.ravel())
        remark = f"{found.realizations} realizations; of the worst antenna {worst} %"
        return Findings(values, (remark,))


NOISE_SIGMAS = 2


SMALL = {
    "corruption.noise": {"kind": "times-foregrounds", "factor": 0.1},
    "corruption.effects": [
        {"kind": "reflection-gains", "amplitude": 0.1, "delay": "800 ns", "delay_scatter": "50 ns", "seed": 5}
    ],
    "outputs.figures": [],
}


class LowSnr(Step):
    """The remaining artefact at the reflections' delays, outside the wedge.

    With means over those bins, weighted by their inverse noise variance, *left* is |P^R| over 2 sigma of the noise: one
    or less is suppression to the noise.
    """

    kind: str = "low-snr"
    version: ClassVar[int] = 3
    number = "3.0"
    proves = "cable reflections below the noise of a baseline are removed"
    experiments: ClassVar = {"lowsnr": Case("lowsnr.yaml", small=SMALL)}
    sections: ClassVar = ("corruption",)
    limits: ClassVar = {
        "left": Limit(
            "|P^R| at the reflections over 2 sigma of the noise",
            AtMost(1),
            "consistent with the noise",
        ),
        "artefact_sigmas": Limit(
            "P^V at the reflections over sigma of the noise, before calibration",
            AtLeast(10),
            "there must be something to remove: ten times what may be left, 1 sigma",
        ),
    }

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        return {"spectra": spectra.spectra(graph)}

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        run = only(runs)
        # Bins without a number in the residual are not left out.
        artefact, left, sigma = at_reflections(run, run.experiment, "uncalibrated")
        allowed = NOISE_SIGMAS * sigma
        values = {
            "left": Finding(abs(left) / allowed, sigma / allowed),
            "left_sigmas": Finding(left / sigma, 1.0),
            "artefact_sigmas": Finding(artefact / sigma, 1.0),
        }
        remark = f"artefact {artefact / sigma:.1f} sigma of the noise before calibration, {left / sigma:.1f} after"
        return Findings(values, (remark,))
