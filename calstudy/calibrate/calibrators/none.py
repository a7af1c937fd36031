"""No calibration: the subtraction of the sky model from data with uncorrected gains."""

from __future__ import annotations

import numpy as np

from calstudy.base.observation import Frame, Observation
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.calibrate.interface import Assumed, Calibration, Calibrator, Progress, Solve
from calstudy.instrument.size import Size


class NoCalibration(Calibrator):
    """All gains are one, and the sky model is subtracted."""

    calibrator: str = "none"

    def refusal(self, frame: Frame, has_sky_model: bool) -> str | None:
        """Return a sentence if there is no sky model to subtract."""
        return None if has_sky_model else "needs a sky model, and there is none"

    def cost(self, size: Size) -> Cost:
        """Return the cost of the subtraction."""
        return Cost(1 + 1e-7 * size.samples, LIBRARIES_MEMORY + 6 * COMPLEX128 * size.samples)

    def calibrate(self, observation: Observation, assumed: Assumed, progress: Progress | None = None) -> Calibration:
        """Return gains of one."""
        shape = observation.visibilities.shape
        n_times, n_polarizations = shape[0], shape[-1]
        gains = np.ones((observation.numbers.size, shape[2], n_times, n_polarizations), complex)
        count = n_polarizations * len(self.solves(n_times))
        if progress is not None:
            progress(count, count)
        outcome = Solve(status="converged", message="gains of one: nothing is fitted")
        return Calibration(gains=gains, outcomes=[outcome] * count)
