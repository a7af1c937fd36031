"""Starting point of a solve on any array: one delay for each antenna and, with a sky model, one complex gain.

A cable delay tau_a turns the gain of an antenna by exp(2 pi i nu tau_a). In V_ab = g_a g_b* F_ab it shifts the
foregrounds in delay by tau_a - tau_b. The delays of all antennas follow from the shifts of all baselines.

With a sky model m, V m* has the phase of g_a g_b*, and its delay spectrum is a narrow peak at the shift: the fringe fit
of interferometry, here with the powers of the baselines of an antenna added up (Schwab & Cotton 1983). One complex gain
per antenna then follows from least squares over all channels or, on request, one in every channel, with m as the truth.

Without a sky model, foregrounds are known to lie within the horizon delay b/c of a baseline of length b. The power in a
Gaussian of half this width,

    S_ab(D) = sum_tau |V_ab(tau)|^2 exp(-(tau - D)^2 / 2 sigma_ab^2),    sigma_ab = b / 2c + 1 / 2B,

with the bandwidth B, is greatest where D is the shift plus the mean delay of the foregrounds. The wider the Gaussian,
the weaker the constraint from a baseline. A gradient of delay over the array is degenerate with a displacement of the
sky. It is attributed to the sky as far as it exceeds the gradient expected of cables with the measured scatter
(`_sky_gradient`). Amplitudes and phases of antennas cannot be separated from those of the foregrounds, and are left as
they are.

In both cases the delays are those with the greatest sum of S_ab(tau_a - tau_b) over baselines. Noise has a flat S, so
that an antenna without signal does not change the delays of the others.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import fft, ifft, next_fast_len
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.errors import InputError
from calstudy.base.observation import Observation
from calstudy.calibrate.basis import channel_grid
from calstudy.calibrate.settings import DelayStart

PADDING = 4
"""Delays are searched on a grid this much finer than the inverse bandwidth."""
LARGEST_SAMPLE = 3.0
"""Samples are at most this times the median modulus of their baseline, against interference that is not flagged."""
LEAST_CORRELATION = 1e-3
"""Without a sky model, the foregrounds of adjacent channels of the shortest baseline must be correlated this much."""
SMALLEST_GAIN = 0.01
"""Gains are at least this times the median: a solver cannot leave zero."""
SKY_SCATTER = 0.2
"""How far the mean direction of foregrounds is from the zenith, in direction cosines east and north."""
ROBUST_ITERATIONS = 10
"""Iterations to find antennas with outlying delays."""
SWEEPS = 20
"""Maximum number of rounds of moving antennas one by one; two or three usually suffice."""
GAIN_ITERATIONS = 50
"""Rounds of least squares for gains: half a step each, they come to 1e-4 of the gains and less."""
BLOCK = 1024
"""Baselines that are transformed at a time."""
MATRIX_ELEMENTS = 4_000_000
"""Antennas squared times channels that are fitted at a time."""


def delay_start(
    data: Observation, weights: np.ndarray, settings: DelayStart, sky: np.ndarray | None = None
) -> np.ndarray:
    """Find gains to start from, complex128, shape (Nants, Nfreqs, Ntimes, Npols).

    Autocorrelations and samples of weight zero, (Ntimes, Nbls, Nfreqs, Npols), have no influence. Without a sky model
    the gains have modulus one. They are one for antennas without data, and where there is nothing to fit.

    Raises InputError if the channels do not lie on an even grid, the sky model is zero, or, without one, gains in every
    channel are requested or channels are too wide for the delays of the foregrounds.
    """
    if settings.per_channel and sky is None:
        raise InputError(
            "calibration.initial_gains.per_channel: gains in every channel need a sky model, and there is none"
        )
    crossed = ~data.autos
    gains = np.ones((data.n_antennas, data.n_channels, data.n_times, data.n_polarizations), complex)
    fit = _DelayFit(data.antennas[crossed], data.positions, data.frequencies)
    for t, p in np.ndindex(data.n_times, data.n_polarizations):
        used = weights[t, crossed, :, p]
        visibilities = np.where(used > 0, data.visibilities[t, crossed, :, p], 0)
        model = None if sky is None else np.where(used > 0, sky[t, crossed, :, p], 0)
        if not visibilities.any():
            continue
        found = fit.gains(_clipped(visibilities), used, model)
        if settings.per_channel and model is not None:
            found = _least_squares(used * visibilities * model.conj(), used * np.abs(model) ** 2, fit.antennas, found)
        gains[:, :, t, p] = found
    return gains


class _DelayFit:
    """The fit of one integration and polarization.

    `antennas` are the two of each baseline, (Nbls, 2); `positions` are east, north, up in m, (Nants, 3); `frequencies`
    are in Hz, (Nfreqs,).
    """

    def __init__(self, antennas: np.ndarray, positions: np.ndarray, frequencies: np.ndarray) -> None:
        self.antennas, self.positions, self.n_antennas = antennas, positions, len(positions)
        self.lengths = np.linalg.norm(positions[antennas[:, 1]] - positions[antennas[:, 0]], axis=1)
        self.grid = channel_grid(frequencies)
        self.n_delays = next_fast_len(PADDING * self.grid.n_channels)
        ascending = frequencies[-1] > frequencies[0]
        self._delay_step = (1 if ascending else -1) / (self.grid.width * self.n_delays)
        # About the middle of the band delay and phase do not depend on each other.
        self._turns = 2j * np.pi * (frequencies - frequencies.mean())

    def gains(self, visibilities: np.ndarray, weights: np.ndarray, model: np.ndarray | None) -> np.ndarray:
        """Compute gains, (Nants, Nfreqs), from data, weights and sky model, (Nbls, Nfreqs), zero where flagged."""
        spectra = weights * visibilities if model is None else weights * visibilities * model.conj()
        scores = self._window_scores(spectra) if model is None else self._fringe_scores(spectra)
        delays, found = _antenna_delays(scores, self.antennas, self.n_antennas)
        delays *= self._delay_step
        if model is None:
            delays[found] -= _sky_gradient(delays[found], self.positions[found])
        phasors = np.exp(delays[:, None] * self._turns)
        if model is None:
            return phasors
        first, second = self.antennas.T
        correlation = np.sum(spectra * phasors[first].conj() * phasors[second], axis=1, keepdims=True)
        power = np.sum(weights * np.abs(model) ** 2, axis=1, keepdims=True)
        start = _phases(correlation[:, 0], self.antennas, self.n_antennas)[:, None]
        return phasors * _least_squares(correlation, power, self.antennas, start)

    def _power(self, spectra: np.ndarray) -> np.ndarray:
        """Compute |sum_nu x exp(-2 pi i nu tau)|^2 of some baselines at all delays, (Nspectra, Ndelays)."""
        return np.abs(fft(self.grid.filled(spectra), self.n_delays, axis=1)) ** 2

    def _fringe_scores(self, spectra: np.ndarray) -> np.ndarray:
        """Return the power of v m* by delay over the largest possible, minus its mean, (Nbls, Ndelays), float32."""
        scores = np.zeros((len(spectra), self.n_delays), np.float32)
        largest = np.sum(np.abs(spectra), axis=1, keepdims=True) ** 2
        if not largest.any():
            raise InputError(
                "calibration.initial_gains: 'delays' compares the data with the sky model, which is zero wherever the "
                "data are not; start from unity"
            )
        for rows in self._blocks(np.flatnonzero(largest)):
            part = self._power(spectra[rows]) / largest[rows]
            scores[rows] = part - part.mean(axis=1, keepdims=True)
        return scores

    def _window_scores(self, spectra: np.ndarray) -> np.ndarray:
        """Return the power fraction of v in a Gaussian about each delay, minus the mean, (Nbls, Ndelays), float32.

        The convolution is a product with exp(-(2 pi k dnu sigma)^2 / 2) over the lags k of the autocorrelation.
        """
        scores = np.zeros((len(spectra), self.n_delays), np.float32)
        steps, width = np.arange(self.n_delays), self.grid.width
        lags = np.minimum(steps, self.n_delays - steps)
        sigma = 0.5 * self.lengths / SPEED_OF_LIGHT + 0.5 / (self.grid.n_channels * width)
        if np.exp(-0.5 * (2 * np.pi * width * sigma.min()) ** 2) < LEAST_CORRELATION:
            raise InputError(
                f"calibration.initial_gains: 'delays' needs a sky model where the shortest baseline has "
                f"{self.lengths.min():.0f} m and channels have {width / 1e3:.4g} kHz: the foregrounds of adjacent "
                "channels are not alike; start from unity"
            )
        for rows in self._blocks(np.flatnonzero(spectra.any(axis=1))):
            power = self._power(spectra[rows])
            taper = np.exp(-0.5 * (2 * np.pi * width * lags * sigma[rows, None]) ** 2)
            # The mean over delays.
            taper[:, 0] = 0
            # A Gaussian of height one has this area.
            area = np.sqrt(2 * np.pi) * sigma[rows] * self.n_delays * width
            scores[rows] = fft(ifft(power) * taper).real * (area / power.sum(axis=1))[:, None]
        return scores

    def _blocks(self, rows: np.ndarray) -> list[np.ndarray]:
        """Divide baselines into blocks of limited memory."""
        return np.array_split(rows, max(len(rows) // BLOCK, 1))


def _clipped(visibilities: np.ndarray) -> np.ndarray:
    """Limit outlying visibilities of each baseline, (Nbls, Nfreqs); zeros are missing data."""
    modulus = np.abs(visibilities)
    median = np.ma.median(np.ma.masked_equal(modulus, 0), axis=1, keepdims=True).filled(0)
    limit = LARGEST_SAMPLE * median
    return visibilities * np.where(modulus > limit, limit / np.where(modulus > 0, modulus, 1), 1)


class _DelaySearch:
    """Delays of antennas on a periodic grid, with the greatest sum of scores at the differences tau_a - tau_b.

    Scores are those of every baseline at every delay, of mean zero, (Nbls, Ndelays). `delays` are in steps of the grid,
    (Nants,), zero until they are found. `evidence` is the sum of the largest scores of the baselines of each antenna,
    (Nants,); zero where there are no data.
    """

    def __init__(self, scores: np.ndarray, antennas: np.ndarray, n_antennas: int) -> None:
        self.scores, self.antennas = scores, antennas
        self.delays = np.zeros(n_antennas, int)
        self.evidence = np.zeros(n_antennas)
        np.add.at(self.evidence, antennas, scores.max(axis=1)[:, None])
        self._steps = np.arange(scores.shape[1])
        self._rows = [np.flatnonzero((antennas == antenna).any(axis=1)) for antenna in range(n_antennas)]
        self._others = [antennas[rows].sum(axis=1) - antenna for antenna, rows in enumerate(self._rows)]

    def _shifted(self, antenna: int, at: np.ndarray, forward: bool) -> np.ndarray:
        """Return the scores of the baselines of an antenna, (Nrows, Ndelays), by the delay of one of the two antennas.

        Forward: by its own delay, with the others at `at`; otherwise by the delay of the others, with its own at `at`.
        """
        rows = self._rows[antenna]
        signs = np.where((self.antennas[rows, 0] == antenna) == forward, 1, -1)
        return np.take_along_axis(
            self.scores[rows], signs[:, None] * (self._steps - at[:, None]) % len(self._steps), axis=1
        )

    def place(self) -> None:
        """Give every antenna a delay, in order of the scores with antennas that have one already."""
        known = np.zeros((len(self.delays), len(self._steps)), self.scores.dtype)
        placed = np.zeros(len(self.delays), bool)
        while not placed.all():
            heights = np.where(placed, -np.inf, known.max(axis=1))
            # The first of all, or of a part of the array that no baseline connects to those before.
            alone = heights.max() <= 0
            chosen = int((np.where(placed, -np.inf, self.evidence) if alone else heights).argmax())
            self.delays[chosen], placed[chosen] = known[chosen].argmax(), True
            here = np.full(len(self._rows[chosen]), self.delays[chosen])
            np.add.at(known, self._others[chosen], self._shifted(chosen, here, forward=False))

    def improve(self) -> bool:
        """Move every antenna to its best delay, given those of the others; return whether any has moved."""
        before = self.delays.copy()
        for antenna in np.flatnonzero(self.evidence > 0).tolist():
            there = self.delays[self._others[antenna]]
            self.delays[antenna] = self._shifted(antenna, there, forward=True).sum(axis=0).argmax()
        return bool((self.delays != before).any())


def _antenna_delays(scores: np.ndarray, antennas: np.ndarray, n_antennas: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the delays with the greatest sum of scores at tau_a - tau_b, and which antennas have data, (Nants,).

    Delays are in steps of the grid, with median zero; those of antennas without data are zero. Scores are periodic in
    delay, of mean zero, (Nbls, Ndelays).
    """
    search, n_delays = _DelaySearch(scores, antennas, n_antennas), scores.shape[1]
    search.place()
    for _ in range(SWEEPS):
        if not search.improve():
            break
    delays, used = search.delays + _offsets(scores, antennas, search.delays), search.evidence > 0
    if not used.any():
        return np.zeros(n_antennas), used
    # Delays a period apart are the same, up to a phase.
    wrapped = (delays - delays[search.evidence.argmax()] + n_delays / 2) % n_delays - n_delays / 2
    return np.where(used, wrapped - np.median(wrapped[used]), 0), used


def _sky_gradient(delays: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return the part of the delays, s, (Nants,), that is due to the displacement of the foregrounds from the zenith.

    Delays are tau_a + k . x_a / c with the mean direction k of the foregrounds, and positions x, east, north, up, m,
    (Nants, 3). With cable delays tau that scatter by s and |k| by `SKY_SCATTER` in each direction, the mean of k is
    that of ridge regression,

        k = (X^T W X / s^2 + 1 / SKY_SCATTER^2)^-1 X^T W delays / s^2,

    with X = x / c about the mean, and weights W against outliers (Cauchy's, of scale 3 s). In arrays that are small
    relative to the scatter of their cables, the gradient stays in the delays; in large arrays it is attributed to the
    sky.
    """
    if len(delays) <= 3:
        return np.zeros(len(delays))
    columns = np.column_stack([np.ones(len(delays)), positions[:, :2] / SPEED_OF_LIGHT])
    weights = np.ones(len(delays))
    for _ in range(ROBUST_ITERATIONS):
        root = np.sqrt(weights)
        plane = np.linalg.lstsq(columns * root[:, None], delays * root, rcond=None)[0]
        residual = np.abs(delays - columns @ plane)
        # The median of the modulus of normal numbers is 0.67 of their deviation; three are fitted.
        scatter = np.median(residual) / 0.67 * np.sqrt(len(delays) / (len(delays) - 3))
        if scatter == 0:
            break
        weights = 1 / (1 + (residual / (3 * scatter)) ** 2)
    slopes = columns[:, 1:] - np.average(columns[:, 1:], axis=0, weights=weights)
    normal = (slopes.T * weights) @ slopes + (scatter / SKY_SCATTER) ** 2 * np.eye(2)
    return slopes @ np.linalg.lstsq(normal, (slopes.T * weights) @ delays, rcond=None)[0]


def _offsets(scores: np.ndarray, antennas: np.ndarray, delays: np.ndarray) -> np.ndarray:
    """Return the offset of each delay from its step, (Nants,): the maximum of the sum of parabolas through scores."""
    at = (delays[antennas[:, 0]] - delays[antennas[:, 1]])[:, None] + np.array([-1, 0, 1])
    below, middle, above = np.take_along_axis(scores, at % scores.shape[1], axis=1).T.astype(float)
    curvature, slope = np.maximum(2 * middle - below - above, 0), (above - below) / 2
    slope = np.where(curvature > 0, slope, 0)
    first, second = (np.equal.outer(np.arange(delays.size), column).astype(float) for column in antennas.T)
    incidence = first - second
    offsets = np.linalg.lstsq((incidence * curvature) @ incidence.T, incidence @ slope, rcond=1e-6)[0]
    return np.clip(offsets, -1, 1)


def _phases(correlation: np.ndarray, antennas: np.ndarray, n_antennas: int) -> np.ndarray:
    """Return phasors of the antennas, (Nants,), from correlations of baselines with the sky model, (Nbls,).

    They are those of the leading eigenvector of the Hermitian matrix of the correlations, in every part of the array
    that is connected by baselines.
    """
    first, second = antennas.T
    matrix = np.zeros((n_antennas, n_antennas), complex)
    np.add.at(matrix, (first, second), correlation)
    np.add.at(matrix, (second, first), correlation.conj())
    phasors = np.ones(n_antennas, complex)
    _, part = connected_components(coo_array(matrix != 0), directed=False)
    for label in range(part.max() + 1):
        members = np.flatnonzero(part == label)
        phasors[members] = np.exp(1j * np.angle(np.linalg.eigh(matrix[np.ix_(members, members)])[1][:, -1]))
    return phasors


def _least_squares(correlation: np.ndarray, power: np.ndarray, antennas: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the gains u, (Nants, Nchannels), that minimize the sum of w |v - u_a u_b* m|^2 in each channel.

    By u_a = sum_b C_ab u_b / sum_b M_ab |u_b|^2, with half a step each time (Salvini & Wijnholds 2014). C is w v m*,
    and M is w |m|^2, (Nbls, Nchannels). `start` is kept where there are no data, (Nants, Nchannels).
    """
    gains, (first, second) = start.copy(), antennas.T
    n_antennas, n_channels = start.shape
    for channels in np.array_split(np.arange(n_channels), -(-n_channels * n_antennas**2 // MATRIX_ELEMENTS)):
        matrix = np.zeros((channels.size, n_antennas, n_antennas), complex)
        matrix[:, first, second], matrix[:, second, first] = correlation.T[channels], correlation.T[channels].conj()
        norm = np.zeros(matrix.shape)
        norm[:, first, second] = norm[:, second, first] = power.T[channels]
        found = start.T[channels, :, None]
        for _ in range(GAIN_ITERATIONS):
            below = norm @ np.abs(found) ** 2
            found = (found + (matrix @ found) / np.where(below > 0, below, 1)) / 2
        gains[:, channels] = np.where(below > 0, found, start.T[channels, :, None])[..., 0].T
    modulus = np.abs(gains)
    raised = gains * np.maximum(SMALLEST_GAIN * np.median(modulus) / np.where(modulus > 0, modulus, 1), 1)
    return np.where(modulus > 0, raised, start)
