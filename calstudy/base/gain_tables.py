"""Gains with what a file says of their axes: with the data that they are for, they become a UVCal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.errors import InputError

if TYPE_CHECKING:
    from pyuvdata import Telescope, UVCal, UVData

PARALLEL_HANDS = {"XX": -5, "YY": -6, "RR": -1, "LL": -2}
"""AIPS numbers of parallel hands by name; pyuvdata numbers the gains of feeds alike."""


@dataclass(frozen=True, eq=False)
class GainTable:
    """Gains with what a file says of their axes, of the convention V_ab = g_a g_b* m_ab of pyuvdata's visibilities.

    Attributes
    ----------
    gains : complex, (Nants, Nfreqs, Ntimes, Nfeeds); NaN where there is no solution
    antennas : names, (Nants,); None: all antennas of the telescope, in the order of their numbers
    frequencies : Hz, (Nfreqs,); None: the channels of the data; a single one holds for all channels of the data
    times
        Julian dates of the start and the end of each solution, (Ntimes, 2); None if they are not known. A single
        solution holds at all times.
    feeds : AIPS numbers, (Nfeeds,); None: one gain for all feeds
    widened
        Integrations by which `times` are extended on either side, so that the centres of all integrations of a solution
        are within, and of no other.
    """

    gains: np.ndarray
    antennas: list[str] | None = None
    frequencies: np.ndarray | None = None
    times: np.ndarray | None = None
    feeds: np.ndarray | None = None
    widened: float = 0.0

    @classmethod
    def of(cls, cal: UVCal) -> GainTable:
        """Return gains by channel as a table of all antennas of the telescope, by ascending number."""
        order = np.argsort(cal.telescope.antenna_numbers)
        numbers = cal.telescope.antenna_numbers[order]
        known = ~cal.flag_array & np.isfinite(cal.gain_array) & (cal.gain_array != 0)
        values = np.where(known, cal.gain_array, 1)
        values = np.where(known, 1 / values if cal.gain_convention == "multiply" else values, np.nan)
        gains = np.full((len(numbers), *values.shape[1:]), np.nan, complex)
        gains[np.searchsorted(numbers, cal.ant_array)] = values
        single = cal.time_range is None
        return cls(
            gains,
            [str(cal.telescope.antenna_names[row]) for row in order],
            np.array(cal.freq_array),
            np.stack([cal.time_array] * 2, axis=1) if single else cal.time_range,
            np.array(cal.jones_array),
            widened=0.25 if single else 0.0,
        )

    def require_channels(self, count: int) -> None:
        """Raise InputError if the file has gains in order of the channels, and not as many as the data."""
        if self.frequencies is None and self.gains.shape[1] not in (1, count):
            raise InputError(
                f"has {self.gains.shape[1]} channels without frequencies, and the data have {count}; calibrate the "
                "same channels"
            )

    def uvcal(self, template: UVData | UVCal) -> UVCal:
        """Return the gains as UVCal, with telescope, channels and times of data, or of gains for them, where needed.

        Raises InputError if antennas, channels or solutions in time cannot be told.
        """
        from pyuvdata import UVCal

        self.require_channels(template.Nfreqs)
        feeds = self.feeds
        if feeds is None:
            given = template.jones_array if hasattr(template, "jones_array") else template.polarization_array
            feeds = np.array([feed for feed in given if feed in PARALLEL_HANDS.values()])
        own = self.frequencies is not None and self.gains.shape[1] > 1
        n_antennas, n_channels, n_times, _ = self.gains.shape
        shape = (n_antennas, n_channels if own else template.Nfreqs, n_times, len(feeds))
        ranges, known = self._ranges(template), np.isfinite(self.gains)
        return UVCal.new(
            telescope=template.telescope,
            ant_array=self._numbers(template.telescope),
            freq_array=self.frequencies if own else template.freq_array,
            channel_width=float(np.min(template.channel_width)) if own else template.channel_width,
            jones_array=feeds,
            time_range=ranges,
            integration_time=np.ptp(ranges, axis=1) * SECONDS_PER_DAY,
            gain_convention="divide",
            cal_style="redundant",
            cal_type="gain",
            update_telescope_from_known=False,
            data={
                "gain_array": np.broadcast_to(np.where(known, self.gains, 1), shape).copy(),
                "flag_array": np.broadcast_to(~known, shape).copy(),
            },
            history="calstudy",
        )

    def _numbers(self, telescope: Telescope) -> np.ndarray:
        """Return the number of each antenna; raises InputError if they cannot be told."""
        if self.antennas is None:
            numbers = np.sort(telescope.antenna_numbers)
            if len(numbers) != len(self.gains):
                raise InputError(
                    f"has gains of {len(self.gains)} antennas without names, and the telescope of the data has "
                    f"{len(numbers)}; both must have the same antennas"
                )
            return numbers
        known = dict(zip(telescope.antenna_names, telescope.antenna_numbers.tolist(), strict=True))
        unknown = [name for name in self.antennas if name not in known]
        if unknown:
            raise InputError(
                f"the data have no antenna {unknown[0]!r}; their names are {', '.join(list(known)[:3])}, ...; "
                "antennas must have the same names"
            )
        return np.array([known[name] for name in self.antennas])

    def _ranges(self, template: UVData | UVCal) -> np.ndarray:
        """Return the start and end of each solution, Julian dates, (Ntimes, 2); of one solution those of the data."""
        centres = np.unique(template.time_array if template.time_array is not None else template.time_range)
        integration = float(np.min(template.integration_time)) / SECONDS_PER_DAY
        count = self.gains.shape[2]
        if count == 1:
            ranges, widened = centres[None, [0, -1]], 0.25
        elif self.times is not None:
            ranges, widened = self.times, self.widened
        else:
            # Equal parts of the data would be a guess: long runs are calibrated in pieces.
            raise InputError(
                f"has {count} solutions in time and not their times; calibrate all integrations together, or use a "
                "format with times"
            )
        margin = np.maximum(widened * integration, -0.49 * np.ptp(ranges, axis=1, keepdims=True))
        return ranges + margin * np.array([-1, 1])
