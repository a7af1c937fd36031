"""Fit gains by hera_cal's redundant calibration, and the parameters that it leaves free by the sky model."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator

from calstudy.base.observation import Frame
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.schema import fault
from calstudy.base.units import Length
from calstudy.calibrate.calibrators.other_packages import Measured, OtherPackage, Solved, patterns
from calstudy.calibrate.degeneracy import FEED, POL, fix_phase, gradient_turns
from calstudy.calibrate.interface import Solve
from calstudy.calibrate.problem import gain_products
from calstudy.calibrate.settings import FlagWeights, GainWeights
from calstudy.instrument.layouts import RedundantGroups, redundant_groups
from calstudy.instrument.settings import Size

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hera_cal.datacontainer import DataContainer
    from hera_cal.redcal import RedSol, RedundantCalibrator

Step = Literal["firstcal", "logcal", "omnical", "abscal"]
STEPS: tuple[Step, ...] = ("firstcal", "logcal", "omnical", "abscal")
AGAIN: tuple[Step, ...] = ("omnical", "abscal")
"""The steps of a pass that starts from the gains of another."""
SAMPLES_AT_ONCE = 4e6
NEGLIGIBLE = 1e-14
"""Weight of the sky model in place of samples without weight, relative to the largest weight."""
PERFECT = 10 * NEGLIGIBLE
"""chi^2, over that of no model, below which only rounding and such samples are left to fit."""
STEP_LENGTH, CHECK_EVERY = 0.3, 10
"""Of omnical: part of the way to the next solution, and after how many steps it looks at chi^2."""

CELLS_OF_A_SET = 8
"""Cells with equal weights are solved together if a set has on average at least so many; each call of logcal has a
fixed cost."""

Gains = dict[tuple[int, str], np.ndarray]
Visibilities = dict[tuple[int, int, str], np.ndarray]
"""In the terms of hera_cal, (Ntimes, Nfreqs)."""


class Redcal(OtherPackage):
    """hera_cal's redundant calibration: firstcal, logcal and omnical, then abscal against the sky model.

    Redundant baselines are assumed to measure the same visibility. In each channel the sky model determines the
    amplitude and phase gradient that redundancy leaves free (Liu et al. 2010; Kern et al. 2020; Byrne et al. 2019).
    """

    # Amplitude and phase gradient have the weights of calibrated data since 2; passes after one that converged start
    # from its gains since 3; passes that swing go half of the way since 4.
    version: ClassVar[int] = 4
    calibrator: str = "redcal"
    redundancy_tolerance: Length = Field(
        0.5,
        gt=0,
        description="Baselines whose vectors agree within a quarter of this are redundant; those that differ by more "
        "than half of it are not (a grid of pyuvdata).",
    )
    steps: Annotated[tuple[Step, ...], Field(min_length=1)] = Field(
        STEPS,
        description="What is done: a delay and a phase per antenna; a linear fit of logarithms; a fit of the "
        "visibilities themselves; amplitude and phase gradient from the sky model. Any of them, in this order.",
    )
    tolerance: float = Field(
        1e-8, gt=0, lt=1, description="Stop omnical when gains and visibilities change by less, relative to their norm."
    )
    max_steps: int = Field(1000, ge=1, description="Of omnical, in each channel.")

    @field_validator("steps")
    @classmethod
    def _in_order(cls, steps: tuple[Step, ...]) -> tuple[Step, ...]:
        if list(steps) != [step for step in STEPS if step in steps]:
            raise fault("", f"must be some of {', '.join(STEPS)}, each once, in this order")
        return steps

    def refusal(self, frame: Frame, has_sky_model: bool) -> str | None:
        """Return why redundancy does not relate the gains of all antennas to each other, or None."""
        if (reason := super().refusal(frame, has_sky_model)) is not None:
            return reason
        fitted = self.fitted(frame.baselines(~frame.autos))
        return _undetermined(fitted.antennas, redundant_groups(fitted.vectors, self.redundancy_tolerance))

    def cost(self, size: Size) -> Cost:
        """Return the cost of the solves, for about a hundred steps of omnical; more if flags differ in all cells."""
        cells = size.channels.count * size.times * size.polarizations
        alike = isinstance(self.weights, FlagWeights | GainWeights) or "logcal" not in self.steps
        seconds = 5 + (4e-6 if alike else 1.5e-5) * size.samples + (1e-3 * cells if "abscal" in self.steps else 0)
        at_once = max(SAMPLES_AT_ONCE, size.baselines * size.channels.count)
        return Cost(seconds, LIBRARIES_MEMORY + COMPLEX128 * (6 * size.samples + 25 * min(size.samples, at_once)))

    def solve(self, measured: Measured, groups: list[slice], before: Solved | None = None) -> Solved:
        """Solve every integration by itself, and average gains that integrations share, with aligned phases."""
        if before is not None:
            return self._solve_again(measured, groups, before)
        found = redundant_groups(measured.frame.vectors, self.redundancy_tolerance)
        n_times, n_baselines, n_channels = measured.visibilities.shape
        step = max(int(SAMPLES_AT_ONCE // (n_baselines * n_channels)), 1)
        blocks = [
            _Redundant(self, measured, found, slice(first, min(first + step, n_times))).solve()
            for first in range(0, n_times, step)
        ]
        gains, status, steps = (np.concatenate(parts, axis=-2) for parts in zip(*blocks, strict=True))
        weights = measured.weights.sum(axis=1)
        shared = np.stack([_average(gains[:, times], weights[times]) for times in groups], axis=2)
        return Solved(shared, [self._outcome(status[times], steps[times]) for times in groups])

    def _solve_again(self, measured: Measured, groups: list[slice], before: Solved) -> Solved:
        """Solve data divided by the gains of the previous pass, with the weights of unity gains.

        These weights are equal if nothing is flagged, which logcal needs for its speed. Where the previous pass
        converged, its gains are so close that omnical needs no other start.
        """
        known = np.where(np.isfinite(before.gains) & (before.gains != 0), before.gains, 1)
        visibilities = measured.visibilities.copy()
        for number, times in enumerate(groups):
            visibilities[times] /= gain_products(known[..., number], measured.frame.antennas)
        near = "omnical" in self.steps and all(outcome.status == "converged" for outcome in before.outcomes)
        again = self.model_copy(update={"steps": tuple(step for step in AGAIN if step in self.steps)}) if near else self
        gains, outcomes = again.solve(replace(measured, visibilities=visibilities), groups)
        return Solved(gains * known, outcomes)

    def _outcome(self, status: np.ndarray, steps: np.ndarray) -> Solve:
        """Return how a solve ended, from the status of its channels in `_Redundant.solve`."""
        count, longest = Counter(status.ravel().tolist()), int(steps.max())
        if not count.keys() & {"converged", "max-steps", "stalled"}:
            message = "redundant baselines that are not flagged do not tie the antennas to each other in any channel"
            return Solve("failed", message)
        if count["max-steps"]:
            message = f"omnical did not converge within {self.max_steps} steps in {count['max-steps']} channels"
            return Solve("max-steps", message, steps=longest)
        if count["stalled"] or count["failed"]:
            message = (
                f"omnical found nothing better in {count['stalled']} channels before it converged, and "
                f"{count['failed']} without a solution are flagged"
            )
            if "firstcal" in self.steps:
                message += "; leave firstcal out of steps if phases of gains are not those of cable delays"
            return Solve("stalled", message, steps=longest)
        if "omnical" not in self.steps:
            return Solve("converged", f"{', '.join(self.steps)}: linear fits, without iteration")
        return Solve("converged", f"omnical changed by less than {self.tolerance:g}", steps=longest)


def _average(gains: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Average gains (Nants, Ntimes, Nfreqs) over the integrations with a solution, with weights (Ntimes, Nfreqs)."""
    known = np.isfinite(gains)
    values = np.where(known, gains, 0)
    reference = values[:, 0]
    for t in range(1, values.shape[1]):
        # An integration without data has no phase to align; where the first has none, the next is the reference.
        values[:, t] = np.where(reference.any(axis=0), fix_phase(values[:, t], reference), values[:, t])
        reference = np.where(reference.any(axis=0), reference, values[:, t])
    used = np.where(known, weights, 0)
    total = used.sum(axis=1)
    return np.where(total > 0, (used * values).sum(axis=1) / np.where(total > 0, total, 1), np.nan)


def _undetermined(antennas: np.ndarray, groups: RedundantGroups) -> str | None:
    """Describe degrees of freedom that redundancy leaves besides amplitude, phase and phase gradient, or return None.

    `antennas` are those of each baseline, (Nbls, 2). Each group has an unknown visibility, which is eliminated.
    """
    present, places = np.unique(antennas, return_inverse=True)
    first, second = np.eye(present.size)[places.reshape(-1, 2).T]
    open_ = []
    for rows in (first + second, np.where(groups.conjugated[:, None], second - first, first - second)):
        size = np.bincount(groups.index)
        means = np.stack([np.bincount(groups.index, column) for column in rows.T], axis=1) / size[:, None]
        rest = rows - means[groups.index]
        open_.append(present.size - np.linalg.matrix_rank(rest.T @ rest, hermitian=True))
    amplitudes, phases = open_
    if amplitudes > 1 or phases > 3:
        return (
            f"redundant baselines leave {amplitudes} amplitudes and {phases} phases of {present.size} antennas open in "
            "each channel, and may leave 1 and 3; the array is not redundant enough (see redundancy_tolerance)"
        )
    return None


def _solvable(antennas: np.ndarray, groups: RedundantGroups, used: np.ndarray) -> np.ndarray:
    """Return the mask of cells, (Ntimes, Nfreqs), whose used baselines, (Nbls, Ntimes, Nfreqs), determine the gains."""
    found = np.zeros(used[0].size, bool)
    for chosen, cells in patterns(used.reshape(len(used), -1)):
        if chosen.any():
            part = RedundantGroups(np.unique(groups.index[chosen], return_inverse=True)[1], groups.conjugated[chosen])
            found[cells] = _undetermined(antennas[chosen], part) is None
    return found.reshape(used.shape[1:])


class _Redundant:
    """Some integrations of redundant baselines, in the terms of hera_cal.

    hera_cal fails on samples without weight. They are replaced by the sky model with a negligible weight. In a cell (a
    channel of an integration) that cannot be solved, it replaces all samples, with unit weight.
    """

    def __init__(self, settings: Redcal, measured: Measured, groups: RedundantGroups, times: slice) -> None:
        self.settings, self.frame, index = settings, measured.frame, groups.index
        weights = measured.weights[times].swapaxes(0, 1)
        self.empty = ~weights.any(axis=0)
        self.solvable = _solvable(measured.frame.antennas, groups, weights > 0)
        used = (weights > 0) & self.solvable
        anywhere = used.any(axis=(1, 2))
        shared = np.bincount(index[anywhere], minlength=index.max() + 1)[index] > 1
        data, sky, weight = {}, {}, {}
        reds: dict[int, list[tuple[int, int, str]]] = {}
        for row in np.flatnonzero(anywhere & shared):
            back = groups.conjugated[row]
            a, b = measured.frame.antennas[row][:: -1 if back else 1]
            key = (int(a), int(b), POL)
            reds.setdefault(index[row], []).append(key)
            model = np.where(measured.sky[times, row] == 0, 1, measured.sky[times, row])
            measurement = np.where(used[row], measured.visibilities[times, row], model)
            data[key], sky[key] = (values.conj() if back else values for values in (measurement, model))
            weight[key] = np.where(self.solvable, weights[row], 1.0)
        self.data, self.sky, self.weights = data, sky, weight
        self.reds = [reds[group] for group in sorted(reds)]

    def solve(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return gains (Nants, Ntimes, Nfreqs), NaN without a solution, and status and steps of each cell.

        The status is "" where there are no data, and "failed" where they do not suffice.
        """
        gains = np.full((self.frame.n_antennas, *self.solvable.shape), np.nan, complex)
        status, steps = np.full(self.solvable.shape, "converged", "U9"), np.zeros(self.solvable.shape, int)
        if self.reds:
            found = self._delays() if "firstcal" in self.settings.steps else self._unity()
            found, status, steps = self._by_channel(found)
            if "abscal" in self.settings.steps:
                found = self._absolute(found)
            for (antenna, _), gain in found.items():
                seen = np.any([self.weights[key] > 0 for key in self.data if antenna in key[:2]], axis=0)
                gains[antenna] = np.where(seen, gain, np.nan)
        broken = np.any([~np.isfinite(gain) for gain in found.values()], axis=0) if self.reds else True
        status = np.where(self.empty, "", np.where(self.solvable & ~broken, status, "failed"))
        return np.where((status == "") | (status == "failed"), np.nan, gains), status, np.where(self.solvable, steps, 0)

    def _unity(self) -> Gains:
        antennas = sorted({antenna for key in self.data for antenna in key[:2]})
        return {(antenna, FEED): np.ones(self.solvable.shape, complex) for antenna in antennas}

    def _delays(self) -> Gains:
        """Fit a delay and a phase for each antenna and integration."""
        from hera_cal.datacontainer import DataContainer
        from hera_cal.redcal import RedundantCalibrator

        found = self._unity()
        for t in range(len(self.solvable)):
            # All integrations at once would share what hera_cal decides on antennas with a wrong sign.
            data = DataContainer({key: values[t : t + 1] for key, values in self.data.items()})
            for antenna, gain in RedundantCalibrator(self.reds).firstcal(data, self.frame.frequencies)[1].gains.items():
                found[antenna][t] = gain[0]
        return found

    def _by_channel(self, first: Gains) -> tuple[Gains, np.ndarray, np.ndarray]:
        """Return gains, those of firstcal included and free of degeneracies, and status and steps of each cell."""
        from hera_cal.datacontainer import DataContainer
        from hera_cal.redcal import RedSol

        calibrator = _calibrator(self.reds)
        rest = DataContainer(_calibrated(self.data, first))
        floor = NEGLIGIBLE * max(float(values.max()) for values in self.weights.values())
        weights = DataContainer({key: np.maximum(values, floor) for key, values in self.weights.items()})
        solution = RedSol(self.reds, gains=self._unity())
        solution.update_vis_from_data(rest, wgts=weights)
        if "logcal" in self.settings.steps:
            solution = self._logcal(calibrator, rest, weights)
        status, steps = np.full(self.solvable.shape, "converged", "U9"), np.zeros(self.solvable.shape, int)
        if "omnical" in self.settings.steps:
            details, solution = calibrator.omnical(
                rest,
                solution,
                wgts=weights,
                gain=STEP_LENGTH,
                conv_crit=self.settings.tolerance,
                maxiter=self.settings.max_steps,
                check_every=CHECK_EVERY,
            )
            steps = details["iter"]
            perfect = details["chisq"] < PERFECT * sum(weights[key] * np.abs(rest[key]) ** 2 for key in self.data)
            short = (details["conv_crit"] > self.settings.tolerance) & ~perfect
            status[short] = np.where(steps[short] >= self.settings.max_steps, "max-steps", "stalled")
        solution.remove_degen(degen_sol=self._unity())
        return {key: gain * first[key] for key, gain in solution.gains.items()}, status, steps

    def _logcal(self, calibrator: RedundantCalibrator, data: DataContainer, weights: DataContainer) -> RedSol:
        """Solve with logcal; cells with proportional weights have the same matrix, which is inverted once."""
        from hera_cal.datacontainer import DataContainer
        from hera_cal.redcal import RedSol

        stacked = np.stack([weights[key].ravel() for key in self.data])
        sets, number = np.unique(stacked / stacked.max(axis=0), axis=1, return_inverse=True)
        if CELLS_OF_A_SET * sets.shape[1] > number.size:
            return calibrator.logcal(data, wgts=weights)[1]
        found: dict[Any, np.ndarray] = {}
        for index, values in enumerate(sets.T):
            cells = np.flatnonzero(number.ravel() == index)
            part = DataContainer({key: data[key].reshape(1, -1)[:, cells] for key in self.data})
            shared = DataContainer({key: np.full((1, 1), value) for key, value in zip(self.data, values, strict=True)})
            for key, solved in calibrator.logcal(part, wgts=shared)[1].items():
                found.setdefault(key, np.empty(number.size, complex))[cells] = solved[0]
        return RedSol(self.reds, sol_dict={key: values.reshape(self.solvable.shape) for key, values in found.items()})

    def _absolute(self, gains: Gains) -> Gains:
        """Fit phase gradient and amplitude of the gains to the sky model in each channel."""
        from hera_cal.abscal import abs_amp_lincal
        from hera_cal.datacontainer import DataContainer

        calibrated = _calibrated(self.data, gains)
        # Of the calibrated data: those of the measured ones times |g_a g_b|^2.
        weights = {
            (a, b, pol): weight * np.abs(gains[a, FEED] * gains[b, FEED]) ** 2
            for (a, b, pol), weight in self.weights.items()
        }
        overlap = {key: weights[key] * calibrated[key] * self.sky[key].conj() for key in self.data}
        turns = gradient_turns(self.reds, overlap)
        gains = {key: gain * turns[key] for key, gain in gains.items()}
        data, sky, wgts = (DataContainer(values) for values in (_calibrated(self.data, gains), self.sky, weights))
        scales = abs_amp_lincal(sky, data, wgts=wgts, verbose=False, return_gains=True, gain_ants=list(gains))
        return {key: gain * scales[key] for key, gain in gains.items()}


def _calibrator(reds: list[list[tuple[int, int, str]]]) -> RedundantCalibrator:
    """Return hera_cal's calibrator with an omnical that multiplies the terms of its equations.

    hera_cal evaluates the text of each equation at every step; to compile the text takes longer than the products.
    """
    from hera_cal.redcal import OmnicalSolver, RedundantCalibrator

    class Omnical(OmnicalSolver):
        def _get_ans0(self, sol: Mapping, keys: Any = None, to_update_inplace: dict | None = None) -> dict:
            values = {**sol, **{f"{name}_": gain.conj() for name, gain in sol.items() if name.startswith("g")}}
            found = {} if to_update_inplace is None else to_update_inplace
            for key, ((first, second, model),) in zip(self.keys, self.all_terms, strict=True):
                found[key] = values[first] * values[second] * values[model]
            return found

    class Calibrator(RedundantCalibrator):
        def _solver(self, solver: type, *args: Any, **settings: Any) -> Any:
            return super()._solver(Omnical if solver is OmnicalSolver else solver, *args, **settings)

    return Calibrator(reds)


def _calibrated(data: Visibilities, gains: Gains) -> Visibilities:
    """Return V / (g_a g_b*)."""
    return {(a, b, pol): values / (gains[a, FEED] * gains[b, FEED].conj()) for (a, b, pol), values in data.items()}
