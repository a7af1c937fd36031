"""The part of a data set that is calibrated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic_core import PydanticCustomError

from calstudy.base.constants import SAME_LENGTH
from calstudy.base.errors import InputError
from calstudy.base.units import parse_quantity
from calstudy.base.visibilities import polarization_names, positions

if TYPE_CHECKING:
    from pyuvdata import UVData

KEYS = {
    "antennas": "antennas=0,1,12",
    "lengths": "lengths=14 m..60 m",
    "times": "times=0..9",
    "frequencies": "frequencies=120 MHz..180 MHz",
    "polarizations": "polarizations=xx,yy",
}
"""Keys of selections, with an example each."""
NOUNS = {"lengths": ("baselines", 1, " m"), "times": ("integrations", 1, ""), "frequencies": ("channels", 1e6, " MHz")}
"""What a range selects, and the unit of its ends in messages."""
SAME_FREQUENCY = 1.0
"""Frequencies that differ by at most this, Hz, are the same but for rounding."""


@dataclass(frozen=True)
class Selection:
    """Part of a data set; None everywhere means all of it. Ranges include both ends, None is an open end.

    A length (m) or a frequency (Hz) that is an end but for rounding is inside. Antennas are ``1``, ``number:1`` or
    ``name:1``, times are indices from zero, and polarizations are ``xx`` or ``ee``. With `autos`, a selection of
    lengths keeps the autocorrelations of the antennas that are left.
    """

    antennas: tuple[str, ...] | None = None
    lengths: tuple[float | None, float | None] | None = None
    times: tuple[int | None, int | None] | None = None
    frequencies: tuple[float | None, float | None] | None = None
    polarizations: tuple[str, ...] | None = None
    autos: bool = False


def split_selections(texts: Sequence[str]) -> dict[str, str]:
    """Split the ``key=value`` texts of --select; raises InputError if a key is unknown or given twice."""
    found: dict[str, str] = {}
    for text in texts:
        key, equals, value = (part.strip() for part in text.partition("="))
        if not equals or key not in KEYS or not value:
            raise InputError(f"--select {text}: write one of {'; '.join(KEYS.values())}")
        if key in found:
            raise InputError(f"--select {key}: given twice")
        found[key] = value
    return found


def parse_values(values: Mapping[str, str], where: str, autos: bool = False) -> Selection:
    """Read a value for each of some of the `KEYS`; raise InputError, with `where` before the key, for a bad one."""
    return Selection(**{key: _value(key, value, f"{where}{key}") for key, value in values.items()}, autos=autos)


def _value(key: str, value: str, where: str) -> Any:
    if key in ("antennas", "polarizations"):
        return tuple(item.strip() for item in value.split(",") if item.strip())
    ends = value.split("..")
    if len(ends) != 2:
        raise InputError(f"{where}: write a range such as {KEYS[key]}; either end may be left out")
    try:
        low, high = (_end(key, end.strip()) for end in ends)
    except (PydanticCustomError, ValueError) as error:
        counted = f"not a whole number of at least 0; integrations are counted from 0, such as {KEYS[key]}"
        raise InputError(f"{where}: {error.message() if isinstance(error, PydanticCustomError) else counted}") from None
    if low is not None and high is not None and low > high:
        raise InputError(f"{where}: the first end of the range is above the second; exchange them")
    return low, high


def _end(key: str, text: str) -> float | int | None:
    if not text:
        return None
    if key == "times":
        if not text.isdecimal():
            raise ValueError(text)
        return int(text)
    return parse_quantity(text, "m", "14 m") if key == "lengths" else parse_quantity(text, "Hz", "120 MHz")


def select(data: UVData, selection: Selection) -> UVData:
    """Return the selected part of a data set; the data are not changed.

    Raises InputError if an antenna or polarization is not in the data, or nothing is left.
    """
    chosen: dict[str, Any] = {}
    if selection.antennas is not None:
        chosen["antenna_nums"] = [_antenna(data, antenna) for antenna in selection.antennas]
    if selection.times is not None:
        times = np.unique(data.time_array)
        chosen["times"] = times[_within(np.arange(times.size), selection.times, 0, "times")]
    if selection.frequencies is not None:
        chosen["freq_chans"] = np.flatnonzero(
            _within(np.ravel(data.freq_array), selection.frequencies, SAME_FREQUENCY, "frequencies")
        )
    if selection.polarizations is not None:
        chosen["polarizations"] = [_polarization(data, name) for name in selection.polarizations]
    if selection.lengths is not None:
        chosen["blt_inds"] = np.flatnonzero(_of_length(data, selection.lengths, selection.autos))
    if not chosen:
        return data
    try:
        return data.select(inplace=False, **chosen)
    except ValueError as error:
        raise InputError(f"--select: nothing is left of the data ({error})") from None


def between(values: np.ndarray, ends: tuple[Any, Any], tolerance: float) -> np.ndarray:
    """Return which values are not below the first end and not above the second, but for a tolerance; None is open."""
    low, high = ends
    above = values >= (-np.inf if low is None else low - tolerance)
    return above & (values <= (np.inf if high is None else high + tolerance))


def _within(values: np.ndarray, ends: tuple[Any, Any], tolerance: float, key: str) -> np.ndarray:
    inside = between(values, ends, tolerance)
    if not inside.any():
        what, unit, name = NOUNS[key]
        first, last = (f"{end / unit:.7g}{name}" for end in (values.min(), values.max()))
        raise InputError(f"--select {key}: no {what} in this range; the data have {first} to {last}")
    return inside


def _of_length(data: UVData, ends: tuple[float | None, float | None], autos: bool) -> np.ndarray:
    """Return a mask of the samples of baselines of these lengths (m); autocorrelations have length zero.

    With `autos` those of the antennas of these baselines are kept, too.
    """
    numbers, enu = data.telescope.antenna_numbers, data.telescope.get_enu_antpos()
    first, second = (enu[positions(numbers, antennas)] for antennas in (data.ant_1_array, data.ant_2_array))
    lengths = np.linalg.norm(second - first, axis=1)
    chosen = _within(lengths, ends, SAME_LENGTH, "lengths")
    if autos:
        left = np.union1d(data.ant_1_array[chosen], data.ant_2_array[chosen])
        chosen |= (data.ant_1_array == data.ant_2_array) & np.isin(data.ant_1_array, left)
    return chosen


def antenna_text(data: UVData, number: int) -> str:
    """Return the text that selects an antenna: its number, marked as such if that is the name of another one."""
    return str(number) if _by_name(data).get(str(number), number) == number else f"number:{number}"


def _by_name(data: UVData) -> dict[str, int]:
    return dict(zip(data.telescope.antenna_names, data.telescope.antenna_numbers.tolist(), strict=True))


def _antenna(data: UVData, text: str) -> int:
    by_name = _by_name(data)
    present = set(data.ant_1_array.tolist()) | set(data.ant_2_array.tolist())
    kind, colon, value = text.partition(":")
    kind, name = (kind, value.strip()) if colon and kind in ("number", "name") else ("", text)
    named = None if kind == "number" else by_name.get(name)
    numbered = None if kind == "name" or not name.isdecimal() else int(name)
    if named is not None and numbered in present and named != numbered:
        other = next(other for other, number in by_name.items() if number == numbered)
        raise InputError(
            f"--select antennas: {name!r} is the name of antenna {named} and the number of '{other}'; write "
            f"'name:{name}' or 'number:{name}'"
        )
    number = numbered if named is None else named
    if number is None or number not in present:
        raise InputError(
            f"--select antennas: {text!r} is not in the data, which have {', '.join(map(str, sorted(present)))}"
        )
    return number


def _polarization(data: UVData, name: str) -> int:
    numbers = {polarization_names([number]): int(number) for number in data.polarization_array}
    for shown, number in zip(data.get_pols(), list(data.polarization_array), strict=True):
        numbers[shown.lower()] = int(number)
    if data.telescope.feed_array is None:
        # Old files lack the orientation of their feeds; x is taken to be east, as in calibration.
        numbers |= {east: numbers[x] for east, x in (("ee", "xx"), ("nn", "yy")) if x in numbers}
    if name.lower() not in numbers:
        present = polarization_names(data.polarization_array)
        raise InputError(f"--select polarizations: {name!r} is not in the data, which have {present}")
    return numbers[name.lower()]
