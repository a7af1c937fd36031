"""Directions of linear feeds: files call either the eastern feed x, or the northern one."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from pyuvdata import Telescope, UVCal, UVData, UVFlag

TOLERANCE = np.radians(1)
RENAMED = {-5: -6, -6: -5, -7: -8, -8: -7}
"""AIPS numbers of polarizations, and of gains, when x and y exchange their names."""
X_IN_FILE = "x_infile"
"""Keyword of data whose feeds are not called as in their file: where the feed x of the file points."""

File = TypeVar("File", "UVCal", "UVData", "UVFlag")


def direction_of_x(telescope: Telescope) -> str | None:
    """Return "east" or "north", where feeds x point and y to the other; None if not known, or for other feeds."""
    from pyuvdata.utils.pol import get_x_orientation_from_feeds

    if telescope.feed_array is None or not np.isin(telescope.feed_array, ("x", "y")).all():
        return None
    return get_x_orientation_from_feeds(telescope.feed_array, telescope.feed_angle, tols=(0, TOLERANCE))


def x_in_file(data: UVData | UVCal) -> str | None:
    """Return where the feed x of the file of data points, which files without directions mean by x."""
    return data.extra_keywords.get(X_IN_FILE) or direction_of_x(data.telescope)


def renamed(numbers: Iterable[int]) -> np.ndarray:
    """Return AIPS numbers of polarizations or gains after x and y exchanged their names."""
    return np.array([RENAMED.get(int(number), int(number)) for number in numbers])


def rename_feeds(found: UVCal | UVData | UVFlag, direction: str) -> None:
    """Exchange the names x and y of feeds, so that x points to a direction."""
    axis = "jones_array" if hasattr(found, "jones_array") else "polarization_array"
    numbers = renamed(getattr(found, axis))
    setattr(found, axis, numbers)
    found.telescope.set_feeds_from_x_orientation(direction, feeds=["x", "y"], polarization_array=numbers)


def with_feeds_of(found: File, template: UVData | UVCal) -> File:
    """Return what was read from a file with the names that its feeds have in a template; it is not changed.

    Names without directions are those of the template's own file.
    """
    given = found.telescope.feed_array is not None
    own = direction_of_x(found.telescope) if given else x_in_file(template)
    wanted = direction_of_x(template.telescope)
    if own is None or wanted in (None, own):
        return found
    turned = found.copy()
    rename_feeds(turned, wanted)
    return turned
