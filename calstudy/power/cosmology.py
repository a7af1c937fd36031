"""Conversion of baselines and delays to wavenumbers, with the one cosmology of a study.

The amplitude of the simulated 21 cm signal and the power spectrum estimator both use astropy's cosmologies. hera_pspec
has its own class with its own distances; `hera_conversions` makes one that agrees with astropy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np

from calstudy.base.constants import HYDROGEN_LINE, SPEED_OF_LIGHT

if TYPE_CHECKING:
    from astropy.cosmology import FLRW
    from hera_pspec.conversions import Cosmo_Conversions

    from calstudy.sky.settings import Eor


FloatOrArray = TypeVar("FloatOrArray", float, np.ndarray)


def make_cosmology(name: str) -> FLRW:
    """Return astropy's cosmology of this name ("Planck15", "Planck18" or "WMAP9"); raise ValueError for another."""
    import astropy.cosmology

    if name not in astropy.cosmology.available:
        raise ValueError(f"cosmology {name!r} is unknown, allowed: {', '.join(astropy.cosmology.available)}")
    return getattr(astropy.cosmology, name)


def redshift(frequency: FloatOrArray) -> FloatOrArray:
    """Return the redshift at which the 21 cm line is observed at `frequency` (Hz)."""
    return HYDROGEN_LINE / frequency - 1.0


def transverse_scale(cosmology: FLRW, z: float) -> float:
    """Return X, the transverse comoving distance per angle at redshift `z`, in Mpc/rad."""
    return float(cosmology.comoving_transverse_distance(z).to_value("Mpc"))


def radial_scale(cosmology: FLRW, z: float) -> float:
    """Return Y = c (1+z)^2 / (H(z) f21), the line-of-sight comoving distance per frequency at `z`, in Mpc/Hz."""
    from astropy import constants

    return float((constants.c / cosmology.H(z)).to_value("Mpc")) * (1.0 + z) ** 2 / HYDROGEN_LINE


def k_perpendicular(cosmology: FLRW, length: np.ndarray, frequency: float) -> np.ndarray:
    """Return k_perp = 2 pi |b| / (lambda X) in h/Mpc for baseline lengths in m, of any shape, at a frequency in Hz."""
    wavelengths = np.asarray(length) * frequency / SPEED_OF_LIGHT
    return 2 * np.pi * wavelengths / transverse_scale(cosmology, redshift(frequency)) / cosmology.h


def k_parallel(cosmology: FLRW, delay: np.ndarray, frequency: float) -> np.ndarray:
    """Return k_par = 2 pi tau / Y in h/Mpc for delays in s, of any shape, at the centre of the band in Hz."""
    return 2 * np.pi * np.asarray(delay) / radial_scale(cosmology, redshift(frequency)) / cosmology.h


def hera_conversions(cosmology: FLRW, z: float) -> Cosmo_Conversions:
    """Return hera_pspec's cosmology object with astropy's distances around redshift `z`, the centre of the band.

    hera_pspec has only matter, curvature and Lambda, which makes its X^2 Y 0.1 to 0.8 % too large for Planck15 because
    radiation and massive neutrinos are missing, and stores those numbers in its files. Here the matter and Lambda terms
    are set so that both H(z) and the comoving distance equal astropy's at `z`: *effective* densities, which survive a
    round trip through HDF5 and describe this redshift, not today. All cosmologies of `PowerSettings` are flat.
    """
    from hera_pspec.conversions import Cosmo_Conversions

    dark_energy, matter = _effective_densities(cosmology, z)
    # Plain floats: hera_pspec writes their repr to HDF5 and cannot read "np.float64(...)" back.
    baryons = float(cosmology.Ob0)
    return Cosmo_Conversions(
        Om_L=dark_energy, Om_b=baryons, Om_c=matter - baryons, Om_M=matter, Om_k=0.0, H0=float(cosmology.H0.value)
    )


def _effective_densities(cosmology: FLRW, z: float) -> tuple[float, float]:
    """Return Lambda and matter of E^2 = Lambda + matter (1+z)^3 with astropy's H and comoving distance at `z`."""
    from scipy.integrate import quad
    from scipy.optimize import brentq

    expansion = float(cosmology.efunc(z)) ** 2
    distance = float((cosmology.comoving_distance(z) / cosmology.hubble_distance).decompose().value)

    def matter(dark_energy: float) -> float:
        return (expansion - dark_energy) / (1 + z) ** 3

    def excess(dark_energy: float) -> float:
        return quad(lambda x: (dark_energy + matter(dark_energy) * (1 + x) ** 3) ** -0.5, 0.0, z)[0] - distance

    dark_energy = brentq(excess, 0.3, 1.2, xtol=1e-13)
    return dark_energy, matter(dark_energy)


MILLIKELVIN2 = 1e6


def input_power(settings: Eor, k: np.ndarray, cosmology: str, band: tuple[float, float] | None = None) -> np.ndarray:
    """Return the input P(k), mK^2 h^-3 Mpc^3, at wavenumbers `k` (h/Mpc, any shape).

    Amplitude and shape in the settings of the EoR sky are in units without h. `band` has the centres of the first and
    the last channel of the data, Hz; only a box needs it.
    """
    from calstudy.sky.eor import input_power as in_kelvin

    h = float(make_cosmology(cosmology).h)
    return MILLIKELVIN2 * h**3 * in_kelvin(settings, np.asarray(k) * h, h, band)
