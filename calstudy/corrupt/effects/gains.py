"""Effects on the gains of antennas: independent in every channel, smooth, reflections, from a file, coarse channels.

The receivers of the MWA divide the band into coarse channels of 1.28 MHz, centred at multiples of it, by a critically
sampled polyphase filter bank of 512 branches and 8 taps (MWA wiki, "RRI Receiver PFB Filter" and "Receiver Modes").
The prototype here is a sinc with a Kaiser window of beta 5. With the power that is aliased from the two adjacent coarse
channels it reproduces the passband of the true coefficients, by which Birli divides visibilities
(``PFB_JAKE_2022_200HZ``), to 5e-5 at all frequencies.

A digital gain, an integer in units of 1/64 (mwalib 0.13), sets the level of each coarse channel of each receiver input.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.errors import InputError
from calstudy.base.gain_files import read_gains
from calstudy.base.gains import gains_for, solution_times
from calstudy.base.schema import Section
from calstudy.base.units import Delay, Fraction, Frequency, Time
from calstudy.corrupt.drift import Polynomial, Shape, is_named, refusal_of_antennas
from calstudy.corrupt.interface import GainEffect
from calstudy.instrument.as_built import Antennas

if TYPE_CHECKING:
    from calstudy.base.observation import Observation
    from calstudy.instrument.settings import Size


class PerChannelGains(GainEffect):
    """g = 1 + sigma (n + i n'), independent per antenna and channel (paper §Simulations)."""

    kind: str = "per-channel-gains"
    sigma: float = Field(
        0.1, ge=0, le=10, description="rms of the real and of the imaginary part of g - 1, each (paper §Simulations)."
    )
    seed: int = Field(5, ge=0, description="Seed of n and n'.")

    def gains(self, observation: Observation, random: np.random.Generator) -> np.ndarray:
        """Return the gains, shape (Nants, Nfreqs, 1, Npols), with an independent draw for every polarization."""
        shape = observation.n_polarizations, observation.n_antennas, observation.n_channels
        real, imaginary = random.standard_normal((2, *shape))
        gains = 1 + self.sigma * (real + 1j * imaginary)
        return gains.transpose(1, 2, 0)[:, :, None]


class Bandpass(GainEffect):
    """g = 1 + sigma (x + i y), with x and y of unit variance and correlated in frequency.

    They are independent for every antenna, but for the part that all share, and constant or correlated in time.
    """

    version: ClassVar[int] = 2

    kind: str = "bandpass"
    sigma: float = Field(
        0.1,
        ge=0,
        le=1,
        description="rms over the band of the real and of the imaginary part of g - 1, each; the default is a "
        "choice of this project.",
    )
    shape: Shape = Polynomial(kind="polynomial")
    time: Time | None = Field(
        None, gt=0, description="Correlation time of x and y, whose correlation is exp(-t / time); null: constant."
    )
    common: Fraction = Field(0.0, ge=0, le=1, description="Part of the variance of x and y that all antennas share.")
    seed: int = Field(11, ge=0, description="Seed of x and y.")

    @property
    def varies(self) -> bool:
        """True if the gains change during the run."""
        return self.time is not None or super().varies

    def gains(self, observation: Observation, random: np.random.Generator) -> np.ndarray:
        """Return the gains, shape (Nants, Nfreqs, 1 or Ntimes, Npols), with a draw for every polarization."""
        components = self.shape.components(observation.frequencies)
        deviations = self._drawn(observation.n_antennas, components, observation, random)
        if self.common > 0:
            shared = self._drawn(1, components, observation, random)
            deviations = np.sqrt(1 - self.common) * deviations + np.sqrt(self.common) * shared
        real, imaginary = deviations
        return np.moveaxis(1 + self.sigma * (real + 1j * imaginary), (0, 1, 2, 3), (2, 0, 3, 1))

    def _drawn(
        self, count: int, components: np.ndarray, observation: Observation, random: np.random.Generator
    ) -> np.ndarray:
        """Return x and y of `count` antennas, (2, 1 or Ntimes, Nants, Npols, Nfreqs)."""
        times = 1 if self.time is None else observation.n_times
        shape = 2, times, count, observation.n_polarizations, components.shape[1]
        drawn = random.standard_normal(shape)
        if self.time is not None:
            # An autoregressive process of first order: each integration keeps a part of the one before.
            kept = np.exp(-np.diff(observation.times) * SECONDS_PER_DAY / self.time)
            for place, part in enumerate(kept, start=1):
                drawn[:, place] = part * drawn[:, place - 1] + np.sqrt(1 - part**2) * drawn[:, place]
        return drawn @ components.T


class Swing(Section):
    """A sinusoidal change of a reflection, as by the temperature of a cable, with a random start for every antenna."""

    delay: Delay = Field(0.0, ge=0, description="Amplitude of the change of the delay.")
    amplitude: Fraction = Field(0.0, ge=0, lt=1, description="Amplitude of the relative change of r.")
    period: Time = Field(3600.0, gt=0, description="Duration of one oscillation.")
    antennas: Antennas = Field(
        (), description="Antennas whose reflections change, counted from 0 in the order of the layout; empty: all."
    )

    def at(self, observation: Observation, random: np.random.Generator) -> np.ndarray:
        """Return the change in units of its amplitude, (Npols, Nants, 1, Ntimes); zero for other antennas."""
        start = random.uniform(0, 2 * np.pi, (observation.n_polarizations, observation.n_antennas, 1, 1))
        seconds = (observation.times - observation.times[0]) * SECONDS_PER_DAY
        change = np.sin(2 * np.pi * seconds / self.period + start)
        return change if not self.antennas else change * is_named(self.antennas, observation)[..., 0]


class ReflectionGains(GainEffect):
    """One cable reflection per antenna: r exponential, tau normal, phi uniform (paper Eq. REFGAIN, §Low SNR).

    A cable with several reflections has one effect for each, with different seeds.
    """

    kind: str = "reflection-gains"
    amplitude: float = Field(0.01, ge=0, lt=1, description="Mean of the exponential distribution of r.")
    delay: Delay = Field(1200e-9, description="Mean of the normal distribution of the delay.")
    delay_scatter: Delay = Field(100e-9, ge=0, description="Standard deviation of that distribution.")
    antennas: Antennas = Field(
        (), description="Antennas with a reflection, counted from 0 in the order of the layout; empty: all."
    )
    swing: Swing | None = Field(None, description="How delay and r change during the run; null: they are constant.")
    seed: int = Field(5, ge=0, description="Seed of r, tau and phi.")

    def refusal(self, size: Size) -> str | None:
        """Refuse antennas that do not exist, and delays with which a reflection averages out within a channel."""
        longest = 1 / size.channels.width if size.channels.width else np.inf
        if abs(self.delay) > longest:
            return (
                f"delay: {self.delay:g} s must be at most {longest:.3g} s, one over the width of a channel, in which "
                "later reflections average out"
            )
        swinging = () if self.swing is None else self.swing.antennas
        for field, antennas in (("antennas", self.antennas), ("swing.antennas", swinging)):
            if (reason := refusal_of_antennas(antennas, size.antennas)) is not None:
                return f"{field}: {reason}"
        if self.antennas and (still := sorted(set(swinging) - set(self.antennas))):
            return f"swing.antennas: names antenna {still[0]}, which has no reflection; add it to antennas"
        return super().refusal(size)

    @property
    def varies(self) -> bool:
        """True if the gains change during the run."""
        return self.swing is not None or super().varies

    def gains(self, observation: Observation, random: np.random.Generator) -> np.ndarray:
        """Return the gains, shape (Nants, Nfreqs, 1 or Ntimes, Npols), with an independent draw for every polarization.

        Raise InputError if a drawn amplitude is not below one: such a reflection does not decay.
        """
        shape = (observation.n_polarizations, observation.n_antennas, 1, 1)
        amplitudes = random.exponential(self.amplitude, shape)
        if self.antennas:
            amplitudes = amplitudes * is_named(self.antennas, observation)[..., 0]
        delays = random.normal(self.delay, self.delay_scatter, shape)
        phases = random.uniform(0, 2 * np.pi, shape)
        if self.swing is not None:
            change = self.swing.at(observation, random)
            amplitudes, delays = amplitudes * (1 + self.swing.amplitude * change), delays + self.swing.delay * change
        if amplitudes.max() >= 1:
            raise InputError(
                f"corruption.effects: amplitude = {self.amplitude}: drew a reflection of {amplitudes.max():.2f}, which "
                "must stay below 1; use a smaller mean"
            )
        return np.moveaxis(reflection_gain(observation.frequencies[:, None], amplitudes, delays, phases), 0, -1)


def reflection_gain(
    frequencies: np.ndarray, amplitude: float | np.ndarray, delay: float | np.ndarray, phase: float | np.ndarray
) -> np.ndarray:
    """Evaluate g = 1 / (1 + r exp[-i (2 pi nu tau + phi)]) (paper Eq. REFGAIN).

    Frequencies are in Hz; r is below 1, tau in s and phi in rad, numbers or arrays that broadcast with the frequencies.
    """
    return 1 / (1 + amplitude * np.exp(-1j * (2 * np.pi * frequencies * delay + phase)))


class FileGains(GainEffect):
    """Gains read from a file with the same antennas and channels; flagged ones count as unity.

    The file holds gains for one time, which are constant, or for as many as there are integrations, in order of time.
    """

    version: ClassVar[int] = 2

    kind: str = "file-gains"
    path: Path = Field(description="File of gains, relative to the experiment file or absolute.")

    def gains(self, observation: Observation, random: np.random.Generator) -> np.ndarray:
        """Return the gains, shape (Nants, Nfreqs, 1 or Ntimes, Npols).

        Raise InputError if the file cannot be read, lacks antennas, channels or polarizations of the observation, or
        has another number of times.
        """
        del random
        cal = read_gains(self.path, "corruption.effects: path", observation.uvd)
        values = gains_for(cal, observation.uvd)[:, :, np.argsort(solution_times(cal))]
        if values.shape[2] not in (1, observation.n_times):
            raise InputError(
                f"corruption.effects: path = {str(self.path)!r}: holds gains for {values.shape[2]} times; it must hold "
                f"them for one, or for each of the {observation.n_times} integrations"
            )
        return np.where(np.isfinite(values), values, 1)


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

    kind: str = "coarse-channels"
    width: Frequency = Field(
        1.28e6, gt=0, description="Width of coarse channels, which are centred at its multiples; by default the MWA's."
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
            return super().refusal(size)
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
