"""The parts of measured data that are calibrated by themselves: two halves, or all of them together.

The halves, even and odd, see the same sky with independent noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.constants import SECONDS_PER_DAY, SIDEREAL_DAY, UNEVEN
from calstudy.base.errors import InputError
from calstudy.base.feeds import X_IN_FILE, direction_of_x, rename_feeds
from calstudy.base.observation import Frame
from calstudy.base.visibilities import polarization_names
from calstudy.calibrate.records import PARALLEL_HANDS
from calstudy.instrument.settings import Channels, Size
from calstudy.realdata.selection import SAME_FREQUENCY, Selection, between, parse_values, select

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.power.settings import PowerSettings

PARITIES = ("even", "odd")
WHOLE = "whole"
"""The part that is all of the data."""
LEAST_CHANNELS = 8


@dataclass(frozen=True)
class Facts:
    """Properties of measured data from their metadata.

    `frame` has antennas, baselines (autocorrelations among them) and channels, ascending. `times` (Julian dates) and
    `sidereal_times` (rad) are (Ntimes,); `integration` is the duration of the shortest one, s. `autos` is true if there
    are autocorrelations of all antennas. `copied` is true if averaging in time differs between baselines, so that long
    samples are copied to the times of short ones. `pol_convention` is that of pyuvdata, None if the files do not tell
    it. `polarizations` are those of parallel hands, as pyuvdata numbers them; where power spectra are made x is the
    eastern feed, whatever the file calls it.
    """

    unit: str
    frame: Frame
    times: np.ndarray
    sidereal_times: np.ndarray
    integration: float
    autos: bool
    polarizations: tuple[int, ...]
    copied: bool = False
    pol_convention: str | None = None

    @property
    def duration(self) -> float:
        """Time from the beginning of the first integration to the end of the last, s."""
        return float(np.ptp(self.times)) * SECONDS_PER_DAY + self.integration

    @property
    def antennas(self) -> int:
        """Number of antennas that are in a cross-correlation."""
        return np.unique(self.frame.antennas[~self.frame.autos]).size

    @property
    def frequencies(self) -> np.ndarray:
        """Channel centres, ascending, Hz, (Nfreqs,)."""
        return self.frame.frequencies

    @property
    def channels(self) -> Channels:
        """The channels, as if they were equally spaced."""
        width = float(np.ptp(self.frequencies)) / max(self.frequencies.size - 1, 1)
        first = float(self.frequencies[0])
        return Channels.model_construct(first=first, width=float(f"{width:.12g}"), count=self.frequencies.size)

    def size(self, n_times: int) -> Size:
        """Return the size of `n_times` of the integrations."""
        return replace(Size.of_frame(self.frame), antennas=self.antennas, times=n_times, channels=self.channels)


@dataclass(frozen=True)
class Parts:
    """Metadata of the two halves, by parity, or of `WHOLE` alone, before they are read."""

    facts: Mapping[str, Facts]

    @property
    def interleaved(self) -> bool:
        """True if there are two halves, in the same files."""
        return WHOLE not in self.facts and self.facts["even"] is self.facts["odd"]

    @property
    def autos(self) -> bool:
        """True if there are autocorrelations of all antennas."""
        return all(facts.autos for facts in self.facts.values())

    def times(self, part: str) -> np.ndarray:
        """Return the Julian dates of the integrations of a part."""
        times = self.facts[part].times
        return times[PARITIES.index(part) :: 2] if self.interleaved else times

    def averaging(self, power: PowerSettings, part: str) -> dict[str, Any]:
        """Return the averaging of a half: the phase centre, or the number of blocks, their span and the kept ones.

        Both halves have the centre and the span of the even one; those of another night are at its sidereal times, so
        that both are phased to the same point of the sky. Blocks that one half lacks, because of gaps, are left out of
        both. The keys are ``centre``, a Julian date; or ``blocks``, ``span`` (two Julian dates) and, if some blocks are
        left out, the numbers of those that are ``kept``. Raise InputError if `coherent_time` gives blocks that the
        halves cannot have in common.
        """
        # Reading metadata does not need the averaging of data, which takes long to import.
        from calstudy.power.average import divide

        even = self.facts["even"]
        count = power.n_blocks(even.duration, even.integration)
        spans = {name: [date + _later(even, facts) for date in _ends(even)] for name, facts in self.facts.items()}
        if count == 1:
            return {"centre": sum(spans[part]) / 2}
        if self.interleaved and (power.coherent_time or 0) < 2 * even.integration:
            raise InputError(
                f"power.coherent_time = {power.coherent_time:g} s: a block must hold two integrations, "
                f"{2 * even.integration:g} s, of which each half has one"
            )
        found = [
            {block.number for block in divide(self.times(parity), self.facts[parity].integration, count, spans[parity])}
            for parity in PARITIES
        ]
        common = sorted(found[0] & found[1])
        if not common:
            raise InputError("power.coherent_time: gaps leave no block that both halves have; a longer time may help")
        kept = {} if found[0] == found[1] else {"kept": common}
        return {"blocks": count, "span": spans[part], **kept}


def _ends(facts: Facts) -> tuple[float, float]:
    return float(facts.times.min()), float(facts.times.max())


def _later(even: Facts, other: Facts) -> float:
    """Return the time in days from a sidereal time of the even half to the same one in another half."""
    angle = even.sidereal_times[0] - other.sidereal_times[0]
    apart = np.angle(np.exp(1j * angle)) / (2 * np.pi) * SIDEREAL_DAY
    return float(other.times[0] + apart - even.times[0])


def read_facts(
    paths: tuple[Path, ...], selection: Selection, positions: Path | None = None, even: bool = True
) -> Facts:
    """Read the metadata of the selected part of files or folders that belong together.

    `positions` is a file of antenna positions that replace those in the data. `even` requires equally spaced channels,
    and enough of them for power spectra. Raise InputError if the files cannot be read, or the selection has no
    baselines, or `even` is not satisfied.
    """
    # Plans of simulations need other parts of this module, and pyuvdata takes long to import.
    from calstudy.realdata.reading import place_antennas, read_metadata, share_orientation, share_times

    data = read_metadata(paths)
    if positions is not None:
        place_antennas(data, positions)
    data = select(data, replace(selection, times=None))
    share_orientation(data)
    copied = share_times(data, [])
    # Baselines without samples at the selected times are filled with flagged ones.
    pairs = np.unique(np.column_stack([data.ant_1_array, data.ant_2_array]), axis=0)
    crosses, autos = pairs[pairs[:, 0] != pairs[:, 1]], pairs[pairs[:, 0] == pairs[:, 1], 0]
    if not len(crosses):
        raise InputError("observed.data: there are no cross-correlations, only autocorrelations")
    frequencies = np.sort(np.ravel(data.freq_array))
    if even:
        _require_even(frequencies)
    data = select(data, Selection(times=selection.times))
    times, rows = np.unique(data.time_array, return_index=True)
    places = dict(zip(data.telescope.antenna_numbers.tolist(), data.telescope.get_enu_antpos(), strict=True))
    numbers = np.unique(pairs)
    data.polarization_array = np.array([number for number in data.polarization_array if number in PARALLEL_HANDS])
    if even and data.telescope.feed_array is not None:
        # What has no such feeds is refused once it is prepared.
        with suppress(InputError):
            east_and_north(data)
    parallel = data.polarization_array.tolist()
    return Facts(
        unit=str(data.vis_units),
        frame=Frame(
            numbers,
            np.array([places[number] for number in numbers.tolist()]),
            np.searchsorted(numbers, pairs),
            frequencies,
            times.size,
            len(parallel),
        ),
        times=times,
        sidereal_times=np.asarray(data.lst_array)[rows],
        integration=float(np.min(data.integration_time)),
        autos=set(np.unique(crosses).tolist()) <= set(autos.tolist()),
        polarizations=tuple(parallel),
        copied=copied,
        pol_convention=data.pol_convention,
    )


def modelled(frame: Frame, path: Path) -> Frame:
    """Return the part of a frame that a sky model has: the baselines of its file, and autocorrelations.

    Raise InputError if the file cannot be read, or has none of the cross-correlations.
    """
    from calstudy.realdata.reading import read_metadata

    sky = read_metadata((path,))
    known = {frozenset(pair) for pair in zip(sky.ant_1_array.tolist(), sky.ant_2_array.tolist(), strict=True)}
    chosen = np.array([frozenset(pair) in known for pair in frame.pairs.tolist()])
    if not (chosen & ~frame.autos).any():
        raise InputError(
            f"observed.sky_model: {path} has none of the cross-correlations of the data (antennas are identified by "
            "number)"
        )
    return frame.baselines(chosen | frame.autos)


def _require_even(frequencies: np.ndarray) -> None:
    if frequencies.size < LEAST_CHANNELS:
        raise InputError(
            f"observed.select: {frequencies.size} channels are left; power spectra need at least {LEAST_CHANNELS}"
        )
    steps = np.diff(frequencies)
    if np.ptp(steps) > UNEVEN * steps.mean():
        place = frequencies[int(np.argmax(steps))]
        raise InputError(
            f"observed.data: the channels are {steps.min() / 1e3:.6g} to {steps.max() / 1e3:.6g} kHz apart, the "
            f"largest step being at {place / 1e6:.3f} MHz; power spectra need equal distances: select a part by "
            "observed.select.frequencies, or fill the gap with flagged channels"
        )


def require_same_sky(even: Facts, odd: Facts, sky_model: Path | None = None) -> None:
    """Raise InputError unless two data sets can be crossed: the same channels, sidereal times and samples of the sky.

    Baselines are the cross-correlations that are calibrated: those of the sky model, if there is one.
    """
    if even.frequencies.shape != odd.frequencies.shape or not np.allclose(
        even.frequencies, odd.frequencies, rtol=0, atol=0.01 * even.channels.width
    ):
        raise InputError("observed.odd: its channels are not those of observed.data")
    middles = [np.angle(np.mean(np.exp(1j * facts.sidereal_times))) for facts in (even, odd)]
    apart = abs(np.angle(np.exp(1j * (middles[0] - middles[1])))) / (2 * np.pi) * SECONDS_PER_DAY
    if apart > even.integration:
        raise InputError(
            f"observed.odd: its mean sidereal time is {apart:.4g} s from that of observed.data, and at most one "
            f"integration ({even.integration:.4g} s) is allowed: it must see the same sky"
        )
    if abs(odd.duration - even.duration) > even.integration:
        raise InputError(
            f"observed.odd: lasts {odd.duration:g} s and observed.data {even.duration:g} s; select integrations of the "
            "same duration, which see the same sky"
        )
    if odd.polarizations != even.polarizations:
        names = [polarization_names(facts.polarizations) for facts in (odd, even)]
        raise InputError(
            f"observed.odd: has the polarizations {names[0]} and observed.data {names[1]}; give both the same in the "
            "same order, for example by observed.select.polarizations"
        )
    _require_same_baselines(
        *(facts.frame if sky_model is None else modelled(facts.frame, sky_model) for facts in (even, odd))
    )


def require_same_samples(data: Facts, difference: Facts) -> None:
    """Raise InputError unless differences of a correlator are of the samples of its sums."""
    pairs = [facts.frame.pairs.tolist() for facts in (data, difference)]
    names = ("frequencies", "times", "polarizations")
    if pairs[0] != pairs[1] or any(not np.array_equal(getattr(data, x), getattr(difference, x)) for x in names):
        raise InputError(
            "observed.difference: its baselines, times, channels or polarizations are not those of observed.data; give "
            "the file of differences that was written with these sums"
        )


def _require_same_baselines(even: Frame, odd: Frame) -> None:
    found = [{(a, b) for a, b in frame.pairs[~frame.autos].tolist()} for frame in (even, odd)]
    if found[0] == found[1]:
        return
    either_way = [{(min(pair), max(pair)) for pair in pairs} for pairs in found]
    if lacking := sorted(either_way[0] ^ either_way[1]):
        raise InputError(
            f"observed.odd: {len(lacking)} baselines, such as that of antennas {lacking[0][0]} and {lacking[0][1]}, "
            "are in only one of observed.data and observed.odd; select the antennas that both have by "
            "observed.select.antennas"
        )
    a, b = min(found[1] - found[0])
    raise InputError(
        f"observed.odd: has the baseline ({a}, {b}), and observed.data ({b}, {a}); turn the baselines of one of them, "
        "for example by conjugate_bls of pyuvdata"
    )


def interleaved(data: UVData, parity: str) -> UVData:
    """Return every second integration of rectangular, time-major data, from the first (even) or the second (odd)."""
    times = np.arange(PARITIES.index(parity), data.Ntimes, 2)
    rows = (times[:, None] * data.Nbls + np.arange(data.Nbls)).ravel()
    return data.select(blt_inds=rows, inplace=False, run_check=False)


def half_of_sums(sums: UVData, differences: UVData, parity: str) -> None:
    """Turn sums of a correlator's two samples into one of these, (sum + difference) / 2 or (sum - difference) / 2.

    Raise InputError if both are not of the same samples in the same order. Samples flagged in either are flagged. The
    durations stay those of the sums.
    """
    same = (np.array_equal(getattr(sums, x), getattr(differences, x)) for x in ("baseline_array", "time_array"))
    if sums.data_array.shape != differences.data_array.shape or not all(same):
        raise InputError("observed.difference: is not of the samples of observed.data, in the same order")
    sign = 1 if parity == PARITIES[0] else -1
    sums.data_array = (sums.data_array + sign * differences.data_array) / 2
    sums.flag_array = sums.flag_array | differences.flag_array


def flag_channels(data: UVData, text: str) -> None:
    """Flag the channels in a range such as ``149.7 MHz..150.2 MHz``; raise InputError if it holds no channel."""
    ends = parse_values({"frequencies": text}, "observed.flag: ").frequencies or (None, None)
    frequencies = np.ravel(data.freq_array)
    chosen = between(frequencies, ends, SAME_FREQUENCY)
    if not chosen.any():
        raise InputError(
            f"observed.flag: {text!r} has no channel of the data, which have {frequencies.min() / 1e6:.3f} to "
            f"{frequencies.max() / 1e6:.3f} MHz"
        )
    data.flag_array[:, chosen] = True


def share_convention(data: UVData, convention: str | None) -> list[str]:
    """Bring visibilities to I = XX + YY, the convention "sum" of pyuvdata; return sentences on the changes.

    `convention` is that of files that do not tell it; None: "sum".
    """
    has_unit, told = str(data.vis_units).lower() == "jy", data.pol_convention
    if has_unit:
        data.pol_convention = "sum"
    if (told or convention) == "avg":
        data.data_array = data.data_array / 2
        return ["Visibilities with I = (XX + YY) / 2 were divided by 2."]
    if has_unit and told is None and convention is None:
        return ["The file does not tell whether I is XX + YY or half of that (pol_convention); XX + YY is taken."]
    return []


def east_and_north(data: UVData) -> list[str]:
    """Name the feeds of prepared data so that x is east and y is north; return sentences on the changes.

    Raise InputError if the feeds are not linear, or neither to the east nor to the north.
    """
    linear = bool(np.all(np.isin(data.polarization_array, (-5, -6))))
    x = direction_of_x(data.telescope) if linear else None
    if x is None:
        raise InputError(
            f"observed.data: polarizations {polarization_names(data.polarization_array)} of feeds that are not linear "
            "and to the east and north; power spectra need such, for the beam is that of such feeds"
        )
    if x == "east":
        return []
    rename_feeds(data, "east")
    data.extra_keywords[X_IN_FILE] = x
    return ["The file calls the northern feed x; it is called y here, and the eastern one x."]
