"""Gains with the passband of coarse channels.

The receivers of the MWA divide the band into coarse channels of 1.28 MHz, centred at multiples of it, by a critically
sampled polyphase filter bank of 512 branches and 8 taps (MWA wiki, "RRI Receiver PFB Filter" and "Receiver Modes").
The prototype here is a sinc with a Kaiser window of beta 5. With the power that is aliased from the two adjacent coarse
channels it reproduces the passband of the true coefficients, by which Birli divides visibilities
(``PFB_JAKE_2022_200HZ``), to 5e-5 at all frequencies.

A digital gain, an integer in units of 1/64 (mwalib 0.13), sets the level of each coarse channel of each receiver input.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from calstudy.base.units import Fraction, Frequency
from calstudy.corrupt.interface import GainEffect

if TYPE_CHECKING:
    from calstudy.base.observation import Observation
    from calstudy.instrument.size import Size

BRANCHES, TAPS, KAISER_BETA = 512, 8, 5.0
STEPS = 6400
"""Number of steps of the tabulated passband in a coarse channel."""
FEWEST = 3
"""Smallest number of channels in a coarse channel that has a centre and two edges."""


class CoarseChannels(GainEffect):
    """g = level x sqrt(passband), real: a passband common to all antennas, and a level of each coarse channel.

    The power of the passband is 1 within 0.5 % up to 0.30 of a coarse channel from its centre, and 0.5 at its edges.
    Half of that is aliased from the adjacent coarse channel, and counts as if it were not. The power is averaged over
    each channel, which may lie in two coarse channels.
    """

    width: Frequency = Field(
        1.28e6,
        gt=0,
        description="Width of coarse channels, which are centred at its multiples; by default the MWA's.",
    )
    level_scatter: Fraction = Field(
        0.0045,
        ge=0,
        le=0.5,
        description="rms of the level of a coarse channel less 1, uniform, independent for every antenna, polarization "
        "and coarse channel; the default is that of rounding to the MWA's digital gains, 1 / (64 sqrt(12)).",
    )
    shape_scatter: Fraction = Field(
        0.0,
        ge=0,
        le=0.5,
        description="rms of the relative difference, normal, of an antenna's passband in dB from the common one; the "
        "default is 0, for the filter is digital and hence the same for all.",
    )
    seed: int = Field(17, ge=0, description="Seed of levels and shapes.")

    def refusal(self, size: Size) -> str | None:
        """Refuse channels that are too wide to resolve the passband."""
        held = self.width / size.channels.width
        # Frequencies are good to 1 Hz.
        if held > FEWEST * (1 - 1 / self.width):
            return None
        return (
            f"width: {self.width / 1e6:g} MHz: a coarse channel holds {held:.2g} channels of "
            f"{size.channels.width / 1e6:g} MHz; its passband takes at least {FEWEST}"
        )

    def gains(self, observation: Observation, random: np.random.Generator) -> np.ndarray:
        """Return the gains, float64, shape (Nants, Nfreqs, 1, Npols)."""
        powers = self._powers(observation.frequencies)
        shape = observation.n_antennas, observation.n_polarizations
        levels = 1 + self.level_scatter * np.sqrt(12) * random.uniform(-0.5, 0.5, (*shape, powers.shape[1]))
        exponents = self.shape_scatter * random.standard_normal((*shape, 1))
        gains = np.sqrt((levels**2 @ powers.T) * powers.sum(axis=1) ** exponents)
        return np.moveaxis(gains, 2, 1)[:, :, None]

    def _powers(self, frequencies: np.ndarray) -> np.ndarray:
        """Return the contribution of each coarse channel to the mean power in each channel, (Nfreqs, Ncoarse)."""
        half = (frequencies[-1] - frequencies[0]) / (len(frequencies) - 1) / 2
        # Coarse channels that the band only touches are left out. Frequencies are good to 1 Hz.
        lowest, highest = frequencies[0] - half + 1, frequencies[-1] + half - 1
        coarse = np.arange(np.floor(lowest / self.width + 0.5), np.floor(highest / self.width + 0.5) + 1)
        offsets, integral = _integrated_passband()
        centres = frequencies[:, None] / self.width - coarse
        low, high = (
            np.interp(np.clip(centres + side / self.width, -0.5, 0.5), offsets, integral) for side in (-half, half)
        )
        return (high - low) * self.width / (2 * half)


@cache
def _integrated_passband() -> tuple[np.ndarray, np.ndarray]:
    """Return offsets from the centre of a coarse channel, in its widths, and the integral of the power up to them."""
    from scipy.integrate import cumulative_trapezoid
    from scipy.signal import firwin

    prototype = firwin(TAPS * BRANCHES, 1 / BRANCHES, window=("kaiser", KAISER_BETA))
    power = np.abs(np.fft.rfft(prototype, BRANCHES * STEPS)) ** 2
    # The power of the coarse channel itself and of both adjacent ones.
    upper = np.arange(STEPS // 2 + 1)
    folded = power[upper] + power[STEPS + upper] + power[STEPS - upper]
    offsets = np.arange(-(STEPS // 2), STEPS // 2 + 1) / STEPS
    integral = cumulative_trapezoid(np.concatenate([folded[:0:-1], folded]), offsets, initial=0)
    return offsets, integral
