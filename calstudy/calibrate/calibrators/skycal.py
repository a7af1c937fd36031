"""Fit gains to the sky model in each channel by hera_cal's skycal."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.calibrate.calibrators._other_packages import FEED, Measured, OtherPackage, patterns
from calstudy.calibrate.interface import Solve
from calstudy.instrument.size import Size


class Skycal(OtherPackage):
    """hera_cal's skycal: a delay and a phase per antenna, then gains by channel; the sky model is taken as true.

    Amplitudes come only from the cross-correlations, and not from the autocorrelations as in HERA's own pipeline.
    """

    calibrator: str = "skycal"
    delays: bool = Field(True, description="First fit a delay and a phase per antenna.")
    tolerance: float = Field(1e-8, gt=0, lt=1, description="Stop when no gain of a channel changes by more.")
    max_steps: int = Field(100, ge=1)

    def cost(self, size: Size) -> Cost:
        """Return the cost of the solves: dense matrices of the antennas for each channel, about ten times."""
        channels = size.channels.count * size.times * size.polarizations / self.integrations_per_solve
        seconds = 5 + 1e-6 * size.samples + 10 * channels * (2e-5 + 2e-9 * size.antennas**3)
        solve = size.samples * self.integrations_per_solve / (size.times * size.polarizations)
        return Cost(seconds, LIBRARIES_MEMORY + COMPLEX128 * (6 * size.samples + 12 * solve))

    def solve(
        self, measured: Measured, groups: list[slice], start: np.ndarray | None = None
    ) -> tuple[np.ndarray, list[Solve]]:
        """Solve every group of integrations."""
        if start is not None:
            measured = measured.weighted_by(start, groups)
        found = [self._solve_group(measured, times) for times in groups]
        return np.stack([gains for gains, _ in found], axis=2), [outcome for _, outcome in found]

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
        from hera_cal.datacontainer import DataContainer
        from hera_cal.skycal import firstcal_gains, model_based_firstcal

        keys = measured.keys(np.arange(len(ratio)))
        containers = [
            DataContainer({key: row[None] for key, row in zip(keys, rows, strict=True)}) for rows in (ratio, weight)
        ]
        delays, phases = model_based_firstcal(*containers, measured.frame.frequencies)
        for (antenna, _), gain in firstcal_gains(delays, phases, measured.frame.frequencies).items():
            gains[antenna] = gain[0]
        return gains

    def _refine(
        self, measured: Measured, rows: np.ndarray, ratio: np.ndarray, weight: np.ndarray, start: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return gains of some channels with the same baselines, and the steps of each, -1 where there are none."""
        from hera_cal.datacontainer import DataContainer
        from hera_cal.skycal import refine_gains

        keys = measured.keys(rows)
        containers = [
            DataContainer({key: row[None] for key, row in zip(keys, values, strict=True)}) for values in (ratio, weight)
        ]
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
            return Solve(status="failed", message=f"gains converged in no channel within {self.max_steps} steps")
        if failed.any():
            message = (
                f"gains did not converge in {failed.sum()} of {(solved | failed).sum()} channels, which are flagged"
            )
            return Solve(status="stalled", message=message, steps=longest)
        return Solve(status="converged", message=f"gains changed by less than {self.tolerance:g}", steps=longest)
