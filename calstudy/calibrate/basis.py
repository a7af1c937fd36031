"""The foreground basis: discrete prolate spheroidal sequences in frequency, shared by baselines of similar length.

Paper Eq. FGMODEL models each intrinsic visibility as a sum of DPSS (Slepian 1978) whose delays reach the horizon of its
baseline. Half-widths are rounded up to a step, so that baselines fall into buckets with one basis each and no basis is
padded with zeros.

The sequences are those of the band with data. Sequences of a wider band, cut at its flagged edges, follow smooth gains
common to all antennas: with two flagged channels at either end of 96, such gains are wrong by a tenth. Nor are
sequences of gains concentrated in delay after a cut: with 8 flagged channels at either end of 64, gains up to 400 ns
would follow 8 % of the (tapered) power at 600 to 800 ns in place of 1 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.errors import InputError
from calstudy.calibrate.settings import BasisSettings

# Sequences with a smaller spectral concentration are left out.
EIGENVALUE_CUTOFF = 1e-12
# Sequences computed beyond the Shannon number 2NW; concentrations fall to 1e-14 well within these.
EXTRA_SEQUENCES = 40
# How far channels may be off their grid, in units of its spacing.
GRID_TOLERANCE = 0.05


@dataclass(frozen=True, eq=False)
class Bucket:
    """Models, by their indices `members`, (Nmembers,), that share one basis, up to the delay `half_width` in s.

    `vectors` are orthonormal sequences, (Nfreqs, Nvec), float64; with a prior, a root of its covariance.
    """

    half_width: float
    members: np.ndarray
    vectors: np.ndarray


@dataclass(frozen=True, eq=False)
class ForegroundBasis:
    """The bases of all foreground models: of baselines, or redundant groups. Each belongs to exactly one bucket."""

    buckets: tuple[Bucket, ...]
    n_models: int
    n_frequencies: int

    @property
    def n_coefficients(self) -> int:
        """Number of complex coefficients of all models together."""
        return sum(bucket.vectors.shape[1] * bucket.members.size for bucket in self.buckets)


def delay_half_widths(lengths: np.ndarray, settings: BasisSettings) -> np.ndarray:
    """Compute the largest modelled delay of each baseline, shape (Nmodels,), in s, for `lengths` in m.

    It is ``max(horizon * length / c, min_delay) + buffer``, rounded up to a multiple of `delay_step`.
    """
    reach = np.maximum(settings.horizon * np.asarray(lengths, float) / SPEED_OF_LIGHT, settings.min_delay)
    # Without the inner rounding, binary dust would push exact multiples up by a whole step.
    return np.ceil(np.round((reach + settings.buffer) / settings.delay_step, 6)) * settings.delay_step


def _most_sequences(n_frequencies: int, half_bandwidth: float) -> int:
    """Return the number of sequences to compute, before those below the eigenvalue cutoff are left out."""
    return min(n_frequencies, int(2 * half_bandwidth) + EXTRA_SEQUENCES)


@lru_cache(maxsize=256)
def _sequences(n_frequencies: int, half_bandwidth: float, eigenvalue_cutoff: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the sequences of `dpss_vectors`, and their concentrations, (Nvec,)."""
    from scipy.signal.windows import dpss

    n_asked = _most_sequences(n_frequencies, half_bandwidth)
    vectors, concentrations = dpss(n_frequencies, half_bandwidth, Kmax=n_asked, return_ratios=True)
    # Concentrations fall monotonically until rounding; what follows the first below the cutoff is noise.
    below = concentrations < eigenvalue_cutoff
    n_kept = int(np.argmax(below)) if below.any() else n_asked
    basis = np.ascontiguousarray(vectors[:n_kept].T)
    basis.flags.writeable = False
    return basis, concentrations[:n_kept]


def dpss_vectors(n_frequencies: int, half_bandwidth: float, eigenvalue_cutoff: float = EIGENVALUE_CUTOFF) -> np.ndarray:
    """Compute the DPSS whose concentration is above the cutoff, shape (n_frequencies, Nvec).

    `half_bandwidth` is NW, the product of the number of channels, the channel width and the delay half-width.
    """
    return _sequences(n_frequencies, half_bandwidth, eigenvalue_cutoff)[0]


def flat_wedge_root(n_frequencies: int, half_bandwidth: float) -> np.ndarray:
    """Return a root B of the covariance B B^T of a signal, white up to a delay, that has variance one per channel.

    The covariance is sin(2 pi W (i - j)) / (2 pi W (i - j)) with the half-bandwidth N W of N channels; its eigenvectors
    are the DPSS, its eigenvalues their concentrations over 2 W (Slepian 1978). The root is float64, (n_frequencies,
    Nvec); parameters are as for `dpss_vectors`.
    """
    vectors, concentrations = _sequences(n_frequencies, half_bandwidth, EIGENVALUE_CUTOFF)
    return vectors * np.sqrt(concentrations * n_frequencies / (2 * half_bandwidth))


@dataclass(frozen=True, eq=False)
class ChannelGrid:
    """The even grid of the channels: spacing in Hz, length with gaps, and position of each channel on it, (Nfreqs,)."""

    width: float
    n_channels: int
    positions: np.ndarray

    def filled(self, values: np.ndarray) -> np.ndarray:
        """Return values of the channels, (..., Nfreqs), on the whole grid, complex, with zeros in the gaps."""
        found = np.zeros((*values.shape[:-1], self.n_channels), np.result_type(values, np.complex64))
        found[..., self.positions] = values
        return found


def channel_grid(frequencies: np.ndarray) -> ChannelGrid:
    """Return the grid of channel centres (Nfreqs,) in Hz, ascending or descending, with or without gaps.

    Raises InputError if there are fewer than two channels, or if they do not lie on an even grid.
    """
    spacings = np.abs(np.diff(frequencies))
    refusal = InputError("frequencies: a fit by least squares needs at least two channels on an even grid")
    # Written so that frequencies that are not numbers are refused as well.
    if spacings.size == 0 or not spacings.min() > 0:
        raise refusal
    span = np.abs(frequencies - frequencies[0])
    # The narrowest spacing has the rounding of stored frequencies; the whole band gives a better one.
    width = span[-1] / max(round(span[-1] / spacings.min()), 1)
    positions = span / width
    if np.abs(positions - np.round(positions)).max() > GRID_TOLERANCE:
        raise refusal
    return ChannelGrid(float(width), round(positions[-1]) + 1, np.round(positions).astype(int))


def restrict(vectors: np.ndarray, grid: ChannelGrid, eigenvalue_cutoff: float = EIGENVALUE_CUTOFF) -> np.ndarray:
    """Return an orthonormal basis of sequences restricted to the channels that exist, float64, (Nfreqs, at most Nvec).

    `vectors` are orthonormal on the whole grid, (n_channels, Nvec). Combinations with less than the fraction
    `eigenvalue_cutoff` of their power in the existing channels are left out.
    """
    if len(grid.positions) == grid.n_channels:
        return vectors
    left, singular, _ = np.linalg.svd(vectors[grid.positions], full_matrices=False)
    return np.ascontiguousarray(left[:, singular**2 > eigenvalue_cutoff])


WHOLE_BAND = slice(None)


def gain_vectors(frequencies: np.ndarray, delay: float, band: slice = WHOLE_BAND) -> np.ndarray:
    """Compute orthonormal sequences for gains with delays up to `delay` s, shape (Nfreqs, Ngain).

    Channel centres are in Hz on an even grid, gaps allowed. If the channels do not resolve the delay, the basis spans
    all of them. Gains are smooth within the band, which has the data, and free in each channel outside it.
    """
    grid = _grid_of(frequencies, band)
    found = np.eye(len(frequencies))
    if delay * grid.width >= 0.5:
        return found
    smooth = restrict(dpss_vectors(grid.n_channels, grid.n_channels * grid.width * delay), grid)
    inside = np.zeros((len(frequencies), smooth.shape[1]))
    inside[band] = smooth
    return np.concatenate([inside, np.delete(found, band, axis=1)], axis=1)


def _grid_of(frequencies: np.ndarray, band: slice) -> ChannelGrid:
    """Return the grid of the channels of a band; the width is that of all channels."""
    whole = channel_grid(np.asarray(frequencies, float))
    positions = whole.positions[band] - whole.positions[band][0]
    return ChannelGrid(whole.width, int(positions[-1]) + 1, positions)


def make_basis(
    lengths: np.ndarray, frequencies: np.ndarray, settings: BasisSettings, prior: bool = False, band: slice = WHOLE_BAND
) -> ForegroundBasis:
    """Build the foreground basis of models with the given baseline lengths (paper Eq. FGMODEL).

    Raises InputError if channels do not lie on an even grid, a half-width is zero, or a basis has as many vectors as
    there are channels.

    Lengths are in m, (Nmodels,), zero for autocorrelations; channel centres in Hz, (Nfreqs,), with gaps or without.
    With a `prior`, vectors are a root of the covariance of a flat wedge (`flat_wedge_root`) and not orthonormal. They
    are zero in channels outside of the band.
    """
    grid = _grid_of(frequencies, band)
    width, n_modelled = grid.width, len(grid.positions)
    half_widths = delay_half_widths(lengths, settings)
    buckets = []
    for half_width in np.unique(half_widths):
        if half_width <= 0:
            raise InputError("calibration.basis: the delay half-width is 0 s; set min_delay or buffer above zero")
        product, vectors = half_width * width, None
        if product < 0.5:
            size = grid.n_channels, grid.n_channels * product
            vectors = flat_wedge_root(*size)[grid.positions] if prior else restrict(dpss_vectors(*size), grid)
        if vectors is None or vectors.shape[1] >= n_modelled:
            raise InputError(
                f"calibration.basis: a delay half-width of {half_width * 1e9:.0f} ns fills all {n_modelled} "
                f"channels of {width / 1e3:.4g} kHz, so that foregrounds would fit any data; "
                "use shorter baselines, a smaller buffer, or more or narrower channels"
            )
        if n_modelled < len(frequencies):
            inside, vectors = vectors, np.zeros((len(frequencies), vectors.shape[1]))
            vectors[band] = inside
        buckets.append(Bucket(float(half_width), np.flatnonzero(half_widths == half_width), vectors))
    return ForegroundBasis(tuple(buckets), len(half_widths), len(frequencies))


def require_room(length: float, frequencies: np.ndarray, settings: BasisSettings) -> None:
    """Raise InputError if the longest baseline, of this length in m, cannot have a basis; see `make_basis`."""
    try:
        grid = channel_grid(np.asarray(frequencies, float))
        product = delay_half_widths(np.array([length]), settings)[0] * grid.width
        # A plan is faster where the sequences, and scipy.signal for them, are not needed to see that there is room.
        if not 0 < product < 0.5 or _most_sequences(grid.n_channels, grid.n_channels * product) >= len(frequencies):
            make_basis(np.array([length]), frequencies, settings)
    except InputError as error:
        raise InputError(f"{error} (the longest baseline has {length:.0f} m)") from None
