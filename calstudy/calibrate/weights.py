"""Weights of the likelihood: inverse variances, sample counts, flags, or a file; and samples that deserve none.

Noise that is received with the sky is multiplied by the gains as the sky is, so that the variance of a visibility is
proportional to |g_a g_b|^2. With other weights, errors of the foregrounds that are smooth in frequency become errors of
the gains with the spectral structure of |g_a g_b|^2: with gains that are white in frequency they are white, and at all
delays.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pyuvdata import UVData, UVFlag

from calstudy.base.errors import InputError
from calstudy.base.feeds import with_feeds_of
from calstudy.base.foreign_files import require_self_contained
from calstudy.base.observation import Observation
from calstudy.base.visibilities import polarization_names, positions
from calstudy.calibrate.interface import Calibrator
from calstudy.calibrate.settings import NOISE_UNKNOWN, FileWeights, ForegroundFit, WeightedFit, Weights

# Times of weights and data agree within this, in days.
TIME_TOLERANCE = 1e-6
FAR = 30.0
"""Amplitudes of an antenna this many times the median of the antennas, or less than its inverse, are reported."""
FEW = 0.05
"""With data in a smaller fraction of the channels, a fit of foregrounds and gains is unreliable; this is reported."""
MUCH = 0.05
"""A larger fraction of the unflagged samples that has no weight is reported."""
WEIGHTLESS = {
    "nsamples": "their numbers of samples are zero; correct them",
    "autos": "autocorrelations are flagged or not positive; repair or unflag them",
    "file": "the file has weights of zero; change it",
}
"""Why unflagged samples have no weight by a kind of weights, and the remedy."""


def make_weights(
    data: Observation, fitted: np.ndarray, settings: Weights, groups: Sequence[slice] | None = None
) -> np.ndarray:
    """Return the weight of every sample, zero where flagged or where an antenna was off (`dead_samples`).

    In each of the `groups` of integrations that are solved together, by default single ones, and each polarization
    their mean over unflagged samples is that of the paper, 1 / (Nbls Nfreqs).
    Weights from gains are those of unity gains; the solves change them. They are float64, (Ntimes, Nfitted, Nfreqs,
    Npols), for the baselines of the mask `fitted`, (Nbls,); the data include autocorrelations where weights need them.

    Raises InputError if sample counts are negative or not finite, if autocorrelations are needed and missing, or if a
    file does not fit the data or has weights that are complex, negative or not finite.
    """
    used = ~data.flags[:, fitted] & ~dead_samples(data, fitted)
    if settings.kind == "nsamples":
        weights = _counts(data, fitted, used, settings.kind)
    elif settings.kind == "autos":
        weights = _counts(data, fitted, used, settings.kind) * _from_autos(data, fitted)
    elif settings.kind == "file":
        weights = _from_file(data, settings)[:, fitted] * used
    else:
        weights = used.astype(float)
    size = weights.shape[1] * weights.shape[2]
    scaled = np.zeros_like(weights)
    for times in groups or [slice(t, t + 1) for t in range(len(weights))]:
        part = weights[times]
        count, total = (np.sum(values, axis=(0, 1, 2)) for values in (part > 0, part))
        scaled[times] = part * (count / size / np.where(total > 0, total, 1))
    return scaled


def require_finite(data: Observation) -> None:
    """Raise InputError unless all unflagged visibilities are finite."""
    bad = ~(np.isfinite(data.visibilities) | data.flags)
    if bad.any():
        t, baseline, channel, _ = np.argwhere(bad)[0]
        a, b = data.pairs[baseline]
        raise InputError(
            f"{bad.sum()} unflagged visibilities are not finite, the first on baseline ({a}, {b}), integration {t}, "
            f"channel {channel}; flag them"
        )


def _counts(data: Observation, fitted: np.ndarray, used: np.ndarray, kind: str) -> np.ndarray:
    """Return the numbers of measurements of samples, zero where they are not used."""
    counts = np.where(used, data.nsamples[:, fitted], 0)
    if (bad := ~np.isfinite(counts) | (counts < 0)).any():
        raise InputError(
            f"weights: {kind!r} needs counts that are finite and not negative, and {bad.sum()} unflagged samples have "
            "others; flag them, or use weights: gains"
        )
    return counts


def inverse_variances(
    data: Observation, fitted: np.ndarray, weights: np.ndarray, settings: ForegroundFit, noise: float | None
) -> np.ndarray:
    """Scale weights in each integration and polarization so that their mean is that of 1 / sigma^2.

    Samples of zero weight do not count. Weights are as from `make_weights`, (Ntimes, Nfitted, Nfreqs, Npols). sigma is
    `settings.foreground_prior.noise`, or else `noise` (see `calstudy.calibrate.interface.Assumed`). Without either,
    weights from autocorrelations use the radiometer equation, sigma^2 = V_aa V_bb / (channel width x integration time x
    nsamples).

    Raises InputError if the noise is unknown or zero.
    """
    used = weights > 0
    sigma = settings.foreground_prior.noise or noise
    if sigma is None and settings.weights.kind == "autos":
        samples = abs(float(np.mean(data.uvd.channel_width))) * float(np.mean(data.uvd.integration_time))
        precision = _from_autos(data, fitted) * data.nsamples[:, fitted] * samples
    elif sigma:
        precision = data.nsamples[:, fitted] / sigma**2
    else:
        raise InputError(NOISE_UNKNOWN)
    wanted, found = (np.sum(values * used, axis=(1, 2), keepdims=True) for values in (precision, weights))
    return weights * (wanted / np.where(found > 0, found, 1))


def _from_autos(data: Observation, fitted: np.ndarray) -> np.ndarray:
    """Return 1 / (V_aa V_bb), zero where either is flagged or not positive."""
    antennas, autos = data.antennas[fitted], np.flatnonzero(data.autos)
    missing = data.numbers[np.setdiff1d(antennas, data.antennas[autos])]
    if missing.size:
        lacking = ", ".join(map(str, missing))
        raise InputError(f"weights: 'autos' needs autocorrelations, which the data lack for antenna(s) {lacking}")
    power = np.where(data.flags, 0, np.nan_to_num(data.visibilities.real))
    inverse = np.where(power > 0, 1 / np.where(power > 0, power, 1), 0)
    first, second = autos[positions(data.antennas[autos, 0], antennas)].T
    return inverse[:, first] * inverse[:, second]


def _from_file(data: Observation, settings: FileWeights) -> np.ndarray:
    """Return the file's weights in the order of the data, shape (Ntimes, Nbls, Nfreqs, Npols)."""
    where = f"weights.path = {str(settings.path)!r}"
    file = with_feeds_of(_read_uvflag(settings.path, where), data.uvd)
    values = file.metric_array if file.mode == "metric" else ~file.flag_array
    if np.iscomplexobj(values):
        raise InputError(f"{where}: weights must be real, these are complex")
    if not np.isfinite(values).all() or (values < 0).any():
        raise InputError(f"{where}: weights must be finite and not negative")
    of_file = np.ravel(file.freq_array)
    channels = np.abs(of_file[:, None] - data.frequencies).argmin(axis=0)
    if not np.allclose(of_file[channels], data.frequencies, rtol=1e-9, atol=0):
        raise InputError(f"{where}: no weights for some channels of the data")
    rows = {key: row for row, key in enumerate(_keys(file))}
    wanted, flagged = _keys(data.uvd), data.flags.all(axis=(2, 3)).ravel()
    if any(key not in rows for key, without in zip(wanted, flagged, strict=True) if not without):
        raise InputError(f"{where}: no weights for some baselines or integrations of the data")
    hands = [np.flatnonzero(file.polarization_array == pol) for pol in data.polarizations]
    if any(hand.size != 1 for hand in hands):
        raise InputError(f"{where}: no weights for some polarizations of the data")
    # The weights of flagged samples are not used.
    found = values[[rows.get(key, 0) for key in wanted]][:, channels][:, :, np.concatenate(hands)]
    return found.astype(float).reshape(data.shape)


def _keys(file: UVData | UVFlag) -> list[tuple[int, int, int]]:
    """Return both antennas, the smaller number first, and time, in units of the tolerance, of each row of a file."""
    times = np.round(file.time_array / TIME_TOLERANCE).astype(int)
    pairs = np.sort(np.column_stack([file.ant_1_array, file.ant_2_array]), axis=1)
    return [(a, b, time) for (a, b), time in zip(pairs.tolist(), times.tolist(), strict=True)]


def _read_uvflag(path: Path, where: str) -> UVFlag:
    require_self_contained(path)
    try:
        file = UVFlag(str(path))
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{where}: not a readable UVFlag file ({error})") from None
    if file.type != "baseline":
        raise InputError(f"{where}: holds values by {file.type}, weights are needed by baseline")
    return file


def dead_samples(data: Observation, chosen: np.ndarray) -> np.ndarray:
    """Find samples that are exactly zero because an antenna was off, bool, (Ntimes, Nchosen, Nfreqs, Npols).

    An antenna is off in a channel of an integration if all its baselines that are not flagged are exactly zero there.
    `chosen`, bool, (Nbls,), selects baselines.
    """
    zero = ~data.flags[:, chosen] & (data.visibilities[:, chosen] == 0)
    if not zero.any():
        return zero
    alive = ~data.flags & (data.visibilities != 0) & chosen[:, None, None]
    has_data = data.antennas_of(np.moveaxis(alive, 1, 0))
    first, second = (np.moveaxis(has_data[column], 0, 1) for column in data.antennas[chosen].T)
    return zero & ~(first & second)


def conspicuous(data: Observation, calibrator: Calibrator | None = None) -> list[str]:
    """Describe antennas that are lost, zero or have outlying amplitudes, and integrations with few channels.

    Antennas may be lost by the weights of the calibrator.
    """
    crosses = ~data.autos
    dead, antennas = dead_samples(data, crosses), data.antennas[crosses]
    live = ~data.flags[:, crosses] & ~dead
    counts, sums = live.sum(axis=(0, 2, 3)), np.zeros(len(antennas))
    for time, used in enumerate(live):
        sums += np.sum(np.abs(data.visibilities[time, crosses]), axis=(1, 2), where=used)
    amplitudes = np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)
    own, zeros = np.full(len(data.numbers), np.nan), []
    for antenna, number in enumerate(data.numbers):
        touching = (antennas == antenna).any(axis=1)
        if np.isfinite(amplitudes[touching]).any():
            own[antenna] = np.nanmedian(amplitudes[touching])
        elif dead[:, touching].any():
            zeros.append(str(number))
    found = []
    if dead.any():
        whole = f", all that there are of antenna(s) {', '.join(zeros)}" if zeros else ""
        found = [f"{dead.sum()} samples are exactly zero, as all of an antenna then, and count as flagged{whole}."]
    found += _flagged(data, crosses)
    if isinstance(calibrator, WeightedFit) and calibrator.weights.kind in WEIGHTLESS:
        found += _weightless(data, crosses, live, calibrator.weights)
    median = np.nanmedian(own) if np.isfinite(own).any() else np.nan
    for antenna in np.flatnonzero((own > FAR * median) | (own < median / FAR)).tolist():
        found.append(
            f"Antenna {data.numbers[antenna]}: amplitudes of its visibilities are {own[antenna] / median:.2g} times "
            "the median of the antennas; flag it if it is broken, for it can decide the gains of all others."
        )
    channels = live.any(axis=1).sum(axis=1)
    few = (channels > 0) & (channels < FEW * data.n_channels)
    if few.any():
        most = f"{channels[few].max()} of {data.n_channels}"
        found.append(
            f"{few.any(axis=1).sum()} integration(s) have data in at most {most} channels: gains that are fitted "
            "together with foregrounds mean nothing there."
        )
    return found


def _flagged(data: Observation, crosses: np.ndarray) -> list[str]:
    """Name antennas whose cross-correlations are all flagged, of polarizations with others that are not."""
    have_data = _in(data, crosses, ~data.flags[:, crosses])
    flagged = _in(data, crosses, np.ones_like(data.flags[:, crosses])) & ~have_data & have_data.any(axis=0)
    if not flagged.any():
        return []
    return [f"All visibilities of antenna(s) {_named(data, flagged)} are flagged, in {data.n_times} integration(s)."]


def _weightless(data: Observation, crosses: np.ndarray, live: np.ndarray, settings: Weights) -> list[str]:
    """Tell how many samples of cross-correlations with data have no weight, and name antennas that keep none."""
    weighted = make_weights(data, crosses, settings) > 0
    lost = _in(data, crosses, live) & ~_in(data, crosses, weighted)
    fraction = 1 - weighted.sum() / max(live.sum(), 1)
    if not lost.any() and not live.any() * fraction > MUCH:
        return []
    whole = f", all of antenna(s) {_named(data, lost)} among them" if lost.any() else ""
    return [
        f"{100 * fraction:.3g} % of the unflagged samples have no weight by weights: {settings.kind}, and count as "
        f"flagged{whole}: {WEIGHTLESS[settings.kind]}, or use weights: gains or flags."
    ]


def _in(data: Observation, crosses: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return which antennas have some of the samples of cross-correlations in a polarization, (Nants, Npols)."""
    used = np.zeros((data.n_baselines, data.n_polarizations), bool)
    used[crosses] = samples.any(axis=(0, 2))
    return data.antennas_of(used)


def _named(data: Observation, chosen: np.ndarray) -> str:
    """Return the numbers of antennas, with the polarizations where these are not all, of a mask (Nants, Npols)."""
    names = []
    for number, own in zip(data.numbers[chosen.any(axis=1)], chosen[chosen.any(axis=1)], strict=True):
        names.append(str(number) if own.all() else f"{number} ({polarization_names(data.polarizations[own])})")
    return ", ".join(names)
