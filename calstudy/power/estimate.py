"""Delay power spectra of baseline pairs from even and odd visibilities, through hera_pspec.

Units are mK^2 h^-3 Mpc^3. Visibilities are in Jy with V_xx = 1/2 int A I, the convention of pyuvsim and fftvis, unless
the data set says ``pol_convention="avg"``.

`DiagonalPSpecData` is a faster implementation of its estimator, for diagonal weighting.
The weights of visibilities by flags and a taper form a diagonal matrix. The normalization matrices of the quadratic
estimator are then circulant with a closed form; hera_pspec sums over four channel indices (80 s and 3.2 GB at 384
channels). They depend on the flags only; hera_pspec keeps dense matrices for every baseline (7 GB for 630).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import lru_cache
from itertools import permutations
from typing import TYPE_CHECKING, Any

import numpy as np
from hera_pspec import PSpecData, UVPSpec
from hera_pspec.pspecbeam import PSpecBeamFromArray
from pyuvdata import UVData, utils

from calstudy.base.constants import BOLTZMANN, SPEED_OF_LIGHT
from calstudy.base.errors import InputError
from calstudy.base.visibilities import antenna_pairs, baseline_vectors
from calstudy.instrument.layouts import redundant_groups
from calstudy.power.cosmology import hera_conversions, make_cosmology, redshift
from calstudy.power.delay import make_taper

if TYPE_CHECKING:
    from hera_pspec.conversions import Cosmo_Conversions

    from calstudy.power.interface import PowerBeam
    from calstudy.power.settings import PowerSettings


class DiagonalPSpecData(PSpecData):
    """`hera_pspec.PSpecData` for identity weighting, a taper, and as many delays as channels.

    The interface and, to rounding, the numbers are those of ``pspec(..., input_data_weight="identity", norm="I",
    allow_fft=True)``. Baselines with the same flags share matrices.
    """

    def clear_cache(self, keys: list | None = None) -> None:
        """Delete all matrices."""
        super().clear_cache(keys)
        self._made: dict[tuple, np.ndarray] = {}
        self._latest: dict[str, tuple] = {}

    def validate_pol(self, dsets: tuple[int, int], pol_pair: tuple[int, int]) -> bool:
        """Check that both data sets have these polarizations, given as integers.

        hera_pspec's own test reads the telescope's ``x_orientation``, which pyuvdata has deprecated.
        """
        return all(pol in self.dsets[dset].polarization_array for dset, pol in zip(dsets, pol_pair, strict=True))

    def parse_blkey(self, key: tuple) -> tuple[int, tuple]:
        """Return the index of the data set and the baseline, with its polarization as an integer.

        For polarizations as text pyuvdata looks up the feeds of the telescope, which takes longer than the spectrum.
        """
        dset, (first, second, *polarization) = super().parse_blkey(key)
        numbers = [utils.polstr2num(pol) if isinstance(pol, str) else pol for pol in polarization]
        return dset, (first, second, *numbers)

    def I(self, key: tuple) -> np.ndarray:  # noqa: E743
        """Return the identity (Nfreqs, Nfreqs), one for all baselines."""
        return self._shared(("identity", self.spw_Nfreqs), lambda: np.identity(self.spw_Nfreqs))

    def w(self, key: tuple, include_extension: bool = False) -> np.ndarray:
        """Return the weights of a baseline, 1 where it is not flagged, (Nfreqs, Ntimes), once per baseline."""
        found = super().w
        return self._shared(("weights", key, include_extension), lambda: found(key, include_extension))

    def Y(self, key: tuple) -> np.ndarray:
        """Return the flag weights of a baseline on the diagonal, 1 where any time is unflagged, (Nfreqs, Nfreqs)."""
        weights = self._flag_weights(key)
        return self._shared(("flags", weights.tobytes()), lambda: np.diag(weights))

    def R(self, key: tuple) -> np.ndarray:
        """Return the data weighting (Nfreqs, Nfreqs) of a baseline: taper times flag weights."""
        self._require_diagonal()
        shared_key = ("weighting", self.taper, self.symmetric_taper, self._flag_weights(key).tobytes())
        if shared_key not in self._made:
            self._made[shared_key] = super().R(key)
            self._R: dict[tuple, np.ndarray] = {}
        return self._made[shared_key]

    def get_G(self, key1: tuple, key2: tuple, exact_norm: bool = False, pol: bool = False) -> np.ndarray:
        """Return G_ab = tr(R1 Q_a R2 Q_b) / 2, shape (Ndlys, Ndlys), complex."""
        return self._circulant_response(key1, key2, np.ones(2 * self.spw_Nfreqs - 1), exact_norm)

    def get_H(
        self, key1: tuple, key2: tuple, sampling: bool = False, exact_norm: bool = False, pol: bool = False
    ) -> np.ndarray:
        """Return H_ab = tr(R1 Q_a R2 Q_b) / 2 with band-integrated Q_b unless `sampling`, shape (Ndlys, Ndlys)."""
        lag = np.arange(1 - self.spw_Nfreqs, self.spw_Nfreqs)
        damping = np.ones(lag.size) if sampling else np.sinc(lag / self.spw_Nfreqs)
        return self._circulant_response(key1, key2, damping, exact_norm)

    def get_MW(self, G: np.ndarray, H: np.ndarray, mode: str = "I", **kwargs: object) -> tuple[np.ndarray, np.ndarray]:
        """Return the diagonal normalization M and the window functions W, (Ndlys, Ndlys) each, once per G and H."""
        if mode != "I":
            raise NotImplementedError(f"norm {mode!r} is not diagonal, allowed: 'I'")
        normalize = super().get_MW
        return self._once("normalization", G, H, lambda: normalize(G, H, mode=mode, **kwargs))

    def scalar_delay_adjustment(
        self,
        key1: tuple = (),
        key2: tuple = (),
        sampling: bool = False,
        Gv: np.ndarray | None = None,
        Hv: np.ndarray | None = None,
    ) -> float:
        """Return the factor that makes the normalization that of the band with its taper, once per G and H."""
        G = self.get_G(key1, key2) if Gv is None else Gv
        H = self.get_H(key1, key2, sampling) if Hv is None else Hv
        adjust = super().scalar_delay_adjustment
        return self._once(f"adjustment, {self.taper}", G, H, lambda: adjust(key1, key2, sampling, G, H))

    def p_hat(self, M: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the normalized band powers M q, shape (Ndlys, Ntimes), complex."""
        return M.diagonal()[:, None] * q

    def q_hat(
        self, key1: tuple, key2: tuple, allow_fft: bool = False, exact_norm: bool = False, pol: bool = False
    ) -> np.ndarray:
        """Return the unnormalized band powers conj(x1) R1 Q_a R2 x2 / 2, shape (Ndlys, Ntimes), complex."""
        self._require_diagonal(exact_norm)
        first, second = (self._delay_spectrum(key) for key in (key1, key2))
        return 0.5 * first.conj() * second

    def _delay_spectrum(self, key: tuple) -> np.ndarray:
        def transform() -> np.ndarray:
            weighted = self.R(key).diagonal()[:, None] * self.x(key)
            return np.fft.fftshift(np.fft.fft(weighted, axis=0), axes=0)

        # A baseline of a redundant group is in many pairs.
        return self._shared(("spectrum", self.taper, self.symmetric_taper, key), transform)

    def _flag_weights(self, key: tuple) -> np.ndarray:
        return self.w(key).max(axis=1)

    def _once(self, name: str, G: np.ndarray, H: np.ndarray, build: Callable[[], Any]) -> Any:
        """Return the result of `build`, computed again only if G or H is another array than at the last call."""
        latest = self._latest.get(name)
        if latest is None or latest[0] is not G or latest[1] is not H:
            latest = self._latest[name] = (G, H, build())
        return latest[2]

    def _shared(self, key: tuple, build: Callable[[], np.ndarray]) -> np.ndarray:
        if key not in self._made:
            self._made[key] = build()
        return self._made[key]

    def _circulant_response(self, key1: tuple, key2: tuple, damping: np.ndarray, exact_norm: bool) -> np.ndarray:
        """Return sum_ij r1_i r2_j damping_(j-i) exp(-2 pi i (a-b)(j-i) / N) / 2 over channels, for all delays a, b."""
        self._require_diagonal(exact_norm)
        n = self.spw_Nfreqs
        first, second = self.R(key1).diagonal().real, self.R(key2).diagonal().real
        folded = np.correlate(second, first, mode="full") * damping
        response = np.zeros(n)
        response += folded[n - 1 :]
        response[1:] += folded[: n - 1]
        if not response.any():
            return 0.5 * np.eye(n, dtype=complex)
        column = 0.5 * np.fft.fft(response)
        return column[(np.arange(n)[:, None] - np.arange(n)) % n]

    def _require_diagonal(self, exact_norm: bool = False) -> None:
        if self.data_weighting != "identity" or exact_norm or any(self.filter_extension):
            raise NotImplementedError("DiagonalPSpecData supports identity weighting and the usual normalization only")
        if self.spw_Ndlys != self.spw_Nfreqs:
            raise NotImplementedError(f"{self.spw_Ndlys} delays for {self.spw_Nfreqs} channels: they must be as many")


logger = logging.getLogger(__name__)


HERA_TAPERS = {"blackman-harris": "blackmanharris", "hann": "hann", "tukey": "tukey", "none": "none"}

Pair = tuple[tuple[int, int], tuple[int, int]]
"""A baseline, as antenna numbers (a, b), of the even data, and one of the odd data to cross it with."""


def make_pairs(uvd: UVData, settings: PowerSettings) -> list[Pair]:
    """Choose the pairs of baselines of the cross spectra (paper §Reduction of Simulation Products and Power Spectra).

    Either each baseline with itself (ab = cd), or each with every *other* one of its redundant group, in both orders
    (ab != cd), reversed if necessary to match the group. With ``pairs="auto"`` groups are used if at least half of the
    baselines have a redundant partner. Raise ValueError if groups are requested and no two baselines are redundant.
    """
    baselines = [(int(a), int(b)) for a, b in antenna_pairs(uvd)]
    same = [(pair, pair) for pair in baselines]
    if settings.pairs == "same-baseline":
        return same
    groups = redundant_groups(baseline_vectors(uvd), settings.redundancy_tolerance)
    members = np.bincount(groups.index)
    partnered = np.mean(members[groups.index] > 1)
    if settings.pairs == "auto" and partnered < 0.5:
        return same
    if partnered == 0:
        raise ValueError(
            f"power.pairs is 'redundant-group' but no two baselines are within {settings.redundancy_tolerance} m, "
            "allowed for this array: 'same-baseline' or 'auto'"
        )
    oriented = [
        pair[::-1] if conjugated else pair for pair, conjugated in zip(baselines, groups.conjugated, strict=True)
    ]
    order = np.argsort(groups.index, kind="stable")
    alike = ([oriented[member] for member in group] for group in np.split(order, np.cumsum(members)[:-1]))
    return [pair for group in alike for pair in permutations(group, 2)]


def kelvin_per_jansky(frequencies: np.ndarray, omega_p: np.ndarray, pol_convention: str | None) -> np.ndarray:
    """Return the beam-weighted mean brightness temperature of a visibility of 1 Jy, in K/Jy, shape (Nfreqs,).

    A uniform sky of temperature T gives V = int A I = 2 k T Omega_p / lambda^2 for the `pol_convention` "avg" of
    pyuvdata, and half of that, V_xx = 1/2 int A I, for "sum" or None. `frequencies` are in Hz, `omega_p` is the solid
    angle of the power beam in sr, (Nfreqs,) each.
    """
    halves = 1.0 if pol_convention == "avg" else 2.0
    wavelength = SPEED_OF_LIGHT / frequencies
    return halves * 1e-26 * wavelength**2 / (2 * BOLTZMANN * omega_p)


SAME_CHANNEL = 0.01
"""Part of a channel's width by which the frequencies of two halves may differ."""
MOST_NOISE = 1.5
"""Of a pair of baselines, over that of pairs with the same flags. The power is divided by the sum of the squared taper
over the channels that both have, which increases noise and sidelobes without limit where these are few."""


@lru_cache(maxsize=4)
def _conversions(cosmology: str, z: float) -> Cosmo_Conversions:
    """Return hera_pspec's cosmology object with a cache of its volumes: all spectra of a run ask for the same."""
    conversions = hera_conversions(make_cosmology(cosmology), z)
    conversions.X2Y = lru_cache(maxsize=10_000)(conversions.X2Y)
    return conversions


def estimate_power(even: UVData, odd: UVData, beam: PowerBeam, settings: PowerSettings) -> UVPSpec:
    """Compute the cross power of the delay spectra of two data sets that share the sky but not the noise.

    P = X^2 Y / (Omega_pp B_pp) V~ V~* (paper Eq. of Parsons et al. 2012) by hera_pspec's quadratic estimator with
    identity weighting. The beam is divided out channel by channel (Omega_p to temperature, Omega_pp / Omega_p^2 in the
    normalization), so its frequency dependence is accounted for; X and Y are taken over the band likewise.

    `even` and `odd` have one integration each, in Jy, and are not changed. The result has one spectrum per baseline
    pair and polarization, complex, in mK^2 h^-3 Mpc^3, unfolded, without window functions; it can be written to HDF5
    and read back. It has hera_pspec's conventions: conj(even) times odd, with the kernel exp(-2 pi i tau nu), so that
    its delay axis is the paper's, reversed.

    Pairs of baselines that are completely flagged in a polarization, or have few channels in common, are left out.
    Raise ValueError if the data sets differ in anything but data, have more than one integration or are not in Jy, and
    InputError if no pair is left.
    """
    _require_match(even, odd)
    pairs = _usable(make_pairs(even, settings), even, odd, settings.taper)
    frequencies = even.freq_array
    angles = {int(pol): beam.solid_angles(frequencies, utils.polnum2str(pol)) for pol in even.polarization_array}
    centre = float(redshift(frequencies.mean()))
    adapter = PSpecBeamFromArray(
        OmegaP={pol: found[0] for pol, found in angles.items()},
        OmegaPP={pol: found[1] for pol, found in angles.items()},
        beam_freqs=frequencies,
        cosmo=_conversions(settings.cosmology, centre),
    )
    estimator = DiagonalPSpecData(
        dsets=[_to_millikelvin(uvd, angles) for uvd in (even, odd)], labels=["even", "odd"], beam=adapter
    )
    logger.info("crossing %d pairs of baselines", len(pairs))
    return estimator.pspec(
        *map(list, zip(*pairs, strict=True)),
        dsets=(0, 1),
        pols=[(pol, pol) for pol in angles],
        input_data_weight="identity",
        taper=HERA_TAPERS[settings.taper],
        # A group may be wider than the tolerance between neighbours; that choice was made above.
        baseline_tol=np.inf,
        store_window=False,
        allow_fft=True,
        verbose=False,
        history="calstudy",
    )


def _usable(pairs: list[Pair], even: UVData, odd: UVData, taper: str) -> list[Pair]:
    """Leave out pairs that have no data in some polarization, or too few channels in common (`MOST_NOISE`)."""
    if not (even.flag_array.any() or odd.flag_array.any()):
        return pairs
    numbers = antenna_pairs(even).tolist()
    rows = {pair: row for row, (a, b) in enumerate(numbers) for pair in ((a, b), (b, a))}
    first, second = (np.array([rows[pair[side]] for pair in pairs]) for side in (0, 1))
    kept = np.ones(len(pairs), bool)
    weights = make_taper(taper, even.Nfreqs) ** 2
    for hand in range(even.Npols):
        # Many baselines have the same flags, and many pairs the same flags of both.
        found = [np.unique(~uvd.flag_array[..., hand], axis=0, return_inverse=True) for uvd in (even, odd)]
        (of_even, index), (of_odd, other) = ((used.astype(float), place.ravel()) for used, place in found)
        (one, two), place = np.unique([index[first], other[second]], axis=1, return_inverse=True)
        common = np.einsum("pf,pf->p", (of_even * weights)[one], of_odd[two])
        with np.errstate(divide="ignore", invalid="ignore"):
            noise = np.sqrt((of_even @ weights)[one] * (of_odd @ weights)[two]) / common
        kept &= noise[place.ravel()] < MOST_NOISE
    if not kept.any():
        raise InputError(
            "power: no pair of baselines has data in the same channels and in all polarizations of even and odd data; "
            "select one polarization, or the channels that most antennas have"
        )
    if not kept.all():
        logger.warning(
            "%d of %d pairs of baselines are left out of power spectra: flagged, or with too few channels in common",
            np.sum(~kept),
            len(pairs),
        )
    return [pair for pair, is_kept in zip(pairs, kept, strict=True) if is_kept]


def _to_millikelvin(uvd: UVData, angles: dict[int, tuple[np.ndarray, np.ndarray]]) -> UVData:
    converted = uvd.copy()
    for index, pol in enumerate(uvd.polarization_array):
        factor = 1e3 * kelvin_per_jansky(uvd.freq_array, angles[int(pol)][0], uvd.pol_convention)
        converted.data_array[..., index] *= factor
    converted.vis_units = "mK"
    # For each baseline of a rectangular data set pyuvdata lists those of all.
    converted.blts_are_rectangular = False
    return converted


def _require_match(even: UVData, odd: UVData) -> None:
    for name, uvd in (("even", even), ("odd", odd)):
        if uvd.Ntimes != 1:
            raise ValueError(f"the {name} data have {uvd.Ntimes} integrations, expected 1: average them first")
        if uvd.vis_units is None or uvd.vis_units.lower() != "jy":
            raise ValueError(f"the {name} data are in {uvd.vis_units!r}, expected 'Jy'")
    # Programs round the frequencies of one band differently.
    channel = SAME_CHANNEL * float(np.mean(np.abs(even.channel_width)))
    tolerances = {"ant_1_array": 0.0, "ant_2_array": 0.0, "freq_array": channel, "polarization_array": 0.0}
    for name, tolerance in tolerances.items():
        first, second = getattr(even, name), getattr(odd, name)
        if first.shape != second.shape or not np.allclose(first, second, rtol=0, atol=tolerance):
            raise ValueError(f"the even and odd data differ in {name}, expected the same")
