"""Fit only gains, with the sky model as the true foregrounds."""

from __future__ import annotations

from calstudy.base.observation import Frame
from calstudy.calibrate.calibrators._least_squares import LeastSquares


class SkyBased(LeastSquares):
    """Only gains are fitted; the sky model is taken as the true foregrounds."""

    calibrator: str = "sky-based"

    def refusal(self, frame: Frame, has_sky_model: bool) -> str | None:
        """Return a sentence if there is no sky model, or nothing to fit."""
        return super().refusal(frame, True) if has_sky_model else "needs a sky model, and there is none"
