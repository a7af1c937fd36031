"""Call a calibrator, check what it returns, smooth gains, and compute the residual R = V / (g_a g_b*) - F.

Mistakes of a user's own calibrator are reported as InputError with its name; those of a built-in one are bugs.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np
from numpy.polynomial.legendre import legvander

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.errors import InputError
from calstudy.base.observation import Frame, Observation
from calstudy.base.plugins import FILE_REFERENCE, guarded, refusal_of
from calstudy.base.quiet import without_warnings
from calstudy.base.resources import Cost, Usage
from calstudy.base.visibilities import positions
from calstudy.calibrate.basis import channel_grid, dpss_vectors, restrict
from calstudy.calibrate.interface import (
    Assumed,
    Calibration,
    Calibrator,
    DpssSmoothing,
    PolynomialSmoothing,
    Progress,
    SmoothCal,
    SmoothGains,
)
from calstudy.calibrate.problem import gain_products
from calstudy.calibrate.records import CalibrationResult, Solve, Status, make_gains, make_visibilities
from calstudy.instrument.settings import Size

if TYPE_CHECKING:
    from pyuvdata import UVCal, UVData


EIGENVALUE_CUTOFF = 1e-9
"""Sequences with a smaller concentration are left out, as hera_cal does."""


def smooth(gains: np.ndarray, flags: np.ndarray, data: Observation, settings: SmoothGains) -> np.ndarray:
    """Smooth gains, (Nants, Nfreqs, Ntimes, Npols); flagged ones have no influence and stay as they are.

    Antennas, channels and integrations are those of `data`. Raises InputError if the reference antenna has no gains, or
    if channels or integrations are not even where they must be, or too few.
    """
    values = np.where(flags, 0, gains)
    if settings.reference_antenna is not None:
        if settings.reference_antenna not in data.numbers:
            raise _fault(f"reference_antenna: there is no antenna {settings.reference_antenna} in the data")
        reference = values[np.flatnonzero(data.numbers == settings.reference_antenna)[0]]
        if ((reference == 0) & ~flags.all(axis=0)).any():
            raise _fault(f"reference_antenna: antenna {settings.reference_antenna} is flagged where others are not")
        values = values * np.exp(-1j * np.angle(reference))
    if isinstance(settings, SmoothCal):
        if len(data.times) < 2:
            raise _fault("smooth-cal smooths over time, and there is a single integration")
        one = partial(_smooth_cal, data=data, settings=settings)
    else:
        in_frequency, in_time = _vectors(settings, data)
        one = partial(fit, in_frequency=in_frequency, in_time=in_time)
    smoothed = values.copy()
    for a, p in np.argwhere(~flags.all(axis=(1, 2))):
        smoothed[a, :, :, p] = one(values[a, :, :, p], ~flags[a, :, :, p])
    return np.where(flags, gains, smoothed)


def smoothly_turned(gains: np.ndarray) -> np.ndarray:
    """Turn the phase of each channel, which no data determine, so that it does not jump; zeros are unknown.

    Gains, (Nants, Nfreqs, Ntimes, Npols), agree best with those of the next channel, and of the next integration. A
    real sum over antennas, in contrast, has jumps where cable delays make it small, and smoothing would leave these to
    single antennas.
    """
    turned = gains.copy()
    for t, p in np.ndindex(gains.shape[2:]):
        for k in range(1, gains.shape[1]):
            turned[:, k, t, p] *= _agreeing(turned[:, k, t, p], (turned[:, e, t, p] for e in reversed(range(k))))
        turned[..., t, p] *= _agreeing(turned[..., t, p], (turned[..., e, p] for e in reversed(range(t))))
    return turned


def _agreeing(gains: np.ndarray, others: Iterable[np.ndarray]) -> complex:
    """Return the phase factor that turns gains to the first of others that have known ones of the same antennas."""
    for other in others:
        if common := np.vdot(gains, other):
            return complex(common / abs(common))
    return 1.0


def _fault(sentence: str) -> InputError:
    return InputError(f"calibration.smooth_gains: {sentence}")


def _vectors(
    settings: DpssSmoothing | PolynomialSmoothing, data: Observation
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return orthonormal functions of frequency (Nfreqs, Nf) and of time (Ntimes, Nt), None for all."""
    frequencies, seconds = data.frequencies, (data.times - data.times[0]) * SECONDS_PER_DAY
    if isinstance(settings, PolynomialSmoothing):
        return _polynomials(frequencies, settings.frequency_degree), _polynomials(seconds, settings.time_degree)
    scales = settings.frequency_scale, settings.time_scale
    return _sequences(frequencies, scales[0], "channels"), _sequences(seconds, scales[1], "integrations")


def _polynomials(x: np.ndarray, degree: int | None) -> np.ndarray | None:
    if degree is None or degree + 1 >= x.size:
        return None
    scaled = 2 * (x - x.min()) / np.ptp(x) - 1
    return np.linalg.qr(legvander(scaled, degree))[0]


def _sequences(x: np.ndarray, scale: float | None, noun: str) -> np.ndarray | None:
    """Return sequences whose Fourier transform is concentrated within 1 / scale; None if they span everything."""
    if scale is None or x.size < 2:
        return None
    try:
        grid = channel_grid(x)
    except InputError:
        raise _fault(f"the {noun} must lie on an even grid to be smoothed by sequences") from None
    half_bandwidth = grid.n_channels * grid.width / scale
    if 2 * half_bandwidth >= grid.n_channels:
        return None
    return restrict(dpss_vectors(grid.n_channels, half_bandwidth, EIGENVALUE_CUTOFF), grid, EIGENVALUE_CUTOFF)


def fit(
    values: np.ndarray, used: np.ndarray, in_frequency: np.ndarray | None, in_time: np.ndarray | None
) -> np.ndarray:
    """Fit products of functions of frequency and of time to the used values in least squares.

    `values` are complex, (Nfreqs, Ntimes), and `used` is bool, of the same shape. Functions are orthonormal columns,
    (Nfreqs, Nf) and (Ntimes, Nt); with None, each channel or integration is fitted by itself.
    """
    if in_frequency is None and in_time is None:
        return values
    if in_frequency is None:
        return fit(values.T, used.T, in_time, None).T
    if used.all():
        partial = in_frequency @ (in_frequency.T @ values)
        return partial if in_time is None else (partial @ in_time) @ in_time.T
    if in_time is None:
        return np.column_stack([_weighted(values[:, t], used[:, t], in_frequency) for t in range(values.shape[1])])
    functions = np.einsum("fi,tj->ftij", in_frequency, in_time).reshape(values.size, -1)
    return _weighted(values.ravel(), used.ravel(), functions).reshape(values.shape)


def _weighted(values: np.ndarray, used: np.ndarray, functions: np.ndarray) -> np.ndarray:
    """Fit functions (N, Nfunctions) to the used values (N,)."""
    if not used.any():
        return values
    # Functions that are degenerate on the used samples get the combination of minimum norm.
    kept = functions[used]
    inverse = np.linalg.pinv(kept.T @ kept, rcond=EIGENVALUE_CUTOFF, hermitian=True)
    return functions @ (inverse @ (kept.T @ values[used]))


def _smooth_cal(values: np.ndarray, used: np.ndarray, data: Observation, settings: SmoothCal) -> np.ndarray:
    """Smooth the used values, (Nfreqs, Ntimes), as hera_cal does."""
    from hera_cal.smooth_cal import time_freq_2D_filter

    with without_warnings():
        found, _ = time_freq_2D_filter(
            values.T,
            used.T.astype(float),
            data.frequencies,
            data.times,
            freq_scale=settings.frequency_scale / 1e6,
            time_scale=settings.time_scale,
            method="DPSS",
        )
    smoothed = np.asarray(found).T
    if not np.isfinite(smoothed[used]).all() or not smoothed[used].all():
        raise _fault("smooth-cal left gains that are not finite")
    return smoothed


def require_calibratable(calibrator: Calibrator, frame: Frame, has_sky_model: bool) -> None:
    """Raise InputError, with the calibrator's own sentence, if it refuses data of these baselines and channels."""
    if (reason := refusal_of(calibrator, frame, has_sky_model)) is not None:
        about_field = calibrator.is_about_field(reason)
        raise InputError(f"calibration.{reason}" if about_field else f"{_where(calibrator)}: {reason}")


def cost_of(calibrator: Calibrator, size: Size) -> Cost:
    """Return a calibrator's estimate of its cost for data of a size; raises InputError if that is not a Cost."""
    with guarded(calibrator):
        cost = calibrator.cost(size)
    if not isinstance(cost, Cost):
        raise InputError(f"{_where(calibrator)}: its cost is {cost!r}, not a calstudy.base.resources.Cost")
    return cost


def run_calibrator(
    calibrator: Calibrator,
    data: UVData,
    sky_model: UVData | None = None,
    gains: UVCal | None = None,
    progress: Progress | None = None,
    noise: float | None = None,
) -> CalibrationResult:
    """Calibrate visibilities, and return gains, model and residual as standard objects.

    Raises InputError if the data or the sky model cannot be used, the calibrator refuses them, or a user's calibrator
    fails or returns an invalid calibration.

    Parameters
    ----------
    calibrator : any calibrator, built in or a user's
    data : visibilities, rectangular and time-major; not changed
    sky_model : visibilities of the known part of the sky, with the samples of `data`, or None; not changed
    gains : gains to start from, for an iterative calibrator; None for the calibrator's own start
    progress : called after each solve with the number done and the total
    noise : standard deviation of the noise of a sample (see `Assumed`); None if it is not known
    """
    observation = Observation(data)
    sky = None if sky_model is None else Observation(sky_model)
    if sky is not None:
        _require_usable(sky, observation)
    require_calibratable(calibrator, observation, sky is not None)
    with Usage() as usage, guarded(calibrator):
        returned = calibrator.calibrate(observation, Assumed(sky, gains, noise), progress)
    return _Returned(calibrator, returned, observation, sky).result(usage)


def _require_usable(sky_model: Observation, data: Observation) -> None:
    """Raise InputError unless a sky model has the samples of the data, and is finite where they are not flagged."""
    if (
        sky_model.shape != data.shape
        or not np.array_equal(sky_model.pairs, data.pairs)
        or not np.allclose(sky_model.frequencies, data.frequencies, rtol=1e-9, atol=0)
        or not np.allclose(sky_model.times, data.times, rtol=0, atol=1e-6)
        or not np.array_equal(sky_model.polarizations, data.polarizations)
    ):
        raise InputError(
            "the sky model must have the baselines, times, channels and polarizations of the data, in the same order"
        )
    if not (np.isfinite(sky_model.visibilities) | data.flags).all():
        raise InputError("the sky model is not finite where the data are not flagged")


def _where(calibrator: Calibrator) -> str:
    file = FILE_REFERENCE.fullmatch(calibrator.reference)
    name = Path(file["path"]).name if file is not None else calibrator.reference or type(calibrator).__name__
    return f"calibration.calibrator = {name!r}"


class _Returned:
    """A checked calibration; mistakes of a user's calibrator raise InputError, those of a built-in one ValueError."""

    def __init__(
        self, calibrator: Calibrator, returned: Calibration, observation: Observation, sky_model: Observation | None
    ) -> None:
        self.calibrator, self.returned, self.sky_model = calibrator, returned, sky_model
        self._require(isinstance(returned, Calibration), f"returns {type(returned).__name__}, not a Calibration")
        self.groups = calibrator.solves(observation.n_times)
        self.fitted = observation
        if returned.baselines is not None:
            shape = (observation.n_baselines,)
            self.fitted = observation.baselines(self._mask("baselines", returned.baselines, shape, least=1))
        self.gains, self.gain_flags = self._gains()
        self.closure, self.model, self.outcomes = self._closure(), self._model(), self._outcomes()

    def _require(self, condition: bool, sentence: str) -> None:
        if not condition:
            kind = ValueError if self.calibrator.is_built_in else InputError
            raise kind(f"{_where(self.calibrator)}: {sentence}")

    def _mask(self, name: str, values: np.ndarray, shape: tuple[int, ...], least: int = 0) -> np.ndarray:
        """Return a mask of the calibration, bool, which must have this shape and at least so many marks."""
        mask = np.asarray(values)
        self._require(
            mask.dtype == bool and mask.shape == shape and int(np.count_nonzero(mask)) >= least,
            f"returns {name} of shape {mask.shape} and type {mask.dtype}, expected bool of shape {shape}"
            + (" with at least one True" if least else ""),
        )
        return mask

    def _gains(self) -> tuple[np.ndarray, np.ndarray]:
        """Return gains and their flags, (Nants, Nfreqs, Ntimes, Npols)."""
        gains, flags = self.returned.gains, self.returned.gain_flags
        if not isinstance(gains, np.ndarray):
            gains, flags = self._from_uvcal(gains, flags)
        n_times, _, n_channels, n_polarizations = self.fitted.shape
        counts = n_times, len(self.groups)
        shapes = [(self.fitted.n_antennas, n_channels, count, n_polarizations) for count in counts]
        self._require(
            gains.shape in shapes and gains.dtype.kind in "cfiu",
            f"returns gains of shape {gains.shape} and type {gains.dtype}, expected complex numbers of shape "
            f"{shapes[0]} (antennas, channels, integrations, polarizations)"
            + (f" or {shapes[1]}, one for each solve" if shapes[0] != shapes[1] else ""),
        )
        flags = np.zeros(gains.shape, bool) if flags is None else self._mask("gain_flags", flags, gains.shape)
        used = gains[~flags]
        self._require(
            bool(np.isfinite(used).all() and (used != 0).all()),
            "returns gains that are zero or not finite, and not flagged",
        )
        if gains.shape[2] != n_times:
            lengths = [group.stop - group.start for group in self.groups]
            gains, flags = np.repeat(gains, lengths, axis=2), np.repeat(flags, lengths, axis=2)
        return np.where(flags, 1, gains).astype(complex), flags.copy()

    def _from_uvcal(self, gains: UVCal, flags: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        from pyuvdata import UVCal

        self._require(
            isinstance(gains, UVCal) and gains.gain_array is not None,
            f"returns gains of type {type(gains).__name__}, expected an array or a UVCal of gains",
        )
        self._require(
            gains.gain_convention == "divide",
            f"returns gains of the convention {gains.gain_convention!r}; it must be 'divide'",
        )
        missing = sorted(set(self.fitted.numbers.tolist()) - set(gains.ant_array.tolist()))
        self._require(not missing, f"returns no gains for antenna {missing[0] if missing else ''}")
        rows = positions(gains.ant_array, self.fitted.numbers)
        return gains.gain_array[rows], gains.flag_array[rows] if flags is None else flags

    def _model(self) -> np.ndarray:
        model, sky_model, shape = self.returned.model, self.sky_model, self.fitted.shape
        if model is None and sky_model is not None:
            chosen = self.returned.baselines
            model = (sky_model if chosen is None else sky_model.baselines(np.asarray(chosen))).visibilities
        self._require(model is not None, "returns no model, and there is no sky model in its place")
        self._require(
            isinstance(model, np.ndarray) and model.shape == shape,
            f"returns a model of shape {getattr(model, 'shape', None)}, expected {shape} (integrations, baselines, "
            "channels, polarizations), or None for the sky model",
        )
        assert model is not None, "required above"
        finite = bool((np.isfinite(model) | self.fitted.flags).all())
        self._require(finite, "returns a model that is not finite for unflagged data")
        return model

    def _closure(self) -> np.ndarray | None:
        closure = self.returned.closure
        self._require(
            closure is None
            or (
                isinstance(closure, np.ndarray)
                and closure.shape == self.fitted.shape
                and bool(np.isfinite(closure).all() and (closure != 0).all())
            ),
            f"returns closure factors of shape {getattr(closure, 'shape', None)}, expected numbers that are finite and "
            f"not zero, of shape {self.fitted.shape} (integrations, baselines, channels, polarizations)",
        )
        return closure

    def _outcomes(self) -> list[Solve]:
        outcomes, count = self.returned.outcomes, len(self.groups) * self.fitted.n_polarizations
        outcomes = [outcomes] * count if isinstance(outcomes, Solve) else list(outcomes)
        self._require(
            len(outcomes) == count,
            f"returns {len(outcomes)} outcomes for {count} solves (one for each polarization and each "
            f"{self.calibrator.integrations_per_solve} integration(s))",
        )
        for outcome in outcomes:
            self._require(
                isinstance(outcome, Solve) and outcome.status in get_args(Status) and bool(outcome.message),
                f"returns an outcome {outcome!r}; it must be a Solve with a message, and its status one of "
                f"{', '.join(get_args(Status))}",
            )
        return outcomes

    def result(self, usage: Usage) -> CalibrationResult:
        """Return gains, model and residual as standard objects, with the records of all solves.

        A gain is flagged where its antenna has no data, in a channel of an integration: no unflagged sample of any
        fitted baseline. That holds for every calibrator, and also if integrations with data share the gain.
        """
        flags = np.array(self.fitted.flags)
        if self.returned.flags is not None:
            flags |= self._mask("flags", self.returned.flags, flags.shape)
        solves = itertools.product(range(self.fitted.n_polarizations), self.groups)
        for outcome, (p, times) in zip(self.outcomes, solves, strict=True):
            if not outcome.usable:
                flags[times, :, :, p] = True
        self.gain_flags |= ~self.fitted.antennas_of(np.moveaxis(~flags, 0, 2))
        gains = np.where(self.gain_flags, 1, self.gains)
        smoothing = self.calibrator.smooth_gains
        if smoothing is not None:
            if smoothing.reference_antenna is None:
                gains = np.where(self.gain_flags, 1, smoothly_turned(np.where(self.gain_flags, 0, gains)))
            gains = smooth(gains, self.gain_flags, self.fitted, smoothing)
        template = self.fitted.uvd
        residual = self._real_autos(self._residual(gains, flags))
        model = self._real_autos(self.model if self.closure is None else self.closure * self.model)
        result = CalibrationResult(
            make_gains(template, self.fitted.numbers, gains, self.gain_flags),
            make_visibilities(template, model, flags),
            make_visibilities(template, residual, flags),
            tuple(self._records(usage)),
        )
        sky = None if self.sky_model is None else self.sky_model.uvd
        if sky is not None and str(sky.vis_units).lower() == "jy" and self.calibrator.on_sky_scale:
            result.gains.gain_scale = result.model.vis_units = result.residual.vis_units = sky.vis_units
            for found in (result.gains, result.model, result.residual):
                found.pol_convention = sky.pol_convention
        return result

    def _residual(self, gains: np.ndarray, flags: np.ndarray) -> np.ndarray:
        """Compute V / (c_ab g_a g_b*) - F, zero where flagged, and add the flags of the gains to `flags`."""
        residual = np.zeros(self.fitted.shape, complex)
        first, second = self.fitted.antennas.T
        for t, p in np.ndindex(self.fitted.n_times, self.fitted.n_polarizations):
            flagged = self.gain_flags[:, :, t, p]
            flags[t, :, :, p] |= flagged[first] | flagged[second]
            unused = flags[t, :, :, p]
            products = gain_products(gains[:, :, t, p], self.fitted.antennas)
            if self.closure is not None:
                products = self.closure[t, :, :, p] * products
            calibrated = np.where(unused, 0, self.fitted.visibilities[t, :, :, p]) / products
            residual[t, :, :, p] = np.where(unused, 0, calibrated - self.model[t, :, :, p])
        return residual

    def _real_autos(self, values: np.ndarray) -> np.ndarray:
        """Return values, shaped like visibilities, with real autocorrelations: g g* is complex by rounding."""
        autos = self.fitted.autos
        return np.where(autos[:, None, None], values.real, values) if autos.any() else values

    def _records(self, usage: Usage) -> list[Solve]:
        share, cpu_share = (value / len(self.outcomes) for value in (usage.seconds, usage.cpu_seconds))
        solves = itertools.product(self.fitted.polarizations, self.groups)
        return [
            replace(
                outcome,
                loss_history=np.asarray(outcome.loss_history, float),
                seconds=share if outcome.seconds is None else outcome.seconds,
                cpu_seconds=cpu_share if outcome.cpu_seconds is None else outcome.cpu_seconds,
                peak_memory=usage.peak_memory if outcome.peak_memory is None else outcome.peak_memory,
                integration=times.start,
                n_integrations=times.stop - times.start,
                time=float(self.fitted.times[times.start]),
                polarization=int(polarization),
            )
            for outcome, (polarization, times) in zip(self.outcomes, solves, strict=True)
        ]
