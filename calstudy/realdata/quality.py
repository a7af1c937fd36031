"""How well a finished calibration fits: outliers of gains and chi^2, and chi^2 of what was and was not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.time import Time
from pyuvdata import UVCal, UVData

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.files import rounded
from calstudy.base.gains import gain_products
from calstudy.base.visibilities import (
    antenna_pairs,
    flag_cube,
    from_cube,
    polarization_names,
    positions,
    rows_of,
    to_cube,
    use_bundled_earth_orientation,
)
from calstudy.calibrate.records import CalibrationResult
from calstudy.calibrate.settings import ForegroundFit, GainFit
from calstudy.calibrate.tangent_space import orthonormal
from calstudy.realdata.noise import MEDIAN_OVER_MEAN, radiometer_variance

if TYPE_CHECKING:
    from calstudy.calibrate.problem import CalibrationProblem

# Bandpasses and the antennas of an array differ by less than this; interference exceeds it by orders of magnitude.
GAIN_FACTOR = 5.0
# Means of pure noise over many samples scatter by a few per cent.
CHI2_FACTOR = 3.0
ABSORBED = 0.01
"""chi^2 per sample below which a fit has nothing left to compare: one with room for noise has its share of it."""
INTERFERENCE = (
    "interference? (--flag-interference, observed.flag_interference: true; if it is on, select a quieter band)"
)
BRIGHT = 2.0
"""Data of a channel over those of the median one, above which its high gains are ascribed to interference."""
NOISE = (
    "its data are as elsewhere: noise? (solve more integrations together, integrations_per_solve, or smooth the gains, "
    "smooth_gains)"
)
NAMED = 6
"""Largest number of channels or antennas named in a warning; solution.json has all of them."""
MOST_SAID = 1000
"""Largest ratio whose size is in a warning."""
NEIGHBOURS = 1.5
"""Largest distance of compared integrations, in integration times."""


@dataclass(frozen=True)
class Quality:
    """Gains and chi^2 of one polarization. NaN where everything is flagged.

    Attributes
    ----------
    antennas, frequency : names of the antennas with solutions, (Nants,), and channels in Hz, (Nfreqs,)
    gain_by_channel : |g| over the antenna's median, median over integrations, (Nants, Nfreqs)
    gain_by_antenna : median |g| of each antenna over the median of all antennas, (Nants,)
    data_by_channel : |V| over that of the median channel, median over baselines and integrations, (Nfreqs,)
    chi2_by_antenna, chi2_by_channel, chi2_by_integration
        Mean of |V - g g* F|^2 / sigma^2 over unflagged samples, (Nants,), (Nfreqs,), (Ntimes,). Parameters of the fit
        are not counted, so that it is slightly below one for noise.
    noise : the source of sigma, in words
    """

    polarization: str
    antennas: np.ndarray
    frequency: np.ndarray
    gain_by_channel: np.ndarray
    gain_by_antenna: np.ndarray
    data_by_channel: np.ndarray
    chi2_by_antenna: np.ndarray
    chi2_by_channel: np.ndarray
    chi2_by_integration: np.ndarray
    noise: str

    @property
    def warnings(self) -> list[str]:
        """Sentences that name the channels, antennas and integrations that stand out."""
        highest = np.fmax.reduce(self.gain_by_channel, axis=0)
        channels = [f"{frequency / 1e6:.3f} MHz" for frequency in self.frequency]
        integrations = [f"integration {index}" for index in range(self.chi2_by_integration.size)]
        antennas = [f"antenna {name}" for name in self.antennas]
        inverse = 1 / np.where(self.gain_by_antenna > 0, self.gain_by_antenna, np.nan)
        loud, quiet = (np.where((self.data_by_channel > BRIGHT) == bright, highest, np.nan) for bright in (True, False))
        found = [
            _sentence("|g| is far above the antenna's median", "x", channels, loud, GAIN_FACTOR, INTERFERENCE),
            _sentence("|g| is far above the antenna's median", "x", channels, quiet, GAIN_FACTOR, NOISE),
            _sentence("|g| is far above that of the other antennas", "x", antennas, self.gain_by_antenna, GAIN_FACTOR),
            _sentence(
                "|g| is far below that of the other antennas", "1/", antennas, inverse, GAIN_FACTOR, "a dead one?"
            ),
        ]
        level = _median(self.chi2_by_antenna)
        if level < ABSORBED:
            found.append(
                f"chi^2 is {level:.1g} per sample: the fit has about as many unknowns as there are samples, or the "
                f"noise is far below that of the {self.noise}"
            )
        compared = (
            (channels, self.chi2_by_channel),
            (antennas, self.chi2_by_antenna),
            (integrations, self.chi2_by_integration),
        )
        for names, values in () if level < ABSORBED else compared:
            found.append(_sentence("chi^2 is far above the median", "x", names, values / _median(values), CHI2_FACTOR))
        return [f"{self.polarization}: {sentence}" for sentence in found if sentence]

    def described(self) -> dict[str, Any]:
        """Return all numbers as plain JSON types, null for NaN."""
        return {
            "polarization": self.polarization,
            "noise": self.noise,
            "antennas": self.antennas.tolist(),
            "gain_by_antenna": rounded(self.gain_by_antenna),
            "gain_by_channel": rounded(np.fmax.reduce(self.gain_by_channel, axis=0)),
            **{
                name: rounded(getattr(self, name))
                for name in ("chi2_by_antenna", "chi2_by_channel", "chi2_by_integration")
            },
            "warnings": self.warnings,
        }


def _median(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size and np.median(finite) > 0 else np.nan


def _sentence(
    what: str, sign: str, names: Sequence[str], ratios: np.ndarray, factor: float, question: str = ""
) -> str | None:
    """Return a sentence that names entries with a ratio above a factor, the largest first; None if there are none."""
    order = [int(index) for index in np.argsort(-np.nan_to_num(ratios)) if ratios[index] > factor]
    if not order:
        return None
    shown = ", ".join(f"{names[index]} ({_ratio(sign, ratios[index])})" for index in order[:NAMED])
    more = f" and {len(order) - NAMED} more" if len(order) > NAMED else ""
    return f"{what}: {shown}{more}{f'; {question}' if question else ''}"


def _ratio(sign: str, value: float) -> str:
    """Return the text of a ratio; the size of gains that ran away says nothing."""
    if value > MOST_SAID:
        return f"below 1/{MOST_SAID}" if sign == "1/" else f"more than {MOST_SAID} x"
    return f"1/{value:.0f}" if sign == "1/" else f"{value:.0f} x" if value >= 10 else f"{value:.1f} x"


def assess(data: UVData, result: CalibrationResult, polarization: int = 0) -> Quality:
    """Compute the gain ratios and chi^2 of a calibration.

    The noise is that of the radiometer equation, sigma^2 = V_aa V_bb / (channel width x integration time x nsamples),
    if the data have the autocorrelations of all calibrated antennas. Otherwise it is the median of |V - g g* F|, the
    same for all samples, and chi^2 only shows which parts are worse than others. `data` are those of
    `calstudy.calibrate.execution.run_calibrator`, and `polarization` is an index. Autocorrelations, whose noise is
    another, are left out.
    """
    gains, (crosses, pairs) = result.gains, _cross_pairs(result.model)
    numbers = np.unique(pairs)
    rows = positions(gains.ant_array, numbers)
    flags = gains.flag_array[rows, :, :, polarization]
    values = np.where(flags, np.nan, gains.gain_array[rows, :, :, polarization])
    by_channel, by_antenna = _gain_ratios(np.abs(values))
    first, second = np.searchsorted(numbers, pairs).T
    products = gain_products(gains, pairs)[0][..., polarization]
    unused, residual = (of(result.residual)[..., polarization][:, crosses] for of in (flag_cube, to_cube))
    power = np.abs(np.where(unused, np.nan, residual * products)) ** 2
    measured = np.where(unused, np.nan, np.abs(to_cube(data)[..., polarization][:, rows_of(data, pairs)]))
    brightness = np.ma.median(np.ma.masked_invalid(measured), axis=(0, 1)).filled(np.nan)
    variance = radiometer_variance(data, pairs, polarization)
    noise = "autocorrelations, by the radiometer equation"
    if variance is None:
        noise = "the median of the residuals, for the data have no autocorrelations"
        scale = _median(power) / MEDIAN_OVER_MEAN
        chi2 = power / (scale if scale > 0 else np.nan)
    else:
        chi2 = power / variance
    names = dict(zip(data.telescope.antenna_numbers.tolist(), data.telescope.antenna_names, strict=True))
    touching = [(first == row) | (second == row) for row in range(numbers.size)]
    return Quality(
        polarization=polarization_names([result.model.polarization_array[polarization]]),
        antennas=np.array([str(names[int(number)]) for number in numbers]),
        frequency=np.asarray(result.model.freq_array, float),
        gain_by_channel=by_channel,
        gain_by_antenna=by_antenna,
        data_by_channel=brightness / _median(brightness),
        chi2_by_antenna=np.array([_mean(chi2[:, chosen], ()) for chosen in touching]).ravel(),
        chi2_by_channel=_mean(chi2, (2,)),
        chi2_by_integration=_mean(chi2, (0,)),
        noise=noise,
    )


def _cross_pairs(data: UVData) -> tuple[np.ndarray, np.ndarray]:
    """Return which baselines are cross-correlations, bool, (Nbls,), and the antenna numbers of these, (N, 2)."""
    pairs = antenna_pairs(data)
    crosses = pairs[:, 0] != pairs[:, 1]
    return crosses, pairs[crosses]


def _mean(values: np.ndarray, kept: tuple[int, ...]) -> np.ndarray:
    """Return the mean of finite values over all axes but those kept, NaN where there is none."""
    axes = tuple(axis for axis in range(values.ndim) if axis not in kept)
    return np.ma.filled(np.ma.masked_invalid(values).mean(axis=axes), np.nan)


def _gain_ratios(amplitudes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return |g| over each antenna's median, (Nants, Nfreqs), and that median over the array's, (Nants,)."""
    masked = np.ma.masked_invalid(amplitudes)
    own = np.ma.median(masked, axis=(1, 2)).filled(np.nan)
    by_channel = np.ma.median(masked, axis=2).filled(np.nan) / np.where(own > 0, own, np.nan)[:, None]
    return by_channel, own / _median(own)


def count_unknowns(problem: CalibrationProblem, settings: GainFit) -> float | None:
    """Return the number of complex unknowns of a fit that cross-correlations determine; None if others determine some.

    Others are a prior and autocorrelations. Unknowns without data are left out, of an antenna in a channel or of a
    foreground model, and so is the phase of each channel, which nothing determines. The overall scale is one real
    number and is not counted.
    """
    structure = problem.structure
    if settings.autos or (isinstance(settings, ForegroundFit) and settings.foreground_prior.finite):
        return None
    used, has_data = problem.weights > 0, problem.antenna_weights > 0
    phases = np.asarray(has_data.any(axis=0))
    found = _ranks(structure.gain_vectors, has_data) - 0.5 * _ranks(structure.gain_vectors, phases)
    modelled = np.zeros((structure.basis.n_models, structure.n_frequencies), bool)
    np.logical_or.at(modelled, structure.groups, used)
    buckets = () if problem.frozen else structure.basis.buckets
    return found + sum(_ranks(bucket.vectors, modelled[bucket.members]) for bucket in buckets)


def _ranks(vectors: np.ndarray | None, used: np.ndarray) -> int:
    """Return the number of sequences, (Nfreqs, Nvec), that used channels, (..., Nfreqs), determine, summed over rows.

    None are all channels by themselves.
    """
    if vectors is None:
        return int(np.count_nonzero(used))
    masks, counts = np.unique(np.atleast_2d(used), axis=0, return_counts=True)
    ranks = [orthonormal(mask[None].astype(float), vectors).shape[-1] for mask in masks]
    return int(np.dot(ranks, counts))


def predicted(gains: UVCal, model: UVData) -> UVData:
    """Return the visibilities that a solution predicts, g_a g_b* F, flagged where there is no solution.

    `gains` are of all antennas of the model F, which is calibrated.
    """
    products, unsolved = gain_products(gains, antenna_pairs(model))
    found = from_cube(model, to_cube(model) * products)
    flag_cube(found)[:] |= unsolved
    return found


def chi_squared(data: UVData, prediction: UVData) -> tuple[float, int]:
    """Return chi^2, the sum of |V - prediction|^2 / sigma^2 over cross-correlations, and the number of samples.

    sigma is from the autocorrelations of `data`. The prediction is of some of the baselines, at the same times.
    """
    (crosses, pairs), total, count = _cross_pairs(prediction), 0.0, 0
    rows = rows_of(data, pairs)
    misfit = np.abs(to_cube(data)[:, rows] - to_cube(prediction)[:, crosses]) ** 2
    unused = flag_cube(data)[:, rows] | flag_cube(prediction)[:, crosses]
    for pol in range(data.Npols):
        variance = radiometer_variance(data, pairs, pol)
        if variance is None:
            raise ValueError("chi^2 needs the autocorrelations of all antennas")
        used = ~unused[..., pol] & np.isfinite(variance)
        total += float(np.sum(misfit[..., pol][used] / variance[used]))
        count += int(used.sum())
    return total, count


def held_out(data: UVData, prediction: UVData) -> tuple[float, int]:
    """Return chi^2 of integrations that were not fitted, from the solutions of the integrations before and after.

    g_a g_b* F does not depend on the degeneracies of a fit. That of the two neighbours, fringe-stopped to the
    integration between them, is averaged: the sky that moves linearly in between cancels. `data`, with
    autocorrelations, was not fitted; `prediction` is g_a g_b* F of the other integrations. The number of samples is
    zero if no integration lies between two others.
    """
    use_bundled_earth_orientation()
    total, count = 0.0, 0
    times, known = (np.unique(uvd.time_array) for uvd in (data, prediction))
    longest = NEIGHBOURS * float(np.max(data.integration_time)) / SECONDS_PER_DAY
    for time in times:
        before, after = known[known < time], known[known > time]
        if not before.size or not after.size or max(time - before[-1], after[0] - time) > longest:
            continue
        own = _stopped(_at(data, [time]), time)
        moved = [_stopped(_at(prediction, [other]), time) for other in (before[-1], after[0])]
        rows = rows_of(own, antenna_pairs(prediction))
        template = own.select(blt_inds=rows, inplace=False, run_check=False)
        mean = from_cube(template, (to_cube(moved[0]) + to_cube(moved[1])) / 2)
        mean.flag_array = moved[0].flag_array | moved[1].flag_array
        found, samples = chi_squared(own, mean)
        total, count = total + found, count + samples
    return total, count


def _at(data: UVData, times: list[float]) -> UVData:
    return data.select(blt_inds=np.flatnonzero(np.isin(data.time_array, times)), inplace=False, run_check=False)


def _stopped(data: UVData, time: float) -> UVData:
    """Return data phased to the point that is at the zenith at the given Julian date."""
    found = data.copy()
    found.phase_to_time(Time(time, format="jd", scale="utc"))
    return found
