"""Foregrounds made by one engine against the same foregrounds made by another, in full."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.checks.floor import folded_spectrum
from calstudy.errors import InputError
from calstudy.simulate.floor import DelayFloor, delay_floor, delay_profile, floor_buffers, length_bins
from calstudy.visibilities import baseline_vectors, from_cube, to_cube

if TYPE_CHECKING:
    from pyuvdata import UVData

GROUPS = 6


@dataclass(frozen=True)
class GroupAgreement:
    """The difference of two simulations on the baselines of a range of lengths, relative to the rms of these.

    Attributes
    ----------
    shortest, longest
        Range of lengths, m.
    baselines
        How many there are.
    rms_jy
        Rms of the visibilities, Jy.
    largest, rms
        Largest and rms difference, over `rms_jy`.
    delay
        Delays >= 0, (Ndelays,), s.
    spectrum, difference
        Rms of the delay spectra of the visibilities and of the difference, over the largest of `spectrum`, (Ndelays,).
    """

    shortest: float
    longest: float
    baselines: int
    rms_jy: float
    largest: float
    rms: float
    delay: np.ndarray
    spectrum: np.ndarray
    difference: np.ndarray


@dataclass(frozen=True)
class EngineAgreement:
    """How far two simulations of the same foregrounds agree.

    Attributes
    ----------
    groups
        Ranges of baseline length that hold baselines, ascending.
    largest, rms
        Largest and rms difference of all visibilities over their rms.
    worst_slot
        Largest difference of any integration and channel over the rms of that integration and channel.
    taper
        Of the delay spectra.
    floors, differences
        By taper: the delay floor of the visibilities, and the same of the difference, relative to the same peaks.
    """

    groups: tuple[GroupAgreement, ...]
    largest: float
    rms: float
    worst_slot: float
    taper: str
    floors: dict[str, DelayFloor]
    differences: dict[str, DelayFloor]

    def as_json(self) -> dict[str, Any]:
        """Return the numbers, without the delay spectra."""
        groups = [
            {key: value for key, value in asdict(group).items() if not isinstance(value, np.ndarray)}
            for group in self.groups
        ]
        worst = {
            taper: {"foregrounds_db": floor.worst_db, "difference_db": self.differences[taper].worst_db}
            for taper, floor in self.floors.items()
        }
        return {
            "largest": self.largest,
            "rms": self.rms,
            "worst_slot": self.worst_slot,
            "groups": groups,
            "beyond_horizon": worst,
        }


def compare_engines(foregrounds: UVData, reference: UVData) -> EngineAgreement:
    """Compare two simulations of the same sky, beam and observation.

    Parameters
    ----------
    foregrounds, reference
        Visibilities in Jy, equally spaced channels, the same observation. Not mutated.

    Raises
    ------
    InputError
        If the band leaves no delays beyond the horizon of the longest baseline.
    ValueError
        If the observations differ.
    """
    for name in ("baseline_array", "time_array", "freq_array", "polarization_array"):
        if not np.array_equal(getattr(foregrounds, name), getattr(reference, name)):
            raise ValueError(f"the two simulations differ in {name}, expected the same observation")
    buffers = floor_buffers(foregrounds)
    if not buffers:
        raise InputError("instrument.channels: too wide or too few, no delay lies beyond the horizon and the main lobe")
    taper = "dolph-chebyshev" if "dolph-chebyshev" in buffers else next(iter(buffers))
    cube = to_cube(reference)
    difference = from_cube(foregrounds, to_cube(foregrounds) - cube)
    size = np.abs(to_cube(difference))
    rms = _rms(cube)
    slots = np.sqrt(np.mean(np.abs(cube) ** 2, axis=(1, 3)))
    return EngineAgreement(
        groups=_groups(reference, difference, taper),
        largest=float(size.max() / rms),
        rms=_rms(size) / rms,
        worst_slot=float((size.max(axis=(1, 3)) / slots).max()),
        taper=taper,
        floors={name: delay_floor(reference, buffer, name, GROUPS) for name, buffer in buffers.items()},
        differences={
            name: delay_floor(difference, buffer, name, GROUPS, reference) for name, buffer in buffers.items()
        },
    )


def _groups(reference: UVData, difference: UVData, taper: str) -> tuple[GroupAgreement, ...]:
    lengths = np.linalg.norm(baseline_vectors(reference), axis=1)
    edges, bins = length_bins(lengths, GROUPS)
    delays, power = delay_profile(reference, taper)
    _, power_of_difference = delay_profile(difference, taper)
    groups = []
    for index in np.unique(bins):
        members = bins == index
        visibilities, deviations = to_cube(reference)[:, members], np.abs(to_cube(difference)[:, members])
        delay, spectrum = folded_spectrum(delays, power[members].mean(axis=0))
        _, deviation = folded_spectrum(delays, power_of_difference[members].mean(axis=0))
        rms = _rms(visibilities)
        groups.append(
            GroupAgreement(
                shortest=float(edges[index]),
                longest=float(edges[index + 1]),
                baselines=int(members.sum()),
                rms_jy=rms,
                largest=float(deviations.max() / rms),
                rms=_rms(deviations) / rms,
                delay=delay,
                spectrum=np.sqrt(spectrum / spectrum.max()),
                difference=np.sqrt(deviation / spectrum.max()),
            )
        )
    return tuple(groups)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.abs(values) ** 2)))
