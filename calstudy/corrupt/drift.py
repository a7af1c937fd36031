"""Random functions from which gains are drawn: smooth in frequency, and changes during a run.

A drift multiplies the gains of each antenna by exp(u + i v), with u and v processes in time. u is the change of ln|g|,
that is, the relative change of the amplitude while it is small, and v that of the phase.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.schema import Section, choice
from calstudy.base.units import Delay, Frequency, Phase, Time
from calstudy.instrument.as_built import Antennas

if TYPE_CHECKING:
    from calstudy.base.observation import Observation


class _Shape(Section, ABC):
    @abstractmethod
    def components(self, frequencies: np.ndarray) -> np.ndarray:
        """Return functions of frequency (Hz), float64, (Nfreqs, Ncomponents); their squares sum to a band mean of 1."""


class Polynomial(_Shape):
    """Legendre polynomials over the band, up to an order, of equal rms."""

    kind: Literal["polynomial"]
    order: int = Field(3, ge=0, le=20, description="Highest order; 0: one number for all channels.")

    def components(self, frequencies: np.ndarray) -> np.ndarray:
        """Return the polynomials, of equal rms over the channels."""
        middle = (frequencies.max() + frequencies.min()) / 2
        place = (frequencies - middle) / max(np.ptp(frequencies) / 2, 1.0)
        values = np.polynomial.legendre.legvander(place, self.order)
        return values / np.sqrt(np.mean(values**2, axis=0) * values.shape[1])


class Delays(_Shape):
    """A Gaussian process with a flat delay spectrum up to a delay, hence a sum of DPSS with their concentrations."""

    kind: Literal["delays"]
    max_delay: Delay = Field(100e-9, gt=0, description="Largest delay of the structure.")

    def components(self, frequencies: np.ndarray) -> np.ndarray:
        """Return the symmetric root of the covariance sin(2 pi tau nu) / (2 pi tau nu) between channels."""
        return _symmetric_root(np.sinc(2 * self.max_delay * (frequencies[:, None] - frequencies)))


class Correlated(_Shape):
    """A Gaussian process with a correlation that falls with the separation in frequency."""

    kind: Literal["correlated"]
    length: Frequency = Field(
        1e6, ge=0, description="Correlation length; 0: channels are independent, whatever their width."
    )
    form: Literal["gaussian", "exponential"] = Field(
        "gaussian",
        description="Correlation at the separation nu: exp(-nu^2 / (2 length^2)), or exp(-|nu| / length), whose delay "
        "spectrum has a tail as 1 / delay^2.",
    )

    def correlation(self, separations: np.ndarray) -> np.ndarray:
        """Return the correlation at separations in Hz, float64, of the same shape."""
        if self.length == 0:
            return (separations == 0).astype(float)
        ratio = np.abs(separations) / self.length
        return np.exp(-(ratio**2) / 2 if self.form == "gaussian" else -ratio)

    def components(self, frequencies: np.ndarray) -> np.ndarray:
        """Return the symmetric root of the covariance between channels."""
        return _symmetric_root(self.correlation(frequencies[:, None] - frequencies))


def _symmetric_root(covariance: np.ndarray) -> np.ndarray:
    """Return the symmetric root of a covariance; unlike eigenvectors, of arbitrary signs and order, it is unique."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T


Shape = Annotated[Polynomial | Delays | Correlated, choice("kind", "polynomial")]
Channels = Annotated[Literal["common", "independent"] | Polynomial | Delays | Correlated, choice("kind", "polynomial")]


class _Drift(Section, ABC):
    """Base of all drifts: independent processes of amplitude and phase for every antenna and polarization."""

    amplitude: float = Field(
        0.01,
        ge=0,
        description="Of the relative change of the amplitude of the gains, see the kind; the default is a "
        "choice of this project.",
    )
    phase: Phase = Field(
        0.01, ge=0, description="Of the change of their phase, see the kind; the default is a choice of this project."
    )
    channels: Channels = Field(
        "common",
        description="Whether all channels of an antenna change alike, or each by itself; or the shape in frequency of "
        "the change, of which every component is a process of its own: `amplitude` and `phase` are then in the mean "
        "over the band.",
    )
    antennas: Antennas = Field(
        (), description="Antennas whose gains drift, counted from 0 in the order of the layout; empty: all."
    )
    seed: int = Field(50, ge=0, description="Together with the seed of the effect.")

    def stream(self, effect_seed: int | None) -> int | tuple[int, int]:
        """Return what seeds the drift of an effect with a seed, or of one that draws nothing."""
        # NumPy ignores zeros at the end of a list, which gives the stream of the number without them.
        return (self.seed, effect_seed) if effect_seed else self.seed

    def factors(self, observation: Observation, effect_seed: int | None) -> np.ndarray:
        """Return the factors of the gains, complex128, shape (Nants, Nfreqs or 1, Ntimes, Npols).

        Drifts of two effects are independent if their seeds or the seeds of the effects differ.
        """
        random = np.random.default_rng(self.stream(effect_seed))
        seconds = (observation.times - observation.times[0]) * SECONDS_PER_DAY
        if isinstance(self.channels, str):
            n_processes = observation.n_channels if self.channels == "independent" else 1
        else:
            components = self.channels.components(observation.frequencies)
            n_processes = components.shape[1]
        shape = (2, observation.n_antennas, n_processes, observation.n_polarizations)
        processes = self.unit_process(shape, seconds, random)
        if not isinstance(self.channels, str):
            processes = np.einsum("fc,xacpt->xafpt", components, processes, optimize=True)
        amplitude, phase = np.moveaxis(processes, -1, -2)
        factors = np.exp(self.amplitude * amplitude + 1j * self.phase * phase)
        # Draws of an antenna do not depend on which others drift.
        return factors if not self.antennas else np.where(is_named(self.antennas, observation), factors, 1)

    @abstractmethod
    def unit_process(self, shape: tuple[int, ...], seconds: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Return independent processes of unit amplitude, float64, (*shape, Ntimes).

        `shape` is (2, Nants, Nfreqs or Ncomponents or 1, Npols); `seconds`, (Ntimes,), are since the first.
        """


def is_named(antennas: Sequence[int], observation: Observation) -> np.ndarray:
    """Return which antennas of an observation are named, by their place in the layout, bool, (Nants, 1, 1, 1)."""
    numbers = np.asarray(observation.uvd.telescope.antenna_numbers)[list(antennas)]
    return np.isin(observation.numbers, numbers)[:, None, None, None]


def refusal_of_antennas(antennas: Sequence[int], count: int) -> str | None:
    """Return why antennas cannot be named in an array of `count`, or None if they can."""
    if antennas and max(antennas) >= count:
        return f"names antenna {max(antennas)}, but there are {count} antennas, counted from 0"
    return None


class RandomWalk(_Drift):
    """A random walk from the drawn gains: normal steps, variances grow linearly in time."""

    kind: Literal["random-walk"]
    time: Time = Field(
        100.0,
        gt=0,
        description="Time after which the rms change is `amplitude` and `phase`; the default is a choice of "
        "this project.",
    )

    def unit_process(self, shape: tuple[int, ...], seconds: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Return walks that start at zero, of variance t / time."""
        steps = random.standard_normal((*shape, len(seconds)))
        return np.cumsum(steps * np.sqrt(np.diff(seconds, prepend=seconds[0]) / self.time), axis=-1)


class Sinusoid(_Drift):
    """A sinusoid about the drawn gains, of amplitude `amplitude` and `phase`, with a random start for every antenna."""

    kind: Literal["sinusoid"]
    period: Time = Field(
        100.0, gt=0, description="Duration of one oscillation; the default is a choice of this project."
    )

    def unit_process(self, shape: tuple[int, ...], seconds: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Return sinusoids of unit amplitude."""
        start = random.uniform(0, 2 * np.pi, (*shape, 1))
        return np.sin(2 * np.pi * seconds / self.period + start)


class Jumps(_Drift):
    """Jumps between integrations at random times, each normal with an rms of `amplitude` and `phase`; they add up."""

    kind: Literal["jumps"]
    interval: Time = Field(
        100.0,
        gt=0,
        description="Mean time between jumps of an antenna (a Poisson process); the default is a choice of "
        "this project.",
    )

    def unit_process(self, shape: tuple[int, ...], seconds: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Return sums of the jumps so far: zero up to the first."""
        waits = np.diff(seconds, prepend=seconds[0]) / self.interval
        _, n_antennas, n_processes, n_polarizations = shape
        # The components of a shape jump together.
        n_counts = n_processes if self.channels == "independent" else 1
        counts = random.poisson(waits, (n_antennas, n_counts, n_polarizations, len(seconds)))
        # The sum of n normal jumps is normal with variance n.
        return np.cumsum(np.sqrt(counts) * random.standard_normal((*shape, len(seconds))), axis=-1)


Drift = Annotated[RandomWalk | Sinusoid | Jumps, choice("kind")]
