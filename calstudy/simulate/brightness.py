"""Flux density of each component of a sky model at each frequency, for all spectral types and units."""

from __future__ import annotations

import numpy as np
from astropy import units
from astropy_healpix import nside_to_pixel_area
from pyradiosky import SkyModel
from pyradiosky.utils import jy_to_ksr

from calstudy.base.errors import InputError


def is_polarized(sky: SkyModel) -> bool:
    """Return whether any component has Stokes Q, U or V."""
    return bool(np.any(sky.stokes[1:].value))


def stokes_i(sky: SkyModel, frequencies: np.ndarray, components: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Return Stokes I of a sky in Jy, with the same conventions as pyuvsim.

    HEALPix pixels count as points that hold the pixel's integral, and brightness temperatures are converted at the
    reference frequency of a spectral-index or flat component, or else at each frequency (Rayleigh-Jeans).

    Parameters
    ----------
    sky
        Points in Jy or K sr, or HEALPix in Jy/sr or K, of any spectral type.
    frequencies : (Nfreqs,) float
        Frequencies in Hz.
    components
        Indices of the components, all by default.

    Returns
    -------
    (Nfreqs, Ncomponents) float
        Flux densities in Jy. If they are the same at all frequencies, a read-only view that does not repeat them in
        memory.

    Raises
    ------
    InputError
        If a spectral index is not a number, a `full` sky lacks one of the frequencies, or a `subband` sky does not
        span them.
    """
    if sky.spectral_type == "subband":
        sky = sky.at_frequencies(frequencies * units.Hz, inplace=False, run_check=False)
    spectrum = _stokes_values(sky, frequencies, components) * _jansky_factor(sky, frequencies, components)
    return np.broadcast_to(spectrum, (len(frequencies), spectrum.shape[1]))


def _stokes_values(sky: SkyModel, frequencies: np.ndarray, components: np.ndarray | slice) -> np.ndarray:
    """Return Stokes I in the unit of the sky model, (Nfreqs or 1, Ncomponents)."""
    values = sky.stokes[0].value
    if sky.spectral_type == "flat":
        return values[:, components]
    if sky.spectral_type == "spectral_index":
        if np.isnan(sky.spectral_index).any():
            raise InputError("the spectral index of a component of the sky is not a number, give it a value or drop it")
        reference, index = sky.reference_frequency.to_value("Hz")[components], sky.spectral_index[components]
        return values[:, components] * (frequencies[:, None] / reference) ** index
    available = sky.freq_array.to_value("Hz")
    nearest = np.abs(available - frequencies[:, None]).argmin(axis=1)
    missing = np.abs(available[nearest] - frequencies) > sky.freq_tol.to_value("Hz")
    if missing.any():
        raise InputError(f"the sky is given channel by channel and has none at {frequencies[missing][0]} Hz")
    return np.stack([values[row, components] for row in nearest])


def _jansky_factor(sky: SkyModel, frequencies: np.ndarray, components: np.ndarray | slice) -> np.ndarray | float:
    """Return the factor from the unit of the sky model to Jy, broadcastable to (Nfreqs, Ncomponents)."""
    solid_angle = nside_to_pixel_area(sky.nside) if sky.component_type == "healpix" else 1 * units.sr / units.sr
    unit = sky.stokes.unit * solid_angle.unit
    if unit.is_equivalent("Jy"):
        return float(solid_angle.value * unit.to("Jy"))
    scale = float(solid_angle.value * unit.to("K sr"))
    if sky.spectral_type in ("flat", "spectral_index") and sky.reference_frequency is not None:
        return scale / jy_to_ksr(sky.reference_frequency[components]).value
    return scale / jy_to_ksr(frequencies * units.Hz).value[:, None]
