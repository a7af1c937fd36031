"""Gains alone, with the sky model taken for the truth."""

from __future__ import annotations

from calstudy.base.observation import Frame
from calstudy.calibrate.calibrators._least_squares import LeastSquares


class SkyBased(LeastSquares):
    """Gains alone are fitted; the sky model is taken for the truth."""

    calibrator: str = "sky-based"

    def refusal(self, frame: Frame, has_sky_model: bool) -> str | None:
        """Return that there is no sky model, if there is none, or that there is nothing to fit."""
        return super().refusal(frame, True) if has_sky_model else "needs a sky model, and there is none"
