"""Calibrators of other packages, which find only gains, from data and a sky model; hera_cal's skycal is one."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.observation import Frame, Observation
from calstudy.base.quiet import without_warnings
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost, Usage
from calstudy.calibrate.boards import Boards
from calstudy.calibrate.degeneracy import FEED, POL, fix_phase
from calstudy.calibrate.interface import NO_SKY_MODEL, Assumed, Calibration, Progress, Solve
from calstudy.calibrate.problem import NOTHING_WEIGHTED, fitted_baselines, gain_products, gain_weights, weight_change
from calstudy.calibrate.records import require_parallel_hands
from calstudy.calibrate.settings import RUNAWAY, GainWeights, WeightedFit, unsettled_message
from calstudy.instrument.settings import Size

SLOW = 0.5
"""Passes whose weights change by more than this part of the change before go half of the way."""


@dataclass(frozen=True, eq=False)
class Measured:
    """The data of one polarization, without autocorrelations.

    Visibilities and sky model are complex128, (Ntimes, Nbls, Nfreqs); weights have the same shape, and are zero for
    samples without influence.
    """

    frame: Frame
    visibilities: np.ndarray
    sky: np.ndarray
    weights: np.ndarray

    def weighted_by(self, gains: np.ndarray, groups: list[slice]) -> Measured:
        """Divide the weights by |g_a g_b|^2, and keep their mean in every group of integrations.

        Gains are complex, (Nants, Nfreqs, Ngroups); unknown ones count as unity.
        """
        known = np.where(np.isfinite(gains) & (gains != 0), gains, 1)
        weights = self.weights.copy()
        for number, times in enumerate(groups):
            part = weights[times]
            products = np.broadcast_to(gain_products(known[..., number], self.frame.antennas), part.shape)
            # As one array of baselines and channels.
            rows = (values.reshape(-1, part.shape[2]) for values in (part, products))
            weights[times] = gain_weights(*rows).reshape(part.shape)
        return replace(self, weights=weights)

    def containers(self, rows: np.ndarray, *parts: np.ndarray) -> list[Any]:
        """Return parts of some baselines, (len(rows), Nfreqs), as hera_cal has them: of a single time."""
        from hera_cal.datacontainer import DataContainer

        keys = [(int(a), int(b), POL) for a, b in self.frame.antennas[rows]]
        return [DataContainer({key: row[None] for key, row in zip(keys, part, strict=True)}) for part in parts]


class Solved(NamedTuple):
    """Gains, complex, (Nants, Nfreqs, Ngroups), NaN where there are none, and how the solve of each group ended."""

    gains: np.ndarray
    outcomes: list[Solve]


class OtherPackage(WeightedFit):
    """A calibrator that finds only gains; the residual is that of the sky model."""

    def refusal(self, frame: Frame, has_sky_model: bool) -> str | None:
        """Return a sentence if there is no sky model, or nothing to calibrate."""
        if not has_sky_model:
            return NO_SKY_MODEL
        try:
            self.fitted(frame.baselines(fitted_baselines(frame, autos=False)))
        except InputError as error:
            return str(error)
        return None

    @abstractmethod
    def solve(self, measured: Measured, groups: list[slice], before: Solved | None = None) -> Solved:
        """Solve every group of integrations.

        The data are of one polarization, with weight in each group. `before` is None in the first pass. If weights come
        from the gains, it is the previous pass, with the gains that make the weights: those of `measured` over
        |g_a g_b|^2 (`Measured.weighted_by`).
        """

    def calibrate(self, observation: Observation, assumed: Assumed, progress: Progress | None = None) -> Calibration:
        """Solve every polarization, and flag the gains of antennas and channels without data."""
        from calstudy.calibrate.weights import make_weights, require_finite

        if assumed.sky_model is None:
            raise InputError(f"{self.label}: {NO_SKY_MODEL}")
        require_parallel_hands(observation.uvd)
        crosses = ~observation.autos
        groups = self.solves(observation.n_times)
        weights = make_weights(observation, crosses, self.weights, groups)
        data, sky = observation.baselines(crosses), assumed.sky_model.baselines(crosses)
        require_finite(data)
        factors = 1.0 if self.baselines is None else self.baselines.factors(data.lengths, data.antennas)[:, None]
        gains = np.full((data.n_antennas, data.n_channels, len(groups), data.n_polarizations), np.nan, complex)
        outcomes: list[Solve] = []
        for p in range(data.n_polarizations):
            used = (weights[..., p] > 0) & (sky.visibilities[..., p] != 0) & (data.visibilities[..., p] != 0)
            visibilities = np.where(used, data.visibilities[..., p], 0).astype(complex)
            model = np.nan_to_num(sky.visibilities[..., p].astype(complex))
            measured = Measured(data, visibilities, model, np.where(used, weights[..., p] * factors, 0.0))
            gains[..., p], ended = self._solve_timed(measured, groups)
            outcomes += ended
            if progress is not None:
                progress((p + 1) * len(groups), data.n_polarizations * len(groups))
        unknown = ~np.isfinite(gains) | (gains == 0)
        flat = np.where(unknown, 0, gains).reshape(len(gains), -1)
        # Their sum over antennas is real and positive in every channel.
        turned = fix_phase(flat, np.ones_like(flat)).reshape(gains.shape)
        return Calibration(
            gains=np.where(unknown, 1, turned),
            gain_flags=unknown,
            flags=weights == 0,
            baselines=crosses,
            outcomes=outcomes,
        )

    def _solve_timed(self, measured: Measured, groups: list[slice]) -> tuple[np.ndarray, list[Solve]]:
        """Solve the groups that have data, and skip the others."""
        full = [number for number, times in enumerate(groups) if measured.weights[times].any()]
        gains = np.full((measured.frame.n_antennas, measured.frame.n_channels, len(groups)), np.nan, complex)
        ended = [Solve("skipped", NOTHING_WEIGHTED, seconds=0.0, cpu_seconds=0.0)] * len(groups)
        if full:
            with Usage() as usage, without_warnings():
                gains[:, :, full], found = self._solve_in_passes(measured, [groups[number] for number in full])
            share, cpu_share = usage.seconds / len(full), usage.cpu_seconds / len(full)
            for number, outcome in zip(full, found, strict=True):
                ended[number] = replace(outcome, seconds=share, cpu_seconds=cpu_share, peak_memory=usage.peak_memory)
        return gains, ended

    def _solve_in_passes(self, measured: Measured, groups: list[slice]) -> Solved:
        """Solve groups; with weights from the gains, repeat with those of the previous pass until they settle.

        Where the sky model lacks much, gains that are too small in one pass are too large in the next, further each
        time. Passes that do not settle by themselves go half of the way (`SLOW`).
        """
        settings = self.weights
        solved = first = self.solve(measured, groups)
        if not isinstance(settings, GainWeights):
            return solved
        passes, used, weights, before = 1, np.ones_like(solved.gains), measured.weights, np.full(len(groups), np.inf)
        failed = np.zeros(len(groups), bool)
        while True:
            wanted = measured.weighted_by(solved.gains, groups).weights
            changes = np.array([weight_change(wanted[times], weights[times]) for times in groups])
            # Weights of a pass that failed have not settled.
            changes = np.where(failed, before, changes)
            if passes == settings.passes or max(changes) < settings.tolerance:
                break
            used = np.where(changes > SLOW * before, _halfway(used, solved.gains), solved.gains)
            found = self.solve(measured, groups, solved._replace(gains=used))
            failed = np.array([not outcome.usable for outcome in found.outcomes])
            solved = _chosen(failed, solved, found)
            passes, weights, before = passes + 1, measured.weighted_by(used, groups).weights, changes
        kept = _chosen((changes > RUNAWAY) & (passes > 1), first, solved)
        unsettled = [settings.unsettled(change) for change in changes]
        ended = zip(kept.outcomes, changes.tolist(), unsettled, strict=True)
        return Solved(kept.gains, [_in_passes(*each, passes) for each in ended])


def _chosen(chosen: np.ndarray, first: Solved, second: Solved) -> Solved:
    """Return the first of two solves for the groups of a mask, (Ngroups,), and the second for the others."""
    outcomes = [
        one if is_first else other for is_first, one, other in zip(chosen, first.outcomes, second.outcomes, strict=True)
    ]
    return Solved(np.where(chosen, first.gains, second.gains), outcomes)


def _halfway(used: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Return gains whose modulus is the geometric mean of two, with the phase of those found."""
    with np.errstate(divide="ignore", invalid="ignore"):
        between = found * np.sqrt(np.abs(used) / np.abs(found))
    return np.where(np.isfinite(between) & (between != 0), between, found)


def _in_passes(outcome: Solve, change: float, unsettled: bool, passes: int) -> Solve:
    """Return an outcome with the number of passes and the last change of the weights."""
    if unsettled and outcome.status == "converged":
        outcome = replace(outcome, status="max-steps", message=unsettled_message(change, passes))
    return replace(outcome, diagnostics={**outcome.diagnostics, "passes": passes, "weight_change": change})


def patterns(used: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Group cells by the set of baselines in use: return each set as bool, (Nbls,), with the indices of its cells.

    `used` is bool, (Nbls, Ncells), where a cell is a channel, or a channel of an integration.
    """
    packed = np.ascontiguousarray(np.packbits(used, axis=0).T)
    _, first, number = np.unique(packed, axis=0, return_index=True, return_inverse=True)
    return [(used[:, cell], np.flatnonzero(number.ravel() == index)) for index, cell in enumerate(first)]


class Skycal(OtherPackage):
    """hera_cal's skycal: a delay and a phase per antenna, then gains by channel; the sky model is taken as true.

    Amplitudes come only from the cross-correlations, and not from the autocorrelations as in HERA's own pipeline.
    """

    # Passes that swing go half of the way since 2.
    version: ClassVar[int] = 2
    calibrator: str = "skycal"
    delays: bool = Field(True, description="First fit a delay and a phase per antenna.")
    tolerance: float = Field(1e-8, gt=0, lt=1, description="Stop when no gain of a channel changes by more.")
    max_steps: int = Field(100, ge=1)
    boards: Boards | None = Field(
        None,
        description="Fit gains to baselines between boards, and estimate and correct what is lost between them; null: "
        "nothing is lost.",
    )

    def refusal(self, frame: Frame, has_sky_model: bool) -> str | None:
        """Return a sentence also if there are too few boards."""
        reason = super().refusal(frame, has_sky_model)
        if reason is not None or self.boards is None:
            return reason
        return self.boards.refusal(frame.baselines(~frame.autos))

    def calibrate(self, observation: Observation, assumed: Assumed, progress: Progress | None = None) -> Calibration:
        """Solve every polarization; with boards, correct what they lose."""
        found = super().calibrate(observation, assumed, progress)
        if self.boards is None or assumed.sky_model is None:
            return found
        data, sky = (each.baselines(~observation.autos) for each in (observation, assumed.sky_model))
        return self.boards.corrected(found, data, sky, self.solves(data.n_times))

    def cost(self, size: Size) -> Cost:
        """Return the cost of the solves: dense matrices of the antennas for each channel, about ten times."""
        channels = size.channels.count * size.times * size.polarizations / self.integrations_per_solve
        seconds = 5 + 1e-6 * size.samples + 10 * channels * (2e-5 + 2e-9 * size.antennas**3)
        solve = size.samples * self.integrations_per_solve / (size.times * size.polarizations)
        return Cost(seconds, LIBRARIES_MEMORY + COMPLEX128 * (6 * size.samples + 12 * solve))

    def solve(self, measured: Measured, groups: list[slice], before: Solved | None = None) -> Solved:
        """Solve every group of integrations, by the baselines between boards if there are any."""
        if self.boards is not None:
            between = ~self.boards.within(measured.frame)[:, None]
            measured = replace(measured, weights=np.where(between, measured.weights, 0))
        if before is not None:
            measured = measured.weighted_by(before.gains, groups)
        gains, outcomes = zip(*(self._solve_group(measured, times) for times in groups), strict=True)
        return Solved(np.stack(gains, axis=2), list(outcomes))

    def _solve_group(self, measured: Measured, times: slice) -> tuple[np.ndarray, Solve]:
        """Return gains (Nants, Nfreqs), NaN where there are none.

        Common gains depend only on the sums of w V M* and w |M|^2 over integrations.
        """
        data, sky, weights = measured.visibilities[times], measured.sky[times], measured.weights[times]
        weight = np.sum(weights * np.abs(sky) ** 2, axis=0)
        total = np.sum(weights * data * sky.conj(), axis=0)
        ratio = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0)
        start = self._delays(measured, ratio, weight)
        gains = np.full(start.shape, np.nan, complex)
        steps = np.zeros(start.shape[1], int)
        for used, channels in patterns(weight > 0):
            if used.any():
                part = np.ix_(used, channels)
                gains[:, channels], steps[channels] = self._refine(
                    measured, np.flatnonzero(used), ratio[part], weight[part], start[:, channels]
                )
        return gains, self._outcome(steps)

    def _delays(self, measured: Measured, ratio: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return gains (Nants, Nfreqs) with a delay and a phase each; unity if `delays` is false."""
        gains = np.ones((measured.frame.n_antennas, measured.frame.n_channels), complex)
        if not self.delays:
            return gains
        from hera_cal.skycal import firstcal_gains, model_based_firstcal

        containers = measured.containers(np.arange(len(ratio)), ratio, weight)
        delays, phases = model_based_firstcal(*containers, measured.frame.frequencies)
        for (antenna, _), gain in firstcal_gains(delays, phases, measured.frame.frequencies).items():
            gains[antenna] = gain[0]
        return gains

    def _refine(
        self, measured: Measured, rows: np.ndarray, ratio: np.ndarray, weight: np.ndarray, start: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return gains of some channels with the same baselines, and the steps of each, -1 where there are none."""
        from hera_cal.skycal import refine_gains

        containers = measured.containers(rows, ratio, weight)
        first = {(antenna, FEED): gain[None] for antenna, gain in enumerate(start)}
        refined, details = refine_gains(
            *containers, first, refine_tol=self.tolerance, refine_maxiter=self.max_steps, max_divergent_chan_frac=1.0
        )
        gains = np.full(start.shape, np.nan, complex)
        for (antenna, _), gain in refined.items():
            gains[antenna] = start[antenna] * gain[0]
        (steps,) = details["iter"].values()
        return gains, steps

    def _outcome(self, steps: np.ndarray) -> Solve:
        solved, failed = steps > 0, steps < 0
        longest = int(steps.max(initial=0))
        if not solved.any():
            return Solve("failed", f"gains converged in no channel within {self.max_steps} steps")
        if failed.any():
            counts = f"{failed.sum()} of {(solved | failed).sum()}"
            return Solve("stalled", f"gains did not converge in {counts} channels, which are flagged", steps=longest)
        return Solve("converged", f"gains changed by less than {self.tolerance:g}", steps=longest)
