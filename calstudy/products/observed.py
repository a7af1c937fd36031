"""Measured data: the parts that are read, their calibration, and averages and delay power spectra of the halves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.feeds import x_in_file
from calstudy.base.gains import gain_products
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.visibilities import antenna_pairs, crosses_of, flag_cube, from_cube, rows_of, to_cube
from calstudy.calibrate.interface import Calibrator
from calstudy.calibrate.settings import GainFit
from calstudy.calibrate.sky_model import common_baselines
from calstudy.corrupt.noise import effective_area
from calstudy.products.calibration import calibration_of
from calstudy.products.corruption import LEVELS, read_noise
from calstudy.products.files import (
    AVERAGE,
    DATA,
    GAINS,
    MODEL,
    RESIDUAL,
    VISIBILITIES,
    read_visibilities,
    write_json,
    write_visibilities,
)
from calstudy.products.graph import MeasuredGraph, memoize, size_of
from calstudy.products.spectra import InBlocks, blocks_in, cross_power
from calstudy.realdata.halves import (
    PARITIES,
    WHOLE,
    east_and_north,
    flag_channels,
    half_of_sums,
    interleaved,
    share_convention,
)
from calstudy.realdata.interference import flag_interference
from calstudy.realdata.selection import Selection
from calstudy.realdata.settings import Factor, FromAutocorrelations, ObservedSettings, Select
from calstudy.run.task import Input, Task

if TYPE_CHECKING:
    from pyuvdata import UVData


NOISE = "noise.uvh5"
"""Sigma of an average's noise from the autocorrelations."""
WHAT = ("data", "calibrated", "residual")
"""Data whose power spectra are estimated: as given, calibrated V / (g g*), and residual V / (g g*) - F."""
SOURCES = ("difference", "autos")
"""Sources of the noise level: the difference of the halves, the autocorrelations."""


@memoize
def observed(graph: MeasuredGraph, part: str) -> Observe:
    """Return the task of one part of the data, and of the sky model at the same samples.

    A half is in Jy, with the names of feeds that power spectra need; the whole has its own unit and names.
    """
    section, parts, calibrator = graph.experiment.observed, graph.parts, graph.experiment.calibration
    halves = isinstance(section, ObservedSettings)
    flux_scale, differences = (section.flux_scale, section.difference) if halves else (None, ())
    size = parts.facts[part].size(len(parts.times(part)))
    autos = isinstance(calibrator, GainFit) and calibrator.autos
    return Observe(
        f"data {part}",
        files=list((section.odd if halves and part == "odd" else ()) or section.data),
        difference=list(differences) or None,
        select=section.select,
        size={name: getattr(size, name) for name in size.__dataclass_fields__},
        parity=part if parts.interleaved or differences else None,
        as_given=part == WHOLE,
        flag=list(section.flag) or None,
        interference=section.flag_interference,
        positions=section.positions,
        pol_convention=section.pol_convention if halves else None,
        sky_model=section.sky_model,
        autos=None if section.sky_model is None else autos,
        flux_scale=flux_scale,
        beam=section.beam if isinstance(flux_scale, FromAutocorrelations) else None,
    )


@memoize
def calibrated(graph: MeasuredGraph, part: str) -> Task:
    """Return the task of the calibration of one part."""
    return calibration_with(graph, observed(graph, part), part)


def calibration_with(graph: MeasuredGraph, data: Task, part: str) -> Task:
    """Return the task of a calibration of data of one part, with the sky model and the noise of this part."""
    source, section, calibrator = observed(graph, part), graph.experiment.observed, graph.experiment.calibration
    sky, levels = (source if needed else None for needed in (section.sky_model is not None, calibrator.needs_noise))
    return calibration_of(graph, {"data": data, "sky_model": sky, "levels": levels}, measured=True)


@memoize
def average(graph: MeasuredGraph, what: str, parity: str, injected: Task | None = None) -> Task:
    """Return the task of the fringe-stopped average of one half; `what` is one of `WHAT`.

    If there are `injected` data, the average is of those, calibrated again.
    """
    data = injected or observed(graph, parity)
    return ObservedAverage(
        f"{what}{' + eor' if injected else ''} {parity}",
        what=what,
        data=data,
        calibration=calibration_with(graph, data, parity) if injected else calibrated(graph, parity),
        **graph.parts.averaging(graph.experiment.power, parity),
    )


@memoize
def power_of(graph: MeasuredGraph, what: str) -> Task:
    """Return the task of the delay power spectra even x odd; `what` is one of `WHAT`."""
    return cross_power(graph, what, [average(graph, what, parity) for parity in PARITIES])


@memoize
def noise_power(graph: MeasuredGraph, what: str, source: str) -> Task:
    """Return the task of the noise power of each baseline from one of `SOURCES`, for "data" or "residual"."""
    even, odd = (average(graph, what, parity) for parity in PARITIES)
    noise = ObservedNoise(f"noise of {what} from {source}", source=source, even=even, odd=odd)
    own = graph.experiment.power.model_copy(update={"pairs": "same-baseline"}).with_defaults("redundancy_tolerance")
    return cross_power(graph, noise.label, [noise, noise], own)


class Observe(Task, stage="observe", version=8):
    """The data of one part, and the sky model at the same samples."""

    files: Sequence[Path]
    select: Select
    size: Mapping[str, Any]
    parity: str | None
    difference: Sequence[Path] | None = None
    as_given: bool = False
    flag: Sequence[str] | None = None
    interference: Any = None
    positions: Path | None = None
    pol_convention: str | None = None
    sky_model: Path | None = None
    autos: bool | None = None
    flux_scale: Factor | FromAutocorrelations | None = None
    beam: Any = None

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the data to data.uvh5, and the sky model to visibilities.uvh5."""
        from calstudy.realdata.noise import sample_noise

        data, sky, notes = self.read()
        factor = self._factor(data)
        data.data_array = data.data_array.astype(complex) * factor
        for name, uvd in ((DATA, data), (VISIBILITIES, sky)):
            if uvd is not None:
                if not self.as_given:
                    uvd.vis_units, uvd.pol_convention = "Jy", "sum"
                write_visibilities(uvd, output / name)
        noise = sample_noise(data)
        if noise is not None:
            write_json(output / LEVELS, {"noise_std": noise})
        flagged = float(data.flag_array.mean())
        return {
            "integrations": int(data.Ntimes),
            "jansky_per_unit": factor,
            "flagged_fraction": flagged,
            "changes": notes,
        }

    def read(self) -> tuple[UVData, UVData | None, list[str]]:
        """Return one part of the data, in their own unit, the sky model or None, and sentences on the changes of both.

        Raises InputError if the data or the model cannot be used.
        """
        from calstudy.realdata.reading import place_antennas, read_visibilities

        selection, sky, placed = self.select.selection, None, []
        data = read_visibilities(self.files)
        if self.difference is not None:
            half_of_sums(data, read_visibilities(self.difference), str(self.parity))
        if self.positions is not None:
            placed = [place_antennas(data, self.positions)]
        data, changed = self._prepared(data, selection, self.flag or ())
        notes = placed + changed
        if self.difference is not None:
            data.integration_time = data.integration_time / 2
        if self.interference is not None:
            notes.append(flag_interference(data, self.interference))
        if self.sky_model is not None:
            x = x_in_file(data) or "east"
            # Its polarizations are those of the data by direction, whatever the file calls them.
            sky, sky_notes = self._prepared(read_visibilities([self.sky_model]), Selection(), x=x)
            if str(sky.vis_units).lower() not in ("jy", "uncalib"):
                raise InputError(f"sky model: is in {sky.vis_units!r}, and must be in Jy; convert it first")
            sky, data, left_out = common_baselines(sky, data, bool(self.autos))
            notes += [f"Sky model: {note}" for note in sky_notes] + left_out
        if self.parity is not None and self.difference is None:
            data, sky = (uvd and interleaved(uvd, self.parity) for uvd in (data, sky))
        return data, sky, notes

    def _prepared(
        self, data: UVData, selection: Selection, flag: Sequence[str] = (), x: str = "east"
    ) -> tuple[UVData, list[str]]:
        """Return visibilities as calibration needs them, and sentences on what was changed.

        `x` is the direction of feeds x in files that do not tell it.
        """
        from calstudy.realdata.reading import prepare

        try:
            data, notes = prepare(data, selection, x)
        except InputError as error:
            raise InputError(str(error).replace("--select ", "observed.select.")) from None
        if not self.as_given:
            notes += east_and_north(data) + share_convention(data, self.pol_convention)
        for text in flag:
            flag_channels(data, text)
        return data, notes

    def _factor(self, data: UVData) -> float:
        """Return the value of one unit of the data in Jy."""
        from calstudy.instrument.beams import make_beam

        scale = self.flux_scale
        if scale is None:
            return 1.0
        if isinstance(scale, Factor):
            return scale.unit
        autos = np.equal(*antenna_pairs(data).T)
        power = to_cube(data).real
        measured = np.where(flag_cube(data) | (power <= 0), np.nan, power)[:, autos]
        frequencies = np.asarray(data.freq_array, float)
        beam = make_beam(self.beam, self.size["channels"])
        ratios = []
        for index, number in enumerate(data.polarization_array):
            omega_p, _ = beam.solid_angles(frequencies, {-5: "xx", -6: "yy"}[int(number)])
            expected = scale.autocorrelations(frequencies, effective_area(frequencies, omega_p))
            ratios.append(expected / measured[..., index])
        found = np.nanmedian(ratios) if np.isfinite(ratios).any() else np.nan
        if not 0 < found < np.inf:
            raise InputError("observed.flux_scale: the data have no autocorrelations that are unflagged and positive")
        return float(found)

    def _cost(self) -> Cost:
        size = size_of(self)
        disk = size.samples * COMPLEX128
        each = 1e-6 if self.interference is None else 1.1e-5
        return Cost(5 + each * size.samples, LIBRARIES_MEMORY + 12 * disk, disk)


def read_observed(folder: Path, calibrator: Calibrator, sky_model: bool) -> tuple[UVData, UVData | None, float | None]:
    """Read the data of a product of stage `observe`, with the sky model and the noise level that a calibrator needs."""
    sky = read_visibilities(folder / VISIBILITIES) if sky_model else None
    return read_visibilities(folder / DATA), sky, read_noise(folder) if calibrator.needs_noise else None


class ObservedAverage(InBlocks, stage="observed-average", version=3):
    """The average of one half; all averages have the samples, flags and baselines of the residual."""

    what: str
    data: Input
    calibration: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the average to average.uvh5, and sigma of its noise to noise.uvh5 if there are autocorrelations."""
        from pyuvdata import UVCal

        from calstudy.power.average import average_in_blocks
        from calstudy.realdata.noise import noise_of_average

        what, folder = self.what, self.calibration
        residual, data = read_visibilities(folder / RESIDUAL), read_visibilities(self.data / DATA)
        pairs = antenna_pairs(residual)
        crosses = pairs[:, 0] != pairs[:, 1]
        pairs, residual = pairs[crosses], crosses_of(residual)
        if what == "residual":
            cube = to_cube(residual)
        elif what == "data":
            cube = to_cube(data)[:, rows_of(data, pairs)]
        else:
            cube = to_cube(residual) + to_cube(read_visibilities(folder / MODEL))[:, crosses]
        found = from_cube(residual, np.where(flag_cube(residual), 0, cube))
        blocks = self.blocks_of(found)
        averaged = average_in_blocks(found, blocks)
        write_visibilities(averaged, output / AVERAGE)
        variance = _variances(data, pairs)
        if variance is None:
            return {}
        if what != "data":
            products, unsolved = gain_products(UVCal.from_file(folder / GAINS), pairs)
            variance = variance / np.where(unsolved, np.nan, np.abs(products) ** 2)
        sigma = np.concatenate([noise_of_average(variance, found, block.times) for block in blocks])
        noise = averaged.copy()
        noise.data_array = np.nan_to_num(sigma).astype(complex)
        noise.flag_array = averaged.flag_array | ~np.isfinite(sigma)
        write_visibilities(noise, output / NOISE)
        return {}

    def _cost(self) -> Cost:
        size = size_of(self)
        disk = 2 * self.blocks * size.samples / size.times * COMPLEX128
        return Cost(2 + size.samples * 5e-7, LIBRARIES_MEMORY + 10 * size.samples * COMPLEX128, disk)


def _variances(data: UVData, pairs: np.ndarray) -> np.ndarray | None:
    """Return sigma^2 of all samples from the autocorrelations, (Ntimes, Nbls, Nfreqs, Npols), or None without them."""
    from calstudy.realdata.noise import radiometer_variance

    found = [radiometer_variance(data, pairs, polarization) for polarization in range(data.Npols)]
    known = [variance for variance in found if variance is not None]
    return np.stack(known, axis=-1) if len(known) == len(found) else None


class ObservedNoise(Task, stage="observed-noise", version=1):
    """Visibilities whose power is that of the noise of even x odd."""

    source: str
    even: Input
    odd: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the visibilities to average.uvh5."""
        from calstudy.realdata.noise import half_difference

        if self.source == "difference":
            noise = half_difference(*(read_visibilities(folder / AVERAGE) for folder in (self.even, self.odd)))
        else:
            even, odd = (read_visibilities(folder / NOISE) for folder in (self.even, self.odd))
            noise = even.copy()
            noise.data_array = np.sqrt(even.data_array * odd.data_array)
            noise.flag_array = even.flag_array | odd.flag_array
        write_visibilities(noise, output / AVERAGE)
        return {}

    def _cost(self) -> Cost:
        size = size_of(self)
        disk = blocks_in(self.inputs.values()) * size.samples / size.times * COMPLEX128
        return Cost(2, LIBRARIES_MEMORY, disk)
