"""Errors of fitted gains by the noise, from the Gauss-Newton matrix of the fit.

In units in which the noise is white, data change by y, and gains g (1 + eta) respond to first order with

    eta = H^-1 J^T W y,   H = J^T W J,

where J is the Jacobian of the relative changes eta, and W takes away what foregrounds absorb
(`calstudy.calibrate.expected_loss`). Noise of variance s^2 in each of the real and imaginary parts of y gives eta the
covariance s^2 H^-1. For free foregrounds W is a projector. With a finite prior it is the inverse covariance of noise
and foregrounds together, and s^2 H^-1 is the covariance of the posterior. The real part of eta is the relative error of
the amplitude, along the gain; the imaginary part is the error of the phase, across it.

Some directions are not determined, and are no part of the errors:

- ``phase``: of all gains in each channel, which no data determine;
- ``scale``: of all gains, where foregrounds are free or the scale is fixed afterwards;
- ``smooth``: gains that are smooth in frequency, where foregrounds are free. Gains times foregrounds are then other
  foregrounds, and a fit goes far along such directions for little. The change is of the order of one, not of the
  noise, and its squares and cubes have two and three times its delays. Errors are therefore of what is left of gains
  without the sequences up to `ORDERS` times the largest delay of the foregrounds.

Phase and scale are those of `calstudy.calibrate.degeneracy.align`. `GainErrors.determined` takes all these directions
out of a difference of gains.

Where weights are inverse variances of complex samples, which a finite prior needs, s^2 is 1/2. Others are relative, and
s^2 is the loss over the degrees of freedom: the real numbers in the data, less coefficients of foregrounds and gains,
plus exact degeneracies. Smooth gains count as determined there: far from where they started, they fit noise.

The errors are those of noise of which the weights are the inverse variance, up to a factor, and to first order. What
does not change from one noise realization to the next has no part in them: errors of a sky model that has no prior, and
foregrounds outside their basis. They are part of the residual, and there they count as noise, as the signal does.

Where an antenna receives nothing but noise, its gains are what the fit makes of noise: the modulus of a gain over its
error has a mean square of two if foregrounds are known, and more by the noise that free foregrounds follow on the
baselines of the antenna. `GainErrors.lost` are antennas with less than `LOST` times this. Their signal to noise is for
given foregrounds and for the noise of their own baselines, the median over these and channels: one broken antenna
changes the noise that all gains have in common, and the foregrounds of all.

What foregrounds absorb takes most of the time. It changes variances by a factor over those of known foregrounds, which
hardly changes while the sky turns by less than a fringe, and which `ErrorsInTime` keeps for that time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.calibrate.basis import gain_vectors
from calstudy.calibrate.gain_variances import Alignment, as_a_whole, by_antenna, by_channel
from calstudy.calibrate.problem import CalibrationProblem, FitStructure, gain_products
from calstudy.calibrate.tangent_space import SPAN_CUTOFF, TangentSpace

ORDERS = 3
"""Powers of a smooth change of the gains that are larger than the noise."""
MOST_UNKNOWNS = 2048
"""Largest number of real unknowns, besides smooth ones, whose matrix is inverted as a whole."""
TURNS_PER_DAY = 1.00274
"""Of the sky."""
SIMILAR = 0.05
"""Relative change of deviations of the foregrounds, or of the weights, that changes errors by less."""
LOST = 2.0
"""Signal to noise, over that which noise alone makes, below which gains of an antenna are lost. In fits to 7 and 10
antennas a dead one has 0.9 to 1.5 with known foregrounds, 1.2 to 2.5 with free ones. One whose visibilities are as
large as the noise has 1.5 to 3.6; three times as large, 3.7 or more."""
LEAST = 0.1
"""Least fraction of the noise that is taken to be left in the residual."""
NoiseFrom = Literal["weights", "residual"]


class Absorption(NamedTuple):
    """What foregrounds absorb: a number of complex numbers in the data, `sequences`, and what it does to variances.

    `variances` are those of gains over those with known foregrounds, (2, Nants, Nfreqs); of amplitudes, then phases.
    """

    variances: np.ndarray
    sequences: int


@dataclass(frozen=True, eq=False)
class GainErrors:
    """Standard deviations of the gains of one solve by noise; NaN for antennas without data in a channel.

    `amplitude` is that of |g| and `phase` that of the phase, (Nants, Nfreqs). `degrees` of freedom of the residual are
    None where they do not enter. Directions that are `left_out` are no part of the errors; `determined` takes them out
    of a relative change of the gains, complex, (Nants, Nfreqs). `smooth_delay` is the largest delay of ``smooth`` ones,
    zero if there are none, and `smooth_fraction` their part of the numbers in the gains. `unevenness` is the mean over
    the median of the residual's power in channels: about one for noise, more for interference. `signal_to_noise` is
    that of |g| of each antenna for given foregrounds, the median over channels, and `noise_alone` what noise alone
    makes of it, (Nants,). `noise_from` says whether the variance of the noise is that of the weights, or from the
    residual of this solve, and `absorbed` what foregrounds absorb.
    """

    amplitude: np.ndarray = field(metadata={"unit": ""})
    phase: np.ndarray = field(metadata={"unit": "rad"})
    noise_from: NoiseFrom
    degrees: int | None
    left_out: tuple[str, ...]
    smooth_delay: float = field(metadata={"unit": "s"})
    smooth_fraction: float
    unevenness: float
    determined: Callable[[np.ndarray], np.ndarray]
    absorbed: Absorption
    signal_to_noise: np.ndarray
    noise_alone: np.ndarray

    @property
    def lost(self) -> np.ndarray:
        """Whether the gains of an antenna cannot be told from those of noise, (Nants,); none if `drowned`."""
        return self._as_noise & (not self.drowned)

    @property
    def drowned(self) -> bool:
        """Whether most antennas cannot be told from noise, so that there is too much of it for all of them."""
        return bool(2 * np.count_nonzero(self._as_noise) > len(self._as_noise))

    @property
    def _as_noise(self) -> np.ndarray:
        return self.signal_to_noise < LOST * self.noise_alone

    def summary(self, gains: np.ndarray) -> dict[str, Any]:
        """Return the median errors and signal to noise, and what they mean, as plain JSON types."""
        relative = float(np.nanmedian(self.amplitude / np.abs(gains)))
        return {
            "median_relative_amplitude": relative,
            "median_phase": float(np.nanmedian(self.phase)),
            "median_signal_to_noise": 1 / relative if relative > 0 else None,
            "noise_from": self.noise_from,
            "degrees_of_freedom": self.degrees,
            "left_out": list(self.left_out),
            "smooth_delay": self.smooth_delay,
            "smooth_fraction": self.smooth_fraction,
            "unevenness": self.unevenness,
        }


def gain_errors(
    problem: CalibrationProblem,
    gains: np.ndarray,
    model: np.ndarray,
    frequencies: np.ndarray,
    absorbed: Absorption | None = None,
) -> GainErrors | str:
    """Compute the errors of gains by noise, or say in a sentence why there are none.

    The fitted problem has the weights of its last pass; its solution is complex, (Nants, Nfreqs) and (Nbls, Nfreqs).
    Frequencies are channel centres, Hz, (Nfreqs,). `absorbed` is that of a similar problem; by default it is computed.
    """
    structure = problem.structure
    if structure.gain_vectors is not None:
        return "the gains are restricted to smooth functions, whose errors are not known"
    tangent, has_data = TangentSpace.at(problem, gains, model), problem.antenna_weights > 0
    alignment = Alignment.at(problem, gains, has_data)
    sequences = absorbed.sequences if absorbed is not None else tangent.n_sequences
    degrees = 2 * (np.count_nonzero(problem.weights) - np.count_nonzero(has_data) - sequences) + alignment.n_aligned
    if not tangent.finite and degrees < 1:
        return "the fit has as many unknowns as data, and leaves no residual that tells the noise"
    free = not problem.frozen and not tangent.finite
    delay = ORDERS * max(bucket.half_width for bucket in structure.basis.buckets) if free else 0.0
    spans = determined_spans(frequencies, delay, has_data)
    if not any(span.size for span in spans):
        return f"foregrounds can follow gains up to delays of {delay * 1e9:.0f} ns, and the channels resolve no others"
    unknowns = 2 * sum(span.shape[1] for span in spans)
    variances = known = by_channel(tangent, structure.antennas, alignment)
    if absorbed is not None:
        variances = known * absorbed.variances
    elif not problem.frozen and unknowns <= MOST_UNKNOWNS:
        variances = as_a_whole(tangent, structure.antennas, alignment, spans)
    elif not problem.frozen:
        variances = by_antenna(tangent, structure.antennas, alignment, spans, known)
    fitted = gain_products(gains, structure.antennas) * model
    residual = problem.visibilities - fitted
    powers = np.sum(problem.weights * np.abs(residual) ** 2, axis=0)
    loss, powers = float(np.sum(powers)), powers[has_data.any(axis=0)]
    sigma = np.where(has_data, np.sqrt(variances * (0.5 if tangent.finite else loss / degrees)), np.nan)

    def determined(change: np.ndarray) -> np.ndarray:
        kept = within(spans, change)
        real, imaginary = alignment.align(np.stack([kept.real, kept.imag]))
        return real + 1j * imaginary

    return GainErrors(
        np.abs(gains) * sigma[0],
        sigma[1],
        "weights" if tangent.finite else "residual",
        None if tangent.finite else int(degrees),
        ("phase", *(["scale"] if alignment.of_all is not None else []), *(["smooth"] if free else [])),
        delay,
        1 - unknowns / (2 * np.count_nonzero(has_data)),
        float(np.mean(powers) / np.median(powers)) if loss > 0 else 1.0,
        determined,
        Absorption(np.divide(variances, known, out=np.zeros(known.shape), where=known > 0), sequences),
        *_signal_to_noise(problem, fitted, residual, sequences if free else 0),
    )


def _signal_to_noise(
    problem: CalibrationProblem, fitted: np.ndarray, residual: np.ndarray, sequences: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the signal to noise of each antenna, and what noise alone makes of it, (Nants,); NaN without data.

    `fitted` and `residual` are g_a g_b* F and what is left of the data, (Nbls, Nfreqs); `sequences` is the number of
    complex numbers in the data that free foregrounds follow.
    """
    used, found = problem.weights > 0, np.full((2, problem.structure.n_antennas), np.nan)
    for antenna in range(problem.structure.n_antennas):
        own = (problem.structure.antennas == antenna).any(axis=1)
        samples, channels = used[own].sum(), used[own].any(axis=0)
        if not samples:
            continue
        signal = np.sum(np.abs(fitted[own]) ** 2, axis=0, where=used[own])[channels]
        followed = channels.sum() / samples + sequences / used.sum()
        # The median: interference in some channels, and a broken antenna at the other end, do not count.
        noise = np.median(np.abs(residual[own][used[own]]) ** 2) / np.log(2) / max(1 - followed, LEAST)
        found[0, antenna] = np.sqrt(2 * np.median(signal) / noise) if noise > 0 else np.inf
        found[1, antenna] = np.sqrt(2 * followed * samples / channels.sum())
    return found[0], found[1]


class _Last(NamedTuple):
    structure: FitStructure
    weights: np.ndarray
    deviations: tuple[float, float]
    time: float
    absorbed: Absorption


class ErrorsInTime:
    """Errors of solves of one polarization, in the order of time; see `gain_errors`.

    Frequencies are channel centres, Hz, (Nfreqs,), and `longest` is the longest baseline, m.
    """

    def __init__(self, frequencies: np.ndarray, longest: float) -> None:
        self._frequencies = frequencies
        self._fringe = SPEED_OF_LIGHT / (frequencies.max() * longest) / (2 * np.pi * TURNS_PER_DAY)
        self._last: _Last | None = None

    def of(
        self, problem: CalibrationProblem, gains: np.ndarray, model: np.ndarray, time: float, settled: bool = True
    ) -> GainErrors | str:
        """Return the errors of a solve at a time, a Julian date in days.

        What foregrounds absorb is kept from solves that have settled.
        """
        absorbed = self._known(problem, time)
        found = gain_errors(problem, gains, model, self._frequencies, absorbed)
        if absorbed is None and settled and isinstance(found, GainErrors):
            self._last = _Last(problem.structure, problem.weights, problem.deviations, time, found.absorbed)
        return found

    def _known(self, problem: CalibrationProblem, time: float) -> Absorption | None:
        """Return the last absorption if it is of the same samples and prior, and within a fringe; else None."""
        last = self._last
        if last is None or not 0 <= time - last.time < self._fringe or problem.structure != last.structure:
            return None
        if not np.array_equal(problem.weights > 0, last.weights > 0):
            return None
        # A finite prior is weighed against the noise.
        if problem.structure.prior != "none":
            levels = [np.mean(weights) for weights in (problem.weights, last.weights)]
            if not np.allclose([*problem.deviations, levels[0]], [*last.deviations, levels[1]], SIMILAR, atol=0):
                return None
        return last.absorbed


def within(spans: Sequence[np.ndarray], change: np.ndarray) -> np.ndarray:
    """Return what a change of the gains, (Nants, Nfreqs), has within a span of each antenna, (Nfreqs, N)."""
    return np.stack([span @ (span.T @ row) for span, row in zip(spans, change, strict=True)])


def determined_spans(frequencies: np.ndarray, delay: float, has_data: np.ndarray) -> list[np.ndarray]:
    """Return an orthonormal basis, (Nfreqs, N), of what each antenna has in channels with data beyond a delay in s.

    Smooth sequences are those of the band that foregrounds are modelled in, from the first to the last channel with
    data, (Nants, Nfreqs). A delay of zero leaves none out.
    """
    smooth = None
    if delay > 0:
        channels = np.flatnonzero(has_data.any(axis=0))
        smooth = gain_vectors(frequencies, delay, slice(int(channels[0]), int(channels[-1]) + 1))
    known: dict[bytes, np.ndarray] = {}
    for used in np.unique(has_data, axis=0):
        span = np.eye(len(used))[:, used]
        if smooth is not None and used.any():
            left, singular, _ = np.linalg.svd(smooth[used])
            span = span @ left[:, np.count_nonzero(singular > SPAN_CUTOFF) :]
        known[used.tobytes()] = span
    return [known[used.tobytes()] for used in has_data]
