"""Errors of the gains of a calibration by noise, in its file of gains, and their coverage of the true gains."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.gains import ErrorsOfFile, write_gain_errors
from calstudy.base.kept_arrays import read_arrays
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.visibilities import positions, to_cube
from calstudy.calibrate.agreement import GainCoverage, pulls
from calstudy.calibrate.cost import dimensions_of
from calstudy.calibrate.execution import cost_of
from calstudy.calibrate.gain_errors import MOST_UNKNOWNS, ErrorsInTime, GainErrors
from calstudy.calibrate.gain_realizations import GainRealizations
from calstudy.calibrate.interface import Calibrator
from calstudy.calibrate.settings import RUNAWAY, GainFit, UnityStart
from calstudy.experiment.model import Variant
from calstudy.products import corruption, observed
from calstudy.products.calibration import Calibrated, prepared_fit, read_result, solved
from calstudy.products.files import GAINS, write_json
from calstudy.products.graph import Graph, MeasuredGraph, memoize, size_of
from calstudy.run.task import Input, Task, called

if TYPE_CHECKING:
    from calstudy.calibrate.records import CalibrationResult, Solve


ERRORS = "gain-errors.json"
"""A record for each solve: what its errors mean and how large they are, or `reason`, why there are none."""
LABEL = "errors of gains"
FAR_ABOVE, MODERATE, EVEN = 5.0, 20.0, 2.0
"""|g| over the median of its antenna, the signal to noise below which noise alone can make it, and the unevenness of
the residual above which something else does."""
RAN_AWAY = "the weights, from the gains, do not settle: the gains are lost in noise"
NAMED = 6
"""Largest number of antennas named in a warning."""
OTHER_WEIGHTS = "take `weights: autos` if the data have autocorrelations"
REMEDY = "solve more integrations together (integrations_per_solve), or smooth the gains (smooth_gains)"


class SolvedGains(NamedTuple):
    """The gains of a solve, complex, (Nants, Nfreqs), their places in all gains, and errors or why there are none."""

    rows: np.ndarray
    times: slice
    place: int
    gains: np.ndarray
    errors: GainErrors | str


@memoize
def gain_errors(graph: Graph, variant: Variant, parity: str) -> Task:
    """Return the task of the errors of the gains of a calibration of simulated data."""
    return ErrorsOfGains(LABEL, **solved(graph, variant, parity))


@memoize
def observed_gain_errors(graph: MeasuredGraph, part: str, wanted: bool | int = True) -> Task:
    """Return the task of the errors of the gains of a part of measured data; a number is one of realizations."""
    data, section, calibrator = observed.observed(graph, part), graph.experiment.observed, graph.experiment.calibration
    return ErrorsOfGains(
        LABEL,
        calibration=observed.calibrated(graph, part),
        calibrator=calibrator.with_defaults("assumed"),
        data=data,
        sky_model=data if section.sky_model is not None else None,
        levels=data if calibrator.needs_noise else None,
        realizations=0 if isinstance(wanted, bool) else wanted,
    )


def _without_errors(settings: Calibrator) -> str:
    """Return why no fit of a calibrator has errors by its own matrix; empty if they may."""
    if not isinstance(settings, GainFit):
        return f"{settings.label} is no fit by least squares"
    if settings.smooth_gains is not None:
        return "the gains were smoothed after the fit"
    if settings.baselines is not None and settings.baselines.taper is not None:
        return "weights with a taper are no inverse variances of the noise"
    return ""


class OfSolves(Calibrated):
    """What is made of the errors of the gains of every solve of a calibration."""

    calibration: Input
    calibrator: Calibrator = called("calibration")

    def solves(self, result: CalibrationResult) -> Iterator[SolvedGains]:
        """Yield the gains of every solve with their errors."""
        from calstudy.calibrate.preparation import problem_at

        settings = self.calibrator
        rows, nothing = np.arange(len(result.gains.ant_array)), np.zeros(0)
        reason = _without_errors(settings)
        if reason or not isinstance(settings, GainFit):
            yield from (SolvedGains(rows, slice(0), 0, nothing, reason) for _ in result.solutions)
            return
        # The solution is known, and a start of its own would cost more than the errors.
        settings = settings.model_copy(update={"initial_gains": UnityStart()})
        prepared, cube = prepared_fit(settings, *self.read()), to_cube(result.model)
        rows = positions(result.gains.ant_array, prepared.data.numbers)
        data = prepared.data
        errors = [ErrorsInTime(data.frequencies, data.lengths.max()) for _ in range(data.n_polarizations)]
        for solve in result.solutions:
            times = solve.times
            place = int(np.flatnonzero(result.model.polarization_array == solve.polarization)[0])
            gains = result.solved_gains(solve, rows, place)
            problem = problem_at(prepared, settings, times, place, gains, solve)
            found: GainErrors | str
            if not solve.usable:
                found = "the solve gave no gains"
            elif isinstance(problem, str):
                found = problem
            elif solve.diagnostics.get("weight_change", 0) > RUNAWAY:
                # Weights are equal then, and not the inverse variances.
                found = RAN_AWAY
            else:
                model = cube[times, :, :, place].reshape(problem.visibilities.shape)
                settled = solve.status == "converged"
                found = errors[place].of(problem, gains, model, data.times[times.start], settled)
            yield SolvedGains(rows, times, place, gains, found)

    def _cost(self) -> Cost:
        size = size_of(self)
        matrix = min(2 * size.antennas * size.channels.count, MOST_UNKNOWNS) ** 2 * COMPLEX128
        blocks = size.antennas * (2 * size.channels.count) ** 2 * COMPLEX128 / 2
        # The sequences of the foregrounds of every baseline.
        dimensions = dimensions_of(size, self.calibrator) if isinstance(self.calibrator, GainFit) else None
        sequences = 0.0 if dimensions is None else COMPLEX128 / 2 * dimensions.coefficients * size.channels.count
        memory = LIBRARIES_MEMORY + 3 * matrix + blocks + sequences + 4 * size.samples * COMPLEX128
        return Cost(5 + 1.3e-5 * size.samples, memory, 1e6)


class ErrorsOfGains(OfSolves, stage="gain-errors", version=8):
    """The gains of a calibration with their errors; antennas whose gains are noise are flagged.

    If no solve has errors by its own matrix, they come from fits to this many `realizations` of the noise, unless it is
    zero.
    """

    realizations: int = 0

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the gains with their errors, and a record for each solve."""
        result = read_result(self.calibration)
        errors = np.full((2, *result.gains.gain_array.shape), np.nan)
        records: list[dict[str, Any]] = []
        drowned, smooth_delay = 0, 0.0
        for solve in self.solves(result):
            if isinstance(solve.errors, str):
                records.append({"reason": solve.errors})
                continue
            lost = solve.errors.lost
            drowned += solve.errors.drowned
            smooth_delay = max(smooth_delay, solve.errors.smooth_delay)
            found = np.stack([solve.errors.amplitude, solve.errors.phase])
            found[:, lost] = np.nan
            errors[..., solve.place][:, solve.rows, :, solve.times] = found[..., None]
            result.gains.flag_array[solve.rows[lost], :, solve.times, solve.place] = True
            names = result.gains.ant_array[solve.rows[lost]].tolist()
            both = np.round([solve.errors.signal_to_noise[lost], solve.errors.noise_alone[lost]], 2).T.tolist()
            records.append(solve.errors.summary(solve.gains) | {"lost_antennas": dict(zip(names, both, strict=True))})
        reasons = [record.get("reason") for record in records]
        # Realizations of a fit whose weights run away would not tell its errors either.
        used = self.realizations if all(reasons) and RAN_AWAY not in reasons else 0
        if used:
            errors = GainRealizations(self.calibrator, *self.read(), result, self.realizations).errors()
            # Gains that are given, and not fitted.
            errors[..., ~(errors > 0).any(axis=(0, 1, 2))] = np.nan
            records = [self._by_realizations(result, errors, solve) for solve in result.solutions]
        errors[:, result.gains.flag_array] = np.nan
        result.gains.write_calh5(output / GAINS)
        if np.isfinite(errors).any():
            write_gain_errors(output / GAINS, ErrorsOfFile(errors[0], errors[1], smooth_delay, used))
        write_json(output / ERRORS, {"records": records})
        away = reasons.count(RAN_AWAY)
        warnings = [f"{away} of {len(records)} solves: {RAN_AWAY}; {OTHER_WEIGHTS}; else {REMEDY}"] if away else []
        if self.realizations and None in reasons:
            warnings.append("gains have errors by the fit itself; realizations were not needed, and not made")
        if drowned:
            warnings.append(
                f"{drowned} of {len(records)} solves: the gains of most antennas cannot be told from noise, and none "
                f"is flagged; {REMEDY}"
            )
        warnings += lost_antennas(records)
        unevenness = max((record.get("unevenness", 1.0) for record in records), default=1.0)
        return {"warnings": warnings + lost_in_noise(result.gains.gain_array, errors[0], unevenness)}

    def _by_realizations(self, result: CalibrationResult, errors: np.ndarray, solve: Solve) -> dict[str, Any]:
        """Return the record of a solve whose errors are from realizations."""
        place = int(np.flatnonzero(result.model.polarization_array == solve.polarization)[0])
        at = (slice(None), slice(None), solve.times, place)
        if not np.isfinite(errors[0][at]).any():
            flagged = result.gains.flag_array[at].all()
            return {"reason": "all gains are flagged" if flagged else "gains do not change with the noise of the data"}
        relative = float(np.nanmedian(errors[0][at] / np.abs(result.gains.gain_array[at])))
        return {
            "median_relative_amplitude": relative,
            "median_phase": float(np.nanmedian(errors[1][at])),
            "median_signal_to_noise": 1 / relative if relative > 0 else None,
            "noise_from": "residual",
            "realizations": self.realizations,
            "left_out": ["phase"],
        }

    def _cost(self) -> Cost:
        own, size = super()._cost(), size_of(self)
        twice = replace(size, polarizations=2 * size.polarizations)
        one, two = (cost_of(self.calibrator, of) for of in (size, twice))
        # Libraries are loaded once, which costs the same for twice the data.
        seconds = own.seconds + self.realizations * (two.seconds - one.seconds)
        return Cost(seconds, max(own.memory, one.memory), own.disk)


def lost_antennas(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a sentence that names the antennas whose gains are flagged in some of the solves; none without any."""
    found: dict[int, list[list[float]]] = {}
    for record in records:
        for number, pair in record.get("lost_antennas", {}).items():
            found.setdefault(number, []).append(pair)
    if not found:
        return []
    worst = sorted(found, key=lambda number: (-len(found[number]), min(found[number])))
    named = ", ".join(
        f"{number} ({min(found[number])[0]:.1f} against {min(found[number])[1]:.1f} by noise alone, in "
        f"{len(found[number])} of {len(records)} solves)"
        for number in worst[:NAMED]
    )
    more = f" and {len(worst) - NAMED} more" if len(worst) > NAMED else ""
    return [f"antennas that cannot be calibrated are flagged; signal to noise of their gains: {named}{more}"]


def lost_in_noise(gains: np.ndarray, errors: np.ndarray, unevenness: float) -> list[str]:
    """Return a sentence if noise alone makes gains that are far above the others of their antenna; none otherwise.

    Gains and errors of their amplitudes are (Nants, Nfreqs, Ntimes, Npols); NaN is no error.
    """
    sizes = np.where(np.isfinite(errors), np.abs(gains), np.nan)
    known = np.isfinite(sizes).any(axis=(1, 2, 3))
    if not known.any():
        return []
    largest = np.nanmax(sizes[known] / np.nanmedian(sizes[known], axis=(1, 2, 3), keepdims=True))
    signal_to_noise = np.nanmedian(sizes / errors)
    if largest < FAR_ABOVE or signal_to_noise > MODERATE or unevenness > EVEN:
        return []
    return [
        f"|g| is up to {largest:.2g} times the median of its antenna, and the median signal to noise of the gains is "
        f"{signal_to_noise:.2g}: noise alone does this; {REMEDY}"
    ]


COVERAGE = "gain-coverage.npz"


@memoize
def gain_coverage(graph: Graph, variant: Variant, parity: str) -> Task:
    """Return the task of the coverage of one noise realization ("even" or "odd") of a variant."""
    true = corruption.gains(graph) if variant.effects else None
    return MeasureCoverage(f"coverage {parity}", gains=true, **solved(graph, variant, parity))


class MeasureCoverage(OfSolves, stage="gain-coverage", version=4):
    """Fractions of the gains of each solve that are within their errors of the true gains, unity if there are none.

    The true gains of integrations that are solved together are their mean.
    """

    gains: Input = None

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the fractions; raises InputError if no gains have errors."""
        from calstudy.products.selection import read_gains

        result, found, reasons = read_result(self.calibration), [], []
        feeds = range(0 if self.gains is None else result.model.Npols)
        true = [read_gains(self.gains, place) for place in feeds]
        for solve in self.solves(result):
            if isinstance(solve.errors, str):
                reasons.append(solve.errors)
                continue
            numbers = result.gains.ant_array[solve.rows]
            reference = np.ones(solve.gains.shape)
            if true:
                together = range(solve.times.start, solve.times.stop)
                reference = np.mean([true[solve.place].at(time, numbers) for time in together], axis=0)
            found.append(pulls(solve.errors, solve.gains, reference))
        if not found:
            raise InputError(f"no errors of gains: {'; '.join(sorted(set(reasons)))}")
        np.savez(output / COVERAGE, allow_pickle=False, **asdict(GainCoverage.of(found)))
        lacking = [f"{len(reasons)} solves have no errors of gains: {'; '.join(sorted(set(reasons)))}"]
        return {"solves": len(found), "warnings": lacking if reasons else []}


def read_coverage(folder: Path) -> GainCoverage:
    """Read the fractions of all solves."""
    return GainCoverage(**read_arrays(folder / COVERAGE))
