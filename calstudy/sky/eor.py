"""The 21 cm signal: Gaussian brightness with a known power spectrum, as a HEALPix map per channel."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import healpy
import numpy as np
from astropy import units
from astropy.cosmology import FLRW, Planck15
from pyradiosky import SkyModel
from scipy.interpolate import CubicSpline

from calstudy.base.constants import HYDROGEN_LINE, UNEVEN
from calstudy.base.errors import InputError
from calstudy.sky.boxes import box_power
from calstudy.sky.settings import Eor

# Nodes of the radial wavenumber integral: per logarithmic interval near zero, per channel beyond.
LOWEST_PHASE = 1e-5
LOG_INTERVALS = 24
NODES_PER_INTERVAL = 4
ROOT_NODES = 64


class EorField:
    """A Gaussian random sky of known P(k), computed for any subset of the channels.

    The flat spectrum is one independent normal number per pixel and channel with variance σ²(ν) = P / V(ν), where V is
    the comoving volume of the voxel (paper §Simulations; Mpc without h). A power law, a table or a box is correlated
    between channels; see `covariance_factor`.

    The field is not smoothed over the channel (P is white up to the Nyquist wavenumber of the channel spacing) nor over
    the pixel (maps are samples at pixel centres, band-limited at ℓ = 3 nside − 1 for the power law). A delay spectrum
    therefore recovers P itself. In the flat case the brightness is constant within a pixel.

    `frequencies` are all channel centres of the study in Hz, at least two, increasing and equally spaced, (Nfreqs,);
    ValueError otherwise. The cosmology converts P(k) to brightness; the power spectrum estimator must use the same.
    """

    def __init__(self, settings: Eor, frequencies: np.ndarray, cosmology: FLRW = Planck15) -> None:
        frequencies = np.asarray(frequencies, dtype=float)
        spacing = np.diff(frequencies)
        if not len(spacing) or spacing.min() <= 0 or np.ptp(spacing) > UNEVEN * spacing.mean():
            raise ValueError("frequencies: an EoR field needs at least two channels, equally spaced and increasing")
        self.settings, self._hubble = settings, float(cosmology.h)
        self.frequencies = frequencies
        self.distance, self.depth = comoving_geometry(frequencies, float(spacing.mean()), cosmology)

    @property
    def n_pixels(self) -> int:
        """Number of pixels of the whole sky."""
        return 12 * self.settings.nside**2

    @property
    def voxel_volume(self) -> np.ndarray:
        """Comoving volume of a pixel and channel in Mpc³, (Nfreqs,)."""
        return 4 * np.pi / self.n_pixels * self.distance**2 * self.depth

    def maps(self, channels: slice | np.ndarray) -> np.ndarray:
        """Return brightness temperatures of some channels in K, (Nchannels, Npixels), RING order, ICRS.

        The map of a channel does not depend on which other channels are requested.
        """
        chosen = np.arange(len(self.frequencies))[channels]
        draw = self._white if self.settings.spectrum == "flat" else self._correlated
        maps = np.empty((len(chosen), self.n_pixels))
        for row, channel in zip(maps, chosen, strict=True):
            row[:] = draw(int(channel))
        return maps

    def sky(self, channels: slice | np.ndarray) -> SkyModel:
        """Return `maps` as a HEALPix SkyModel in K, with one frequency per channel."""
        maps = self.maps(channels)
        stokes = np.zeros((4, *maps.shape))
        stokes[0] = maps
        return SkyModel(
            component_type="healpix",
            nside=self.settings.nside,
            hpx_order="ring",
            hpx_inds=np.arange(self.n_pixels),
            frame="icrs",
            spectral_type="full",
            freq_array=self.frequencies[channels] * units.Hz,
            stokes=units.Quantity(stokes, units.K, copy=False),
            history=f"calstudy EoR, {self.settings.spectrum} power spectrum, seed {self.settings.seed}",
            # Fluctuations about the mean are negative half of the time, and the check would warn about that.
            run_check_acceptability=False,
        )

    def _white(self, channel: int) -> np.ndarray:
        generator = np.random.default_rng(np.random.SeedSequence(self.settings.seed, spawn_key=(channel,)))
        sigma = np.sqrt(self.settings.amplitude / self.voxel_volume[channel])
        return sigma * generator.standard_normal(self.n_pixels)

    def _correlated(self, channel: int) -> np.ndarray:
        alm = np.ascontiguousarray(self._harmonics[channel], dtype=complex)
        return healpy.alm2map(alm, self.settings.nside, lmax=3 * self.settings.nside - 1)

    @cached_property
    def _harmonics(self) -> np.ndarray:
        """a_lm of all channels in healpy's order, complex64 (0.9 GB at nside 256 x 384 channels).

        They are drawn for all channels at once, with one stream of random numbers and one covariance matrix per ℓ,
        because channels that are correlated cannot be drawn separately.
        """
        lmax, n_channels = 3 * self.settings.nside - 1, len(self.frequencies)
        harmonics = np.empty((n_channels, healpy.Alm.getsize(lmax)), dtype=np.complex64)
        roots = self.covariance_roots(lmax)
        for ell in range(lmax + 1):
            root = roots(np.log(ell + 0.5))
            real, imaginary = draw_harmonics(self.settings.seed, ell, n_channels)
            orders = healpy.Alm.getidx(lmax, ell, np.arange(ell + 1))
            harmonics[:, orders] = root @ real + 1j * (root @ imaginary)
        return harmonics

    def covariance_factor(self, ell: float) -> np.ndarray:
        """Return F with C_ℓ(ν, ν') = F Fᵀ, in K² sr, of a spectrum that is not flat, (Nfreqs, 2 Nnodes).

        It has a cosine and a sine wave per quadrature node. In the flat-sky limit, with the line of sight in units of
        channels (κ = k_∥ Δr(ν), |κ| < π),

            C_ℓ(ν_n, ν_m) = 1 / (r_n r_m √(Δr_n Δr_m)) ∫ dκ/2π cos(κ (n − m)) √(P(k_n) P(k_m)),
            k_n² = (κ/Δr_n)² + ((ℓ + ½)/r_n)².

        Each channel thus has the P(k) of its own distance r and depth Δr, as a delay spectrum assumes; between
        channels it is the geometric mean, which keeps the matrix positive definite. P ∝ k⁰ gives the white spectrum
        P / (r² Δr) of the flat field exactly.
        """
        phase, weight = _phase_quadrature(len(self.frequencies))
        wavenumber = np.hypot(phase / self.depth[:, None], (ell + 0.5) / self.distance[:, None])
        band = float(self.frequencies[0]), float(self.frequencies[-1])
        power = input_power(self.settings, wavenumber, self._hubble, band)
        amplitude = np.sqrt(power * weight) / (self.distance * np.sqrt(self.depth))[:, None]
        turns = np.arange(len(self.frequencies))[:, None] * phase
        return np.concatenate([amplitude * np.cos(turns), amplitude * np.sin(turns)], axis=1)

    def covariance_roots(self, lmax: int) -> CubicSpline:
        """Return triangular L(log(ℓ + ½)) with L Lᵀ = C_ℓ to 3e-5 of its largest element.

        It is computed at some ℓ and interpolated between them, in a quarter of the time of computing all. The
        triangular root with a positive diagonal is unique, and therefore as smooth in ℓ as the covariance.
        """
        nodes = np.linspace(np.log(0.5), np.log(lmax + 0.5), ROOT_NODES)
        return CubicSpline(nodes, [_triangular_root(self.covariance_factor(np.exp(node) - 0.5)) for node in nodes])


def draw_harmonics(seed: int, ell: int, *shape: int) -> np.ndarray:
    """Draw a_lm of unit variance of one ℓ, real and imaginary parts, (2, ..., ℓ + 1); m = 0 is real."""
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(ell,)))
    normal = generator.standard_normal((2, *shape, ell + 1)) / np.sqrt(2)
    normal[0, ..., 0] *= np.sqrt(2)
    normal[1, ..., 0] = 0.0
    return normal


def input_power(settings: Eor, k: np.ndarray, hubble: float, band: tuple[float, float] | None = None) -> np.ndarray:
    """Return the P(k) that is put in, in K² Mpc³ without h, at wavenumbers `k` in 1/Mpc, of any shape.

    `hubble` is h, in which the units of tables are. `band` has the centres of the first and the last channel in Hz,
    which choose the part of a lightcone; only a box needs it. Raises InputError if a table or a box cannot be used.
    """
    k = np.asarray(k, dtype=float)
    if settings.path is None:
        return settings.amplitude * (k / settings.pivot_k) ** settings.index
    if settings.spectrum == "table":
        known, power = read_power_table(settings.path)
    elif band is None:
        raise ValueError("band: is needed for the power spectrum of a box")
    else:
        known, power = box_power(settings.path, band)
        known, power = known / hubble, power * hubble**3
    return 1e-6 / hubble**3 * np.exp(np.interp(np.log(k / hubble), np.log(known), np.log(power)))


def read_power_table(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return k and P(k) of a text file with two columns, separated by commas or blanks; lines with # are comments.

    Raises InputError if it cannot be read, or numbers are not positive, or k does not increase.
    """
    where = f"sky.eor.path = {str(path)!r}"
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise InputError(f"{where}: cannot be read as a table of numbers ({error})") from None
    found = [(0.0, 0.0)]
    for number, line in enumerate(lines, 1):
        cells = line.partition("#")[0].replace(",", " ").split()
        if not cells:
            continue
        try:
            k, power = map(float, cells)
        except ValueError:
            raise InputError(f"{where}, line {number}: {line!r} is not two numbers, k and P(k)") from None
        if not (found[-1][0] < k < np.inf and 0 < power < np.inf):
            raise InputError(f"{where}, line {number}: {line!r}; k and P(k) must be positive, and k must increase")
        found.append((k, power))
    if len(found) < 3:
        raise InputError(f"{where}: needs two rows of k and P(k), has {len(found) - 1}")
    table = np.array(found[1:])
    return table[:, 0], table[:, 1]


def comoving_geometry(
    frequencies: np.ndarray, width: float, cosmology: FLRW = Planck15
) -> tuple[np.ndarray, np.ndarray]:
    """Return the comoving distance to 21 cm channels and their depth, in Mpc without h, (Nfreqs,) each.

    `frequencies` are the channel centres and `width` is the channel width, in Hz.
    """
    redshift = HYDROGEN_LINE / frequencies - 1
    distance = cosmology.comoving_transverse_distance(redshift).to_value("Mpc")
    per_redshift = cosmology.hubble_distance.to_value("Mpc") * cosmology.inv_efunc(redshift)
    return distance, per_redshift * width * HYDROGEN_LINE / frequencies**2


def _triangular_root(factor: np.ndarray) -> np.ndarray:
    """Return the lower triangular L with non-negative diagonal and L Lᵀ = F Fᵀ.

    QR is used, not Cholesky of the product: steep spectra span more than the 16 digits that the product would keep.
    """
    upper = np.asarray(np.linalg.qr(factor.T, mode="r"))
    return upper.T * np.where(np.diag(upper) < 0, -1.0, 1.0)


def _phase_quadrature(n_channels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes κ in (0, π) and weights of ∫ dκ/π for spectra that are steep near 0 and turn by κ per channel."""
    turn = np.pi / n_channels
    edges = np.concatenate(
        [[0.0], np.geomspace(LOWEST_PHASE, turn, LOG_INTERVALS), turn * np.arange(2, n_channels + 1)]
    )
    nodes, weights = np.polynomial.legendre.leggauss(NODES_PER_INTERVAL)
    half = np.diff(edges)[:, None] / 2
    phase = (edges[:-1, None] + half * (1 + nodes)).ravel()
    return phase, (half * weights).ravel() / np.pi
