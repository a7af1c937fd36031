"""Where a solve starts on any array: one delay for each antenna, and with a sky model one complex gain.

A cable delay tau_a turns the gain of an antenna by exp(2 pi i nu tau_a). In V_ab = g_a g_b* F_ab it shifts the
foregrounds in delay by tau_a - tau_b. The delays of all antennas follow from the shifts of all baselines.

With a sky model m, V m* has the phase of g_a g_b*, and its delay spectrum is a narrow peak at the shift: the fringe fit
of interferometry, here with the powers of the baselines of an antenna added up (Schwab & Cotton 1983). One complex gain
per antenna then follows from least squares over all channels.

Without a sky model, foregrounds are known to lie within the horizon delay b/c of a baseline of length b. The power in a
Gaussian of half this width,

    S_ab(D) = sum_tau |V_ab(tau)|^2 exp(-(tau - D)^2 / 2 sigma_ab^2),    sigma_ab = b / 2c + 1 / 2B,

with the bandwidth B, is greatest where D is the shift plus the mean delay of the foregrounds. The wider the Gaussian,
the less a baseline says. A gradient of delay over the array cannot be told from a displacement of the sky, and is such
that the mean delay of the foregrounds is about zero. Amplitudes and phases of antennas cannot be told from those of the
foregrounds at all, and are left as they are.

Either way the delays are those with the greatest sum of S_ab(tau_a - tau_b) over baselines. Noise has a flat S, so that
an antenna without signal does not change the delays of the others.
"""

from __future__ import annotations

import numpy as np
from scipy.constants import speed_of_light
from scipy.fft import fft, ifft, next_fast_len
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calstudy.base.errors import InputError
from calstudy.base.observation import Observation
from calstudy.calibrate.basis import channel_grid

PADDING = 4
"""Delays are searched on a grid this much finer than the inverse bandwidth."""
LARGEST_SAMPLE = 3.0
"""Samples are at most this times the median modulus of their baseline, against interference that is not flagged."""
LEAST_CORRELATION = 1e-3
"""Without a sky model, the foregrounds of adjacent channels of the shortest baseline must be correlated this much."""
SMALLEST_GAIN = 0.01
"""Gains are at least this times the median: a solver cannot leave zero."""
SWEEPS = 20
"""Rounds of moving antennas one by one, at most; two or three are the rule."""
GAIN_ITERATIONS = 50
BLOCK = 1024
"""Baselines that are transformed at a time."""


def delay_start(data: Observation, weights: np.ndarray, sky: np.ndarray | None) -> np.ndarray:
    """Return gains to start from, complex128, shape (Nants, Nfreqs, Ntimes, Npols).

    Parameters
    ----------
    data
        The visibilities; autocorrelations are not used.
    weights
        (Ntimes, Nbls, Nfreqs, Npols); samples of weight zero have no influence.
    sky
        A sky model like the visibilities, or None.

    Returns
    -------
    Without a delay for antennas that have no data. The median delay is zero.

    Raises
    ------
    InputError
        If the channels are on no even grid; if the sky model is zero; or, without a sky model, if channels are too wide
        for the delays of the foregrounds.
    """
    crossed = ~data.autos
    gains = np.ones((data.n_antennas, data.n_channels, data.n_times, data.n_polarizations), complex)
    fit = _DelayFit(data.antennas[crossed], data.n_antennas, data.lengths[crossed], data.frequencies)
    for t, p in np.ndindex(data.n_times, data.n_polarizations):
        used = weights[t, crossed, :, p]
        visibilities = np.where(used > 0, data.visibilities[t, crossed, :, p], 0)
        model = None if sky is None else np.where(used > 0, sky[t, crossed, :, p], 0)
        if visibilities.any():
            gains[:, :, t, p] = fit.gains(_clipped(visibilities), used, model)
    return gains


class _DelayFit:
    """The fit of one integration and polarization.

    Parameters
    ----------
    antennas
        Of each baseline, (Nbls, 2).
    n_antennas
        Their number.
    lengths
        Of the baselines, m, (Nbls,).
    frequencies
        Hz, (Nfreqs,).
    """

    def __init__(self, antennas: np.ndarray, n_antennas: int, lengths: np.ndarray, frequencies: np.ndarray) -> None:
        self.antennas, self.n_antennas, self.lengths = antennas, n_antennas, lengths
        self.grid = channel_grid(frequencies)
        self.n_delays = next_fast_len(PADDING * self.grid.n_channels)
        ascending = frequencies[-1] > frequencies[0]
        self._delay_step = (1 if ascending else -1) / (self.grid.width * self.n_delays)
        # About the middle of the band delay and phase do not depend on each other.
        self._turns = 2j * np.pi * (frequencies - frequencies.mean())

    def gains(self, visibilities: np.ndarray, weights: np.ndarray, model: np.ndarray | None) -> np.ndarray:
        """Return gains, (Nants, Nfreqs), from data, weights and sky model, (Nbls, Nfreqs), zero where flagged."""
        spectra = weights * visibilities if model is None else weights * visibilities * model.conj()
        scores = self._window_scores(spectra) if model is None else self._fringe_scores(spectra)
        delays = self._delay_step * _antenna_delays(scores, self.antennas, self.n_antennas)
        phasors = np.exp(delays[:, None] * self._turns)
        if model is None:
            return phasors
        first, second = self.antennas.T
        correlation = np.sum(spectra * phasors[first].conj() * phasors[second], axis=1)
        power = np.sum(weights * np.abs(model) ** 2, axis=1)
        return phasors * _antenna_gains(correlation, power, self.antennas, self.n_antennas)[:, None]

    def _power(self, spectra: np.ndarray) -> np.ndarray:
        """Return |sum_nu x exp(-2 pi i nu tau)|^2 of some baselines at all delays, (Nspectra, Ndelays)."""
        padded = np.zeros((len(spectra), self.grid.n_channels), complex)
        padded[:, self.grid.positions] = spectra
        return np.abs(fft(padded, self.n_delays, axis=1)) ** 2

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
        """Return the part of the power of v in a Gaussian about each delay, minus its mean, (Nbls, Ndelays), float32.

        The convolution is a product with exp(-(2 pi k dnu sigma)^2 / 2) over the lags k of the autocorrelation in
        frequency.
        """
        scores = np.zeros((len(spectra), self.n_delays), np.float32)
        steps, width = np.arange(self.n_delays), self.grid.width
        lags = np.minimum(steps, self.n_delays - steps)
        sigma = 0.5 * self.lengths / speed_of_light + 0.5 / (self.grid.n_channels * width)
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
        """Return baselines in pieces that need little memory."""
        return np.array_split(rows, max(len(rows) // BLOCK, 1))


def _clipped(visibilities: np.ndarray) -> np.ndarray:
    """Return visibilities, (Nbls, Nfreqs), with what stands out of its baseline reduced; zeros are no data."""
    modulus = np.abs(visibilities)
    median = np.ma.median(np.ma.masked_equal(modulus, 0), axis=1, keepdims=True).filled(0)
    limit = LARGEST_SAMPLE * median
    return visibilities * np.where(modulus > limit, limit / np.where(modulus > 0, modulus, 1), 1)


class _DelaySearch:
    """Delays of antennas on a periodic grid, with the greatest sum of scores at the differences tau_a - tau_b.

    Parameters
    ----------
    scores
        Of every baseline at every delay, of mean zero, (Nbls, Ndelays).
    antennas
        (Nbls, 2).
    n_antennas
        Their number.

    Attributes
    ----------
    delays
        In steps of the grid, (Nants,), integer; zero until they are found.
    evidence
        Sum of the largest scores of the baselines of each antenna, (Nants,); zero where there are no data.
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
        """Return the scores of its baselines with a delay of the antenna (forward), or of the others, running."""
        rows = self._rows[antenna]
        signs = np.where((self.antennas[rows, 0] == antenna) == forward, 1, -1)
        return np.take_along_axis(
            self.scores[rows], signs[:, None] * (self._steps - at[:, None]) % len(self._steps), axis=1
        )

    def place(self) -> None:
        """Give every antenna a delay, first those of which the ones before say most."""
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
        """Move every antenna to its best delay where the others are; return whether any has moved."""
        before = self.delays.copy()
        for antenna in np.flatnonzero(self.evidence > 0).tolist():
            there = self.delays[self._others[antenna]]
            self.delays[antenna] = self._shifted(antenna, there, forward=True).sum(axis=0).argmax()
        return bool((self.delays != before).any())


def _antenna_delays(scores: np.ndarray, antennas: np.ndarray, n_antennas: int) -> np.ndarray:
    """Return the delays with the greatest sum of scores at tau_a - tau_b, in steps of the grid, median zero, (Nants,).

    Parameters
    ----------
    scores
        Of every baseline at every delay, periodic, of mean zero, (Nbls, Ndelays).
    antennas
        (Nbls, 2).
    n_antennas
        Their number; those without data stay at zero.
    """
    search, n_delays = _DelaySearch(scores, antennas, n_antennas), scores.shape[1]
    search.place()
    for _ in range(SWEEPS):
        if not search.improve():
            break
    delays, used = search.delays + _offsets(scores, antennas, search.delays), search.evidence > 0
    if not used.any():
        return np.zeros(n_antennas)
    # Delays a period apart are the same, up to a phase.
    wrapped = (delays - delays[search.evidence.argmax()] + n_delays / 2) % n_delays - n_delays / 2
    return np.where(used, wrapped - np.median(wrapped[used]), 0)


def _offsets(scores: np.ndarray, antennas: np.ndarray, delays: np.ndarray) -> np.ndarray:
    """Return by how much less than a step each delay is off, (Nants,): the maximum of the parabolas of all scores."""
    n_delays, n_antennas = scores.shape[1], delays.size
    at = (delays[antennas[:, 0]] - delays[antennas[:, 1]])[:, None] + np.array([-1, 0, 1])
    below, middle, above = np.take_along_axis(scores, at % n_delays, axis=1).T.astype(float)
    curvature, slope = np.maximum(2 * middle - below - above, 0), (above - below) / 2
    slope = np.where(curvature > 0, slope, 0)
    incidence = np.zeros((n_antennas, len(antennas)))
    columns = np.arange(len(antennas))
    incidence[antennas[:, 0], columns], incidence[antennas[:, 1], columns] = 1, -1
    offsets = np.linalg.lstsq((incidence * curvature) @ incidence.T, incidence @ slope, rcond=1e-6)[0]
    return np.clip(offsets, -1, 1)


def _antenna_gains(correlation: np.ndarray, power: np.ndarray, antennas: np.ndarray, n_antennas: int) -> np.ndarray:
    """Return one complex gain u of each antenna, (Nants,), that minimizes the sum of w |v - u_a u_b* m|^2.

    The phases to start with are those of the leading eigenvector of the matrix of correlations, in every part of the
    array that baselines connect; then u_a = sum_b C_ab u_b / sum_b M_ab |u_b|^2, taken half the way each time.

    Parameters
    ----------
    correlation
        Sum of w v m* over channels, C, (Nbls,).
    power
        Sum of w |m|^2 over channels, M, (Nbls,).
    antennas
        (Nbls, 2).
    n_antennas
        Their number; those without a correlation have gain one.
    """
    first, second = antennas.T
    matrix, norm = np.zeros((n_antennas, n_antennas), complex), np.zeros((n_antennas, n_antennas))
    np.add.at(matrix, (first, second), correlation)
    np.add.at(matrix, (second, first), correlation.conj())
    np.add.at(norm, (first, second), power)
    np.add.at(norm, (second, first), power)
    gains = np.zeros(n_antennas, complex)
    _, part = connected_components(coo_array(matrix != 0), directed=False)
    for label in range(part.max() + 1):
        members = np.flatnonzero(part == label)
        inside = np.ix_(members, members)
        vectors = np.linalg.eigh(matrix[inside])[1]
        gains[members] = np.exp(1j * np.angle(vectors[:, -1]))
    for _ in range(GAIN_ITERATIONS):
        below = norm @ np.abs(gains) ** 2
        gains = np.where(below > 0, (gains + (matrix @ gains) / np.where(below > 0, below, 1)) / 2, 0)
    modulus = np.abs(gains)
    if not modulus.any():
        return np.ones(n_antennas, complex)
    smallest = SMALLEST_GAIN * np.median(modulus[modulus > 0])
    raised = gains * np.maximum(smallest / np.where(modulus > 0, modulus, 1), 1)
    return np.where(modulus > 0, raised, 1)
