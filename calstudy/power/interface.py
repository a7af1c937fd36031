"""The interface of estimators of power spectra: from two averaged data sets to delay spectra."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol, cast

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.plugins import Plugin, guarded
from calstudy.base.visibilities import polarization_names
from calstudy.power.binned import independent_times, make_bin_edges
from calstudy.power.delay import TAPERS, channel_width, delays, horizon_delay
from calstudy.power.settings import ESTIMATORS, PowerSettings
from calstudy.power.spectra import DelaySpectra, average_times, bins_of_k, modes_of, of_common_units, outside_wedge

if TYPE_CHECKING:
    from pyuvdata import UVData

logger = logging.getLogger(__name__)

USUAL_K = 0.5
"""Bins from zero to this, h/Mpc, or more, have modes of arrays with baselines of some 200 m or less."""


class PowerBeam(Protocol):
    """The part of the beam interface that estimators use (`calstudy.instrument.beams`)."""

    def solid_angles(self, frequencies: np.ndarray, pol: str) -> tuple[np.ndarray, np.ndarray]:
        """Return integrals over the sky in sr of the power beam and its square, (Nfreqs,) each, for "xx" or "yy"."""


class Estimator(Plugin, ABC):
    """An estimator of delay power spectra. Fields of a subclass are its settings."""

    registry: ClassVar = ESTIMATORS
    inherited_with: ClassVar = {"estimate_and_export": "estimate"}

    kind: str = Field("", description="Name of an estimator, or a file.py.")
    largest_antenna: ClassVar[int | None] = None
    """Largest number of an antenna that it accepts, or None."""

    @abstractmethod
    def estimate(self, even: UVData, odd: UVData, beam: PowerBeam, settings: PowerSettings) -> DelaySpectra:
        """Return the delay spectra of even times odd.

        Parameters
        ----------
        even, odd
            One integration each (`calstudy.power.average`), same baselines, channels and polarizations, in Jy with
            V_xx = 1/2 int A I. They share the sky but not the noise, and must not be changed. `odd` is `even` where the
            power of one data set is computed.
        beam : of the array
        settings
            The `power` section: taper, pairs, redundancy tolerance, cosmology. Bins, `wedge_buffer` and `length_bin`
            have their defaults: they apply later, when spectra are averaged.
        """

    def estimate_and_export(
        self, even: UVData, odd: UVData, beam: PowerBeam, settings: PowerSettings, folder: Path
    ) -> DelaySpectra:
        """Return the delay spectra of `estimate`, and write files in formats of the estimator into an empty folder."""
        del folder
        return self.estimate(even, odd, beam, settings)


def require_antennas(settings: PowerSettings, numbers: np.ndarray, remedy: str) -> None:
    """Raise InputError if the estimator does not accept the number of an antenna."""
    largest = cast(Estimator, settings.estimator).largest_antenna
    if largest is not None and numbers.max() > largest:
        raise InputError(
            f"antenna number {numbers.max()} is too large for the estimator, allowed: 0 to {largest}; {remedy}"
        )


def require_modes(settings: PowerSettings, lengths: np.ndarray, frequencies: np.ndarray) -> None:
    """Raise InputError if spherical spectra have no mode; baseline `lengths` are in m, channels in Hz."""
    lengths = np.unique(lengths[lengths > 0])
    if not lengths.size:
        raise InputError("power: all baselines have a length of zero, and none has a mode outside the wedge")
    found = delays(frequencies.size, channel_width(frequencies))
    farthest = float(np.abs(found).max())
    if farthest <= horizon_delay(float(lengths[0])) + settings.wedge_buffer:
        raise InputError(
            f"power.wedge_buffer = {1e6 * settings.wedge_buffer:g} us: no mode is outside the wedge: the shortest "
            f"baseline has {lengths[0]:.3g} m, and delays reach {1e6 * farthest:.4g} us; give a smaller one, or "
            "narrower channels"
        )
    if settings.bins.min == 0 and settings.bins.max >= USUAL_K:
        # A plan is faster without cosmology.
        return
    modes, edges = modes_of(found, lengths, float(frequencies.mean()), settings), make_bin_edges(settings.bins)
    if (bins_of_k(modes, edges, settings.wedge_buffer) < 0).all():
        k = np.hypot(modes.k_perp[:, None], modes.k_parallel)[outside_wedge(modes, settings.wedge_buffer)]
        raise InputError(
            f"power.bins: no mode outside the wedge is between {edges[0]:g} and {edges[-1]:g} h/Mpc; they are between "
            f"{k.min():.3g} and {k.max():.3g} h/Mpc"
        )


def estimate_spectra(
    even: UVData, odd: UVData, beam: PowerBeam, settings: PowerSettings, folder: Path | None = None
) -> DelaySpectra:
    """Return the delay spectra of even times odd by the estimator of the settings, checked.

    The data are as for `Estimator.estimate`, but of one integration or several, whose powers are averaged.
    Polarizations that are completely flagged in either are left out, then integrations in which one of the others is,
    and baselines that are completely flagged in another integration.
    The estimator may write files into `folder`, or nowhere if it is None; with several integrations each has its own
    folder, `block-1` and so on.

    Raises InputError if the estimator refuses, fails, or returns anything but consistent, finite `DelaySpectra`, if
    even and odd data have different numbers of integrations, or if no integration or no baseline is left.
    """
    estimator = cast(Estimator, settings.estimator)
    found = []
    if without := polarizations_without_data(even, odd):
        kept = [int(pol) for pol in even.polarization_array if pol not in without]
        even, odd = (uvd.select(polarizations=kept, inplace=False) for uvd in (even, odd))
    blocks = _blocks(even, odd)
    for number, (first, second) in enumerate(blocks, 1):
        place = folder
        if folder is not None and len(blocks) > 1:
            place = folder / f"block-{number}"
            place.mkdir()
        with guarded(estimator):
            if place is None:
                spectra = estimator.estimate(first, second, beam, settings)
            else:
                spectra = estimator.estimate_and_export(first, second, beam, settings, place)
        if (fault := _fault(spectra)) is not None:
            raise InputError(f"estimator {estimator.label!r}: {fault}")
        found.append(spectra)
    if len(found) == 1:
        return found[0]
    # Pairs of baselines with few channels in common are left out of one block, and not of another.
    found = list(of_common_units({f"block {number}": one for number, one in enumerate(found, 1)}).values())
    sidereal_times = np.array([first.lst_array[0] for first, _ in blocks])
    latitude = float(even.telescope.location.lat.rad)
    return average_times(found, independent_times(sidereal_times, latitude, found[0].omega_pp))


def polarizations_without_data(even: UVData, odd: UVData) -> list[int]:
    """Return the polarizations that are completely flagged in either data set; empty if there are no others."""
    flagged = np.any([uvd.flag_array.all(axis=(0, 1)) for uvd in (even, odd)], axis=0)
    return [] if flagged.all() else [int(pol) for pol in even.polarization_array[flagged]]


def _blocks(even: UVData, odd: UVData) -> list[tuple[UVData, UVData]]:
    """Return even and odd data of each integration, time-major; the same baselines are completely flagged in all."""
    if even.Ntimes == odd.Ntimes == 1:
        return [(even, odd)]
    if even.Ntimes != odd.Ntimes:
        raise InputError(
            f"power.coherent_time: even and odd data have {even.Ntimes} and {odd.Ntimes} blocks with integrations, and "
            "must have the same"
        )
    every = [(_integration(even, number), _integration(odd, number)) for number in range(even.Ntimes)]
    with_data = [pair for pair in every if not any(uvd.flag_array.all() for uvd in pair)]
    pairs = [pair for pair in with_data if not any(uvd.flag_array.all(axis=(0, 1)).any() for uvd in pair)]
    hands = polarization_names(even.polarization_array)
    if with_data and not pairs:
        raise InputError(
            f"power.coherent_time: every block lacks one of the polarizations {hands}, flagged altogether; a longer "
            "time may help, or a selection of one polarization"
        )
    if len(pairs) < len(with_data):
        lacking = len(with_data) - len(pairs)
        logger.warning("%d of %d blocks are left out: one polarization is flagged", lacking, len(every))
    pairs = pairs or every[:1]
    missing = np.any([uvd.flag_array.all(axis=1) for pair in pairs for uvd in pair], axis=0)
    for pair in pairs:
        for uvd in pair:
            uvd.flag_array |= missing[:, None]
    if missing.any(axis=1).all() and len(pairs) > 1:
        raise InputError(
            "power.coherent_time: every baseline is flagged altogether in one of the blocks, in one of the "
            f"polarizations {hands}; a longer time may help"
        )
    return pairs


def _integration(uvd: UVData, number: int) -> UVData:
    rows = np.arange(number * uvd.Nbls, (number + 1) * uvd.Nbls)
    found = uvd.select(blt_inds=rows, inplace=False, run_check=False)
    # hera_pspec refuses data with phase centres besides their own.
    (centre,) = np.unique(found.phase_center_id_array).tolist()
    found.phase_center_catalog = {centre: found.phase_center_catalog[centre]}
    found.Nphase = 1
    return found


def _fault(found: object) -> str | None:
    """Return the fault of the result of an estimator, or None."""
    if not isinstance(found, DelaySpectra):
        return f"returned a {type(found).__name__}, expected DelaySpectra"
    units, n_delays = len(found.n_pairs), len(found.delay)
    expected = {"power": (units, n_delays), "vectors": (units, 3), "k_perp": (units,), "k_parallel": (n_delays,)}
    for name, shape in expected.items():
        values = getattr(found, name)
        if values.shape != shape:
            return f"its {name} has shape {values.shape}, expected {shape} for {units} units and {n_delays} delays"
        if not np.isfinite(values).all():
            return f"its {name} is not finite somewhere"
    if (np.diff(found.delay) <= 0).any():
        return "its delays do not ascend"
    return None if found.taper in TAPERS else f"its taper {found.taper!r} is none of {', '.join(TAPERS)}"
