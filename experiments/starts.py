"""CALAMITY from gains that only a simulation can choose: the true ones, or such that differ between data sets."""

import hashlib
from typing import Literal

import numpy as np
from pydantic import Field

from calstudy.base.gains import make_uvcal
from calstudy.base.observation import Observation
from calstudy.calibrate.calibrators.least_squares import Calamity
from calstudy.calibrate.interface import Assumed, Calibration, Progress
from calstudy.corrupt.effects.gains import PerChannelGains
from calstudy.corrupt.interface import draw_truth

# Of the experiment, as in `corruption.effects`.
TRUE_GAINS = PerChannelGains(sigma=0.1, seed=5)


class Started(Calamity):
    """CALAMITY of every integration from given gains."""

    centre: Literal["unity", "truth"] = Field("unity", description="Gains about which the first ones scatter.")
    scatter: float = Field(0.0, ge=0, description="Their relative rms, independent by channel, antenna and data set.")

    def calibrate(self, observation: Observation, assumed: Assumed, progress: Progress | None = None) -> Calibration:
        """Solve every integration from these gains."""
        from calstudy.calibrate.calamity import fit

        shape = (observation.n_antennas, observation.n_channels, 1, observation.n_polarizations)
        centre = np.ones(shape) if self.centre == "unity" else draw_truth(TRUE_GAINS, observation)["gains"]
        digest = hashlib.sha256(np.ascontiguousarray(observation.visibilities).tobytes()).digest()
        random = np.random.default_rng(np.frombuffer(digest, np.uint32))
        real, imaginary = random.standard_normal((2, *shape))
        gains = centre * (1 + self.scatter * (real + 1j * imaginary))
        return fit(observation, Assumed(assumed.sky_model, make_uvcal(observation.uvd, gains)), self, progress)
