"""Compare gains, foreground models and residuals of a fit with the truth (paper §Simulation Results), and their errors.

Every number has its scatter over the antennas, baselines or integrations on which it was measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.calibrate.degeneracy import align
from calstudy.calibrate.problem import gain_products
from calstudy.power.clusters import Clusters
from calstudy.power.delay import channel_width, delay_transform, delays, horizon_delay

if TYPE_CHECKING:
    from calstudy.calibrate.gain_errors import GainErrors


TAPER = "blackman-harris"
MAIN_LOBE = 4
"""Half-width of the taper's main lobe, in units of 1 / bandwidth."""
ROUNDING = 1e-24
"""Powers below this part of the largest are rounding."""


@dataclass(frozen=True)
class Statistic:
    """A median (or the quantity of its name), half the width of the central 68 %, and the number and kind of values."""

    value: float
    scatter: float
    count: int
    over: str

    @classmethod
    def of(cls, values: np.ndarray, over: str) -> Statistic:
        """Return the median and the scatter of finite values of any shape."""
        low, median, high = np.quantile(np.ravel(values), [0.16, 0.5, 0.84])
        return cls(float(median), float(high - low) / 2, int(np.size(values)), over)

    @classmethod
    def worst(cls, values: np.ndarray) -> Statistic:
        """Return the largest of the values at delays."""
        return cls(float(values.max()), 0.0, values.size, "delays")


@dataclass(frozen=True, eq=False)
class Truth:
    """The parts of a simulated measurement; visibilities are complex, (Ntimes, Nbls, Nfreqs), in Jy.

    True gains are (Ntimes, Nants, Nfreqs). Foregrounds F and noise N are without gains, data are with them. Flagged
    samples are zero, here and in `Fit`.
    """

    gains: np.ndarray
    foregrounds: np.ndarray
    noise: np.ndarray
    data: np.ndarray


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a calibration: gains (Ntimes, Nants, Nfreqs), intrinsic foregrounds and calibrated residual R.

    Model and residual are (Ntimes, Nbls, Nfreqs), in Jy.
    """

    gains: np.ndarray
    model: np.ndarray
    residual: np.ndarray


@dataclass(frozen=True, eq=False)
class Baselines:
    """Rows of the two antennas of each baseline among the gains, (Nbls, 2), their lengths in m, (Nbls,), and channels.

    Channel centres are in Hz, (Nfreqs,). The wedge ends at a delay of the horizon plus `buffer`, s.
    """

    antennas: np.ndarray
    lengths: np.ndarray
    frequency: np.ndarray
    buffer: float

    @cached_property
    def delay(self) -> np.ndarray:
        """Ascending delays, s, (Ndelays,)."""
        return delays(self.frequency.size, channel_width(self.frequency))

    @property
    def inside(self) -> np.ndarray:
        """Mask of the delays within the horizon, (Nbls, Ndelays)."""
        return np.abs(self.delay) <= horizon_delay(self.lengths[:, None])

    @property
    def outside(self) -> np.ndarray:
        """Mask of the delays beyond horizon and buffer, or beyond the main lobe of the taper if that is wider."""
        lobe = MAIN_LOBE / (channel_width(self.frequency) * self.frequency.size)
        return np.abs(self.delay) > horizon_delay(self.lengths[:, None]) + max(self.buffer, lobe)

    def delay_power(self, spectra: np.ndarray) -> np.ndarray:
        """Return |V~|^2 averaged over integrations, (Nbls, Ndelays), of spectra (Ntimes, Nbls, Nfreqs)."""
        power = np.zeros(spectra.shape[1:])
        for integration in spectra:
            power += np.abs(delay_transform(integration, self.frequency, TAPER)) ** 2
        return power / len(spectra)


def compare_with_truth(truth: Truth, fit: Fit, baselines: Baselines) -> dict[str, Statistic]:
    """Compare a fit with the truth, and return statistics by name.

    Ratios are of rms amplitudes. "Aligned" quantities are free of the phases and the scale that no fit can determine
    (`calstudy.calibrate.degeneracy.align`), "raw" ones are as fitted. Names that end in "outside" or "inside" refer to
    delays beyond or within the horizon of each baseline; those that no baseline has are left out.
    """
    found = _gains(truth, fit, baselines) | _models(truth, fit) | _fitted_data(truth, fit, baselines)
    return found | _residuals(truth, fit, baselines)


def _rms(values: np.ndarray, axis: int | tuple[int, ...]) -> np.ndarray:
    return np.sqrt(np.mean(values.real**2 + values.imag**2, axis=axis))


def aligned_gains(fitted: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Align fitted with true gains in their degenerate phases and scale, (Ntimes, Nants, Nfreqs)."""
    return np.stack([align(*both)[0] for both in zip(fitted, true, strict=True)])


def gain_errors(fitted: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the rms over channels of fitted minus true gains relative to the rms of the true ones, (N,).

    Gains are complex, (Ntimes, Nants, Nfreqs), and zero where there is no solution; those are left out.
    """
    size = _rms(true, axis=2)
    known = size > 0
    return _rms(fitted - true, axis=2)[known] / size[known]


def _gains(truth: Truth, fit: Fit, baselines: Baselines) -> dict[str, Statistic]:
    aligned = aligned_gains(fit.gains, truth.gains)
    power = [
        np.mean(np.abs(delay_transform(values, baselines.frequency, TAPER)) ** 2, axis=(0, 1))
        for values in (truth.gains, aligned - truth.gains, fit.gains - truth.gains)
    ]
    # The power of unit gains is zero at some delays.
    known = power[0] > ROUNDING * power[0].max()
    by_delay, raw_by_delay = (np.sqrt(part[known] / power[0][known]) for part in power[1:])
    return {
        "gains_aligned": Statistic.of(gain_errors(aligned, truth.gains), "antennas and integrations"),
        "gains_raw": Statistic.of(gain_errors(fit.gains, truth.gains), "antennas and integrations"),
        "gains_by_delay": Statistic.of(by_delay, "delays"),
        "gains_worst_delay": Statistic.worst(by_delay),
        "gains_raw_by_delay": Statistic.of(raw_by_delay, "delays"),
        "gains_raw_worst_delay": Statistic.worst(raw_by_delay),
    }


def _models(truth: Truth, fit: Fit) -> dict[str, Statistic]:
    scales = np.array([align(*both)[1] for both in zip(fit.gains, truth.gains, strict=True)])
    size = _rms(truth.foregrounds, axis=(0, 2))
    aligned = fit.model / scales[:, None, None] ** 2 - truth.foregrounds
    error = _rms(aligned, axis=(0, 2))
    return {
        "model_aligned": Statistic.of(error / size, "baselines"),
        "model_raw": Statistic.of(_rms(fit.model - truth.foregrounds, axis=(0, 2)) / size, "baselines"),
        "model_over_noise": Statistic.of(error / _rms(truth.noise, axis=(0, 2)), "baselines"),
    }


def _fitted_data(truth: Truth, fit: Fit, baselines: Baselines) -> dict[str, Statistic]:
    difference = truth.data - gain_products(fit.gains, baselines.antennas) * fit.model
    noise = gain_products(truth.gains, baselines.antennas) * truth.noise
    ratio = np.sqrt(baselines.delay_power(difference).mean(axis=0) / baselines.delay_power(noise).mean(axis=0))
    error = _rms(difference, axis=(0, 2))
    return {
        "product_over_noise": Statistic.of(error / _rms(noise, axis=(0, 2)), "baselines"),
        "product_over_data": Statistic.of(error / _rms(truth.data, axis=(0, 2)), "baselines"),
        "product_worst_delay": Statistic.worst(ratio),
        **_correction(truth, fit, baselines),
    }


def _correction(truth: Truth, fit: Fit, baselines: Baselines) -> dict[str, Statistic]:
    """Return the gain-correction ratio beyond the wedge, over the noise relative to the foregrounds."""
    true, fitted = (gain_products(gains, baselines.antennas) for gains in (truth.gains, fit.gains))
    ratio = np.divide(true, fitted, out=np.ones_like(fitted), where=fitted != 0) - 1
    relative_noise = truth.noise / _rms(truth.foregrounds, axis=(0, 2))[:, None]
    above, below = (baselines.delay_power(values) for values in (ratio, relative_noise))
    return _ratio("correction_over_noise_outside", above, below, baselines.outside)


def _residuals(truth: Truth, fit: Fit, baselines: Baselines) -> dict[str, Statistic]:
    data, residual, noise = (baselines.delay_power(values) for values in (truth.data, fit.residual, truth.noise))
    return {
        **_ratio("residual_over_noise_outside", residual, noise, baselines.outside),
        **_ratio("residual_over_noise_inside", residual, noise, baselines.inside),
        **_ratio("data_over_residual_outside", data, residual, baselines.outside),
        **_ratio("data_over_noise_outside", data, noise, baselines.outside),
    }


def _ratio(name: str, above: np.ndarray, below: np.ndarray, mask: np.ndarray) -> dict[str, Statistic]:
    """Return the ratio of rms amplitudes at the marked delays, of powers (Nbls, Ndelays), if any baseline has any."""
    used = mask.any(axis=1)
    if not used.any():
        return {}
    means = [(np.sum(values, axis=1, where=mask) / np.maximum(mask.sum(axis=1), 1))[used] for values in (above, below)]
    return {name: Statistic.of(np.sqrt(means[0] / means[1]), "baselines")}


def as_json(statistics: Mapping[str, Statistic]) -> dict[str, Any]:
    """Return statistics as plain JSON types."""
    return {name: asdict(statistic) for name, statistic in statistics.items()}


def from_json(values: Mapping[str, Any]) -> dict[str, Statistic]:
    """Return the statistics that `as_json` converted."""
    return {name: Statistic(**value) for name, value in values.items()}


@dataclass(frozen=True, eq=False)
class Realization:
    """One measurement of one integration whose parts are known; complex, (Nbls, Nfreqs) each, in Jy.

    The residual of a fit is noise, the signal, and an error e. The part of e that two noise realizations share survives
    the cross power of even and odd: it is the bias of P^R. Here the noise is known, and is subtracted to find e.

    Visibilities are as measured, gains included; the noise is before the gains, and `gain_products` are the true ones.
    """

    visibilities: np.ndarray
    noise: np.ndarray
    gain_products: np.ndarray

    def residual_without_noise(self, fitted_products: np.ndarray, model: np.ndarray) -> np.ndarray:
        """Return the noise-free residual on the scale of the true gains, independent of degeneracies of the fit.

        `fitted_products` and `model` are g_a g_b* and F as fitted, (Nbls, Nfreqs).
        """
        return (self.visibilities - fitted_products * model) / self.gain_products - self.noise


def cross_power(even: np.ndarray, odd: np.ndarray, baselines: Baselines) -> np.ndarray:
    """Sum Re <even* odd> of each baseline over its delays outside the wedge, (Nbls,), (Jy Hz)^2.

    Visibilities are of one integration, complex, (Nbls, Nfreqs), in Jy.
    """
    first, second = (delay_transform(values, baselines.frequency, TAPER) for values in (even, odd))
    return np.sum((first.conj() * second).real, axis=1, where=baselines.outside)


def ratio_over_antennas(power: np.ndarray, reference: np.ndarray, antennas: np.ndarray) -> tuple[float, float]:
    """Return sum(power) / sum(reference) over baselines, (Nbls,) each, and its standard deviation.

    The foreground residual of a fit is mostly due to errors of its gains, which the baselines of an antenna share. The
    standard deviation comes from leaving out one antenna after the other (`calstudy.power.clusters`). `antennas` are
    the two of each baseline, (Nbls, 2).
    """
    clusters = Clusters.of_baselines(antennas)
    above, below = (clusters.sums(values[:, None], np.repeat(values, 2)[:, None]) for values in (power, reference))
    value, error = above.ratio(below)
    return float(value[0]), float(error[0])


EXPECTED = np.arange(1, 100) / 100
"""Fractions of a normal distribution within limits around zero, with which those of the deviations are compared."""
LIMITS = (1.0, SIGMAS_95)
"""Limits in units of the error, within which there are 68.3 and 95 %."""
ALLOWED = ((0.6827, 0.03), (0.95, 0.02))
"""Fractions within these limits, and how far observed ones may be from them."""
PARTS = ("amplitude", "phase")


def pulls(errors: GainErrors, gains: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return deviations from the true gains over their errors, of amplitudes and phases, (2, Nants, Nfreqs).

    Gains are complex, (Nants, Nfreqs). What errors leave out is taken out of the deviations. NaN without an error.
    """
    known = np.isfinite(errors.phase)
    ratio = np.divide(gains, true, out=np.ones(gains.shape, complex), where=known)
    # The common phase of a channel may be anywhere, and logarithms are of what is close to one.
    common = np.sum(np.where(known, np.abs(gains) ** 2 * ratio / np.abs(ratio), 0), axis=0)
    change = errors.determined(np.log(ratio * np.exp(-1j * np.angle(common))))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([change.real * np.abs(gains) / errors.amplitude, change.imag / errors.phase])


@dataclass(frozen=True)
class GainCoverage:
    """Fractions of the pulls of several solves, NaN for antennas without errors.

    `observed` are those of amplitudes and of phases within the limits of the fractions `EXPECTED`, (Nsolves, 2,
    Nexpected), and `within` the same of each antenna within `LIMITS`, (Nsolves, 2, Nants, 2).
    """

    observed: np.ndarray
    within: np.ndarray

    @classmethod
    def of(cls, found: list[np.ndarray]) -> GainCoverage:
        """Return the fractions of the pulls of each solve, (2, Nants, Nfreqs)."""
        from scipy.stats import norm

        limits = norm.ppf((1 + EXPECTED) / 2)
        return cls(
            np.array([[_fractions(part.ravel(), limits) for part in solve] for solve in found]),
            np.array([[[_fractions(row, np.array(LIMITS)) for row in part] for part in solve] for solve in found]),
        )


def _fractions(values: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Return the fractions of the known values whose size is below each limit; NaN if none is known."""
    known = np.sort(np.abs(values[np.isfinite(values)]))
    return np.searchsorted(known, limits) / known.size if known.size else np.full(limits.shape, np.nan)


@dataclass(frozen=True)
class Covered:
    """Fractions of the deviations from the true gains, pooled over all realizations of the noise.

    Those of amplitudes and of phases, and the standard errors of these means, (2, Nexpected), belong to `expected` ones
    of a normal distribution, (Nexpected,), and to those within 1 and 1.96 errors, (2, 2). `worst` are the latter of the
    antenna that is farthest from what is expected.
    """

    expected: np.ndarray
    observed: np.ndarray
    error: np.ndarray
    within: np.ndarray
    within_error: np.ndarray
    worst: np.ndarray
    realizations: int


def pooled(parts: Sequence[GainCoverage]) -> Covered:
    """Pool solves with independent noise."""
    observed, within = (np.concatenate([getattr(part, name) for part in parts]) for name in ("observed", "within"))
    within = within[:, :, np.isfinite(within).any(axis=(0, 1, 3))]
    antennas = np.nanmean(within, axis=0)
    means, root = np.nanmean(within, axis=2), np.sqrt(len(within))
    right = np.array([fraction for fraction, _ in ALLOWED])
    worst = np.nanargmax(np.abs(antennas - right), axis=1)
    return Covered(
        EXPECTED,
        observed.mean(axis=0),
        observed.std(axis=0, ddof=1) / root,
        means.mean(axis=0),
        means.std(axis=0, ddof=1) / root,
        np.take_along_axis(antennas, worst[:, None], axis=1)[:, 0],
        len(within),
    )
