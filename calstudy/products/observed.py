"""Measured data: the parts that are read, their calibration, and averages and delay power spectra of the halves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from calstudy.base.errors import InputError
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.calibrate.interface import Calibrator
from calstudy.calibrate.settings import GainFit
from calstudy.power.settings import PowerSettings
from calstudy.products.calibration import calibration_of
from calstudy.products.corruption import LEVELS
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
from calstudy.products.graph import Memory, once, size_of
from calstudy.products.spectra import NOT_OF_DELAY_SPECTRA, POWER, blocks_in, blocks_of
from calstudy.realdata.halves import PARITIES, WHOLE, Parts
from calstudy.realdata.settings import (
    DataSettings,
    Factor,
    FromAutocorrelations,
    InjectionSettings,
    ObservedSettings,
)
from calstudy.run.task import Job, Stage, Task

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from pyuvdata import UVData

    from calstudy.realdata.selection import Selection

NOISE = "noise.uvh5"
"""Sigma of an average's noise from the autocorrelations."""
WHAT = ("data", "calibrated", "residual")
"""Data whose power spectra are estimated: as given, calibrated V / (g g*), and residual V / (g g*) - F."""
SOURCES = ("difference", "autos")
"""Sources of the noise level: the difference of the halves, the autocorrelations."""


class DataGraph(Memory):
    """The tasks that read and calibrate measured data, from the sections of a file and the parts of the data."""

    def __init__(self, observed: DataSettings, calibration: Calibrator, parts: Parts) -> None:
        super().__init__()
        self.observed, self.calibration, self.parts = observed, calibration, parts


class ObservedGraph(DataGraph):
    """The tasks of one study of measured data, from the sections of its file and the two halves of the data.

    There is no injection if `injection` is None.
    """

    def __init__(
        self,
        observed: ObservedSettings,
        calibration: Calibrator,
        power: PowerSettings,
        injection: InjectionSettings | None,
        parts: Parts,
    ) -> None:
        super().__init__(observed, calibration, parts)
        self.observed: ObservedSettings = observed
        self.power, self.injection = power, injection

    @property
    def beam_settings(self) -> dict[str, Any]:
        """Beam and channels."""
        return {"beam": self.observed.beam, "channels": self.parts.facts["even"].channels}


@once
def observed(graph: DataGraph, part: str) -> Task:
    """Return the task of one part of the data, and of the sky model at the same samples.

    A half is in Jy, with the names of feeds that power spectra need; the whole has its own unit and names.
    """
    section, parts = graph.observed, graph.parts
    odd = section.odd if isinstance(section, ObservedSettings) and part == "odd" else ()
    size = parts.facts[part].size(len(parts.times(part)))
    settings: dict[str, Any] = {
        "files": list(odd or section.data),
        "select": section.select,
        "size": {name: getattr(size, name) for name in size.__dataclass_fields__},
        "parity": part if parts.interleaved else None,
    }
    if part == WHOLE:
        settings["as_given"] = True
    if section.flag:
        settings["flag"] = list(section.flag)
    if section.flag_interference is not None:
        settings["interference"] = section.flag_interference
    if section.positions is not None:
        settings["positions"] = section.positions
    if section.sky_model is not None:
        autos = isinstance(graph.calibration, GainFit) and graph.calibration.autos
        settings |= {"sky_model": section.sky_model, "autos": autos}
    if isinstance(section, ObservedSettings) and section.flux_scale is not None:
        settings["flux_scale"] = section.flux_scale
        if isinstance(section.flux_scale, FromAutocorrelations):
            settings["beam"] = section.beam
    return Task(OBSERVE, f"data {part}", settings)


def calibration_inputs(graph: DataGraph, data: Task, part: str) -> dict[str, Task]:
    """Return the inputs of a calibration of data of one part."""
    inputs, source = {"data": data}, observed(graph, part)
    if graph.observed.sky_model is not None:
        inputs["sky_model"] = source
    if graph.calibration.needs_noise:
        inputs["levels"] = source
    return inputs


@once
def calibrated(graph: DataGraph, part: str) -> Task:
    """Return the task of the calibration of one part."""
    data = observed(graph, part)
    return calibration_of(graph.calibration.with_defaults("assumed"), calibration_inputs(graph, data, part))


@once
def average(graph: ObservedGraph, what: str, parity: str) -> Task:
    """Return the task of the fringe-stopped average of one half; `what` is one of `WHAT`."""
    inputs = {"data": observed(graph, parity), "calibration": calibrated(graph, parity)}
    return Task(OBSERVED_AVERAGE, f"{what} {parity}", {"what": what, **graph.parts.averaging(graph.power)}, inputs)


def crossed(graph: ObservedGraph, label: str, even: Task, odd: Task, power: PowerSettings | None = None) -> Task:
    """Return the task of the delay power spectra of two averages; `power` replaces the study's own settings."""
    settings = {**graph.beam_settings, "power": (power or graph.power).with_defaults(*NOT_OF_DELAY_SPECTRA)}
    return Task(POWER, label, settings, {"even": even, "odd": odd})


@once
def power_of(graph: ObservedGraph, what: str) -> Task:
    """Return the task of the delay power spectra even x odd; `what` is one of `WHAT`."""
    return crossed(graph, what, average(graph, what, "even"), average(graph, what, "odd"))


@once
def noise_power(graph: ObservedGraph, what: str, source: str) -> Task:
    """Return the task of the noise power of each baseline from one of `SOURCES`, for "data" or "residual"."""
    inputs = {parity: average(graph, what, parity) for parity in PARITIES}
    label = f"noise of {what} from {source}"
    noise = Task(NOISE_STAGE, label, {"source": source}, inputs)
    own = graph.power.model_copy(update={"pairs": "same-baseline"}).with_defaults("redundancy_tolerance")
    return crossed(graph, label, noise, noise, own)


def observe(job: Job) -> Mapping[str, Any]:
    """Write the data of one part to data.uvh5, and the sky model to visibilities.uvh5."""
    from calstudy.realdata.noise import sample_noise

    data, sky, notes = read_part(job.settings)
    factor, as_given = _factor(job, data), "as_given" in job.settings
    data.data_array = data.data_array.astype(complex) * factor
    for name, uvd in ((DATA, data), (VISIBILITIES, sky)):
        if uvd is not None:
            uvd.vis_units = uvd.vis_units if as_given else "Jy"
            write_visibilities(uvd, job.output / name)
    noise = sample_noise(data)
    if noise is not None:
        write_json(job.output / LEVELS, {"noise_std": noise})
    flagged = float(data.flag_array.mean())
    return {"integrations": int(data.Ntimes), "jansky_per_unit": factor, "flagged_fraction": flagged, "changes": notes}


def read_part(settings: Mapping[str, Any]) -> tuple[UVData, UVData | None, list[str]]:
    """Return one part of the data, in their own unit, the sky model or None, and sentences on the changes of both.

    The settings are those of the task `observed`; raises InputError if the data or the model cannot be used.
    """
    from calstudy.calibrate.sky_model import common_baselines
    from calstudy.realdata.halves import interleaved
    from calstudy.realdata.interference import flag_interference
    from calstudy.realdata.selection import Selection

    selection = settings["select"].selection
    data, notes = _read(settings, settings["files"], selection)
    if "interference" in settings:
        notes.append(flag_interference(data, settings["interference"]))
    sky = None
    if "sky_model" in settings:
        alone = {name: settings[name] for name in ("as_given",) if name in settings}
        sky, sky_notes = _read(alone, [settings["sky_model"]], Selection(polarizations=selection.polarizations))
        sky, data, left_out = common_baselines(sky, data, settings["autos"])
        notes += [f"Sky model: {note}" for note in sky_notes] + left_out
    if settings["parity"] is not None:
        data, sky = (uvd and interleaved(uvd, settings["parity"]) for uvd in (data, sky))
    return data, sky, notes


def _read(settings: Mapping[str, Any], files: Sequence[Path], selection: Selection) -> tuple[UVData, list[str]]:
    """Return files of visibilities as calibration needs them, and sentences on what was changed."""
    from calstudy.realdata.halves import east_and_north, flag_channels
    from calstudy.realdata.reading import place_antennas, prepare, read_visibilities

    data, placed = read_visibilities(files), []
    if "positions" in settings:
        placed = [place_antennas(data, settings["positions"])]
    try:
        data, notes = prepare(data, selection)
    except InputError as error:
        raise InputError(str(error).replace("--select ", "observed.select.")) from None
    if "as_given" not in settings:
        notes += east_and_north(data)
    for text in settings.get("flag", ()):
        flag_channels(data, text)
    return data, placed + notes


def _factor(job: Job, data: UVData) -> float:
    """Return the value of one unit of the data in Jy."""
    import numpy as np

    from calstudy.base.visibilities import antenna_pairs, flag_cube, to_cube
    from calstudy.corrupt.noise import effective_area
    from calstudy.instrument.beams import make_beam

    scale = job.settings.get("flux_scale")
    if scale is None:
        return 1.0
    if isinstance(scale, Factor):
        return scale.unit
    autos = np.equal(*antenna_pairs(data).T)
    measured = np.where(flag_cube(data), np.nan, to_cube(data).real)[:, autos]
    frequencies = np.asarray(data.freq_array, float)
    beam = make_beam(job.settings["beam"], job.settings["size"]["channels"])
    ratios = []
    for index, number in enumerate(data.polarization_array):
        omega_p, _ = beam.solid_angles(frequencies, {-5: "xx", -6: "yy"}[int(number)])
        expected = scale.autocorrelations(frequencies, effective_area(frequencies, omega_p))
        ratios.append(expected / measured[..., index])
    found = np.nanmedian(ratios) if np.isfinite(ratios).any() else np.nan
    if not found > 0:
        raise InputError("observed.flux_scale: the data have no autocorrelations that are unflagged and positive")
    return float(found)


def make_average(job: Job) -> Mapping[str, Any]:
    """Write the average of one half to average.uvh5, and sigma of its noise to noise.uvh5 if there are autos.

    All averages have the samples, flags and baselines of the residual.
    """
    import numpy as np
    from pyuvdata import UVCal

    from calstudy.base.gains import gain_products
    from calstudy.base.visibilities import antenna_pairs, flag_cube, from_cube, rows_of, to_cube
    from calstudy.power.average import average_in_blocks
    from calstudy.realdata.noise import noise_of_average

    what, folder = job.settings["what"], job.inputs["calibration"]
    residual, data = read_visibilities(folder / RESIDUAL), read_visibilities(job.inputs["data"] / DATA)
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
    blocks = blocks_of(job, found)
    averaged = average_in_blocks(found, blocks)
    write_visibilities(averaged, job.output / AVERAGE)
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
    write_visibilities(noise, job.output / NOISE)
    return {}


def crosses_of(data: UVData) -> UVData:
    """Return the cross-correlations of rectangular, time-major data."""
    import numpy as np

    crosses = np.flatnonzero(data.ant_1_array != data.ant_2_array)
    return data.select(blt_inds=crosses, inplace=False, run_check=False)


def _variances(data: UVData, pairs: np.ndarray) -> np.ndarray | None:
    """Return sigma^2 of all samples from the autocorrelations, (Ntimes, Nbls, Nfreqs, Npols), or None without them."""
    import numpy as np

    from calstudy.realdata.noise import radiometer_variance

    found = [radiometer_variance(data, pairs, polarization) for polarization in range(data.Npols)]
    known = [variance for variance in found if variance is not None]
    return np.stack(known, axis=-1) if len(known) == len(found) else None


def make_noise(job: Job) -> Mapping[str, Any]:
    """Write visibilities whose power is that of the noise of even x odd to average.uvh5."""
    import numpy as np

    from calstudy.realdata.noise import half_difference

    if job.settings["source"] == "difference":
        noise = half_difference(*(read_visibilities(job.inputs[parity] / AVERAGE) for parity in PARITIES))
    else:
        even, odd = (read_visibilities(job.inputs[parity] / NOISE) for parity in PARITIES)
        noise = even.copy()
        noise.data_array = np.sqrt(even.data_array * odd.data_array)
        noise.flag_array = even.flag_array | odd.flag_array
    write_visibilities(noise, job.output / AVERAGE)
    return {}


def _cost_of_reading(task: Task) -> Cost:
    size = size_of(task)
    disk = size.samples * COMPLEX128
    each = 1.1e-5 if "interference" in task.settings else 1e-6
    return Cost(5 + each * size.samples, LIBRARIES_MEMORY + 12 * disk, disk)


def _cost_of_average(task: Task) -> Cost:
    size = size_of(task)
    disk = 2 * task.settings.get("blocks", 1) * size.samples / size.times * COMPLEX128
    return Cost(2 + size.samples * 5e-7, LIBRARIES_MEMORY + 10 * size.samples * COMPLEX128, disk)


def _cost_of_noise(task: Task) -> Cost:
    size = size_of(task)
    disk = blocks_in(task.inputs.values()) * size.samples / size.times * COMPLEX128
    return Cost(2, LIBRARIES_MEMORY, disk)


# Since 2 the noise is that of a sample with nsamples of one.
OBSERVE = Stage(name="observe", version=2, make=observe, cost=_cost_of_reading)
OBSERVED_AVERAGE = Stage(name="observed-average", version=1, make=make_average, cost=_cost_of_average)
NOISE_STAGE = Stage(name="observed-noise", version=1, make=make_noise, cost=_cost_of_noise)
