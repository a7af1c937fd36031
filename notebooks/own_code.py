"""A calibrator and a sky that are not calstudy's, used in own-calibrator.ipynb."""

import numpy as np
from astropy import units
from astropy.coordinates import SkyCoord
from pydantic import Field
from pyradiosky import SkyModel

from calstudy.calibrate.interface import Calibration, Calibrator, Solve


class StefCal(Calibrator):
    """Solve each channel for gains that turn the sky model into the data (StefCal, Salvini & Wijnholds 2014)."""

    rounds: int = Field(30, ge=2, description="How often all gains are fitted.")
    tolerance: float = Field(0.01, gt=0, description="Converged if the last round changed gains by less, relatively.")
    fault: float = Field(
        0.0,
        ge=0,
        description="Spoils the sky model: each baseline gets this part of it once more, at the edge of its wedge, as "
        "a catalogue that lacks sources near the horizon would do.",
    )

    def refusal(self, frame, has_sky_model):
        """Return why data cannot be calibrated, or None."""
        return None if has_sky_model else "needs a sky model"

    def calibrate(self, observation, assumed, progress=None):
        """Return the gains, and the sky model that they were fitted to."""
        late = np.exp(2j * np.pi * np.outer(observation.lengths / 299792458.0, observation.frequencies))
        sky = assumed.sky_model.visibilities * (1 + self.fault * late[:, :, None])
        first, second = observation.antennas.T
        n_times, _, n_channels, n_polarizations = observation.shape
        shape = (observation.n_antennas, observation.n_antennas, n_times, n_channels, n_polarizations)
        measured, expected = np.zeros(shape, complex), np.zeros(shape, complex)
        for matrix, cube in ((measured, observation.visibilities), (expected, sky)):
            used = np.where(observation.flags, 0, cube).swapaxes(0, 1)
            matrix[first, second], matrix[second, first] = used, used.conj()
        gains = np.ones(shape[1:], complex)
        for step in range(self.rounds):
            # With the gains of the other antennas held, those of each antenna are a linear fit.
            model = expected * gains.conj()[None]
            power = (abs(model) ** 2).sum(axis=1)
            fitted = (measured * model.conj()).sum(axis=1) / np.where(power > 0, power, 1)
            before, gains = gains, fitted if step % 2 == 0 else (gains + fitted) / 2
        change = np.linalg.norm(gains - before) / np.linalg.norm(gains)
        status = "converged" if change < self.tolerance else "max-steps"
        message = f"the last of {self.rounds} rounds changed gains by {100 * change:.2g} %"
        found = gains.swapaxes(1, 2)
        return Calibration(
            gains=found,
            gain_flags=found == 0,
            model=sky,
            outcomes=Solve(status=status, message=message, steps=self.rounds),
        )


def few_bright(frequencies, count=50, seed=1):
    """Scatter `count` sources over the sky, 100 Jy and less at the middle of the band, with spectral index -0.8."""
    random = np.random.default_rng(seed)
    middle = frequencies.mean()
    stokes = np.zeros((4, 1, count)) * units.Jy
    stokes[0, 0] = 100 * (1 + np.arange(count)) ** -0.7 * units.Jy
    return SkyModel(
        name=[f"source{number}" for number in range(count)],
        skycoord=SkyCoord(
            random.uniform(0, 360, count), np.degrees(np.arcsin(random.uniform(-1, 1, count))), unit="deg"
        ),
        stokes=stokes,
        spectral_type="spectral_index",
        spectral_index=np.full(count, -0.8),
        reference_frequency=np.full(count, middle) * units.Hz,
        component_type="point",
    )
