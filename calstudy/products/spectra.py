"""From visibilities to power spectra: coherent averages, delay spectra even x odd, wedge and spherical averages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from calstudy.base.errors import InputError
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.experiment.model import Component, Variant
from calstudy.products import calibration, corruption
from calstudy.products.corruption import PARITIES
from calstudy.products.files import AVERAGE, DATA, RESIDUAL, read_visibilities, spectrum_file, write_visibilities
from calstudy.products.graph import Graph, once, size_of
from calstudy.run.task import Job, Stage, Task

if TYPE_CHECKING:
    from pathlib import Path

    from pyuvdata import UVData

    from calstudy.power.average import Block
    from calstudy.power.spectra import DelaySpectra

# Further inputs of the spectra; names of variants cannot contain a colon.
EOR_REFERENCE, NOISE_REFERENCE = "reference:eor", "reference:noise"
EXCISION = {"all-modes": False, "outside-wedge": True}
"""Spherical averages; true for the one without the wedge."""
NOT_OF_DELAY_SPECTRA = ("coherent_time", "bins", "wedge_buffer", "length_bin")
"""Fields of the power section that act before or after the estimate of delay spectra."""
DELAY_SPECTRA = "delay-spectra.h5"


@once
def average(graph: Graph, variant: Variant, parity: str) -> Task:
    """Return the task of one realization ("even" or "odd") of a variant, fringe-stopped and averaged over the run."""
    make = calibration.calibration if variant.calibrate else corruption.data
    source = make(graph, variant, parity)
    label = f"R of {source.label}" if variant.calibrate else source.label
    file = RESIDUAL if variant.calibrate else DATA
    times = graph.experiment.instrument.times
    count = graph.experiment.power.n_blocks(times.integration * times.count, times.integration)
    settings = {"file": file} if count == 1 else {"file": file, "blocks": count}
    return Task(AVERAGE_STAGE, label, settings, {"data": source})


def power(graph: Graph, name: str) -> Task:
    """Return the task of the delay power spectra of a variant, even x odd."""
    return variant_power(graph, name, graph.experiment.variants[name])


@once
def variant_power(graph: Graph, label: str, variant: Variant) -> Task:
    """Return the task of the delay power spectra of a variant, which need not be one of the experiment's."""
    return crossed(graph, label, {parity: average(graph, variant, parity) for parity in PARITIES})


def crossed(graph: Graph, label: str, averages: Mapping[str, Task]) -> Task:
    """Return the task of the delay power spectra of two averaged data sets, "even" x "odd"."""
    instrument = graph.experiment.instrument
    settings = {
        "beam": instrument.beam,
        "channels": instrument.channels,
        "power": graph.experiment.power.with_defaults(*NOT_OF_DELAY_SPECTRA),
    }
    return Task(POWER, label, settings, averages)


@once
def spectra(graph: Graph) -> Task:
    """Return the task of the wedge and spherical spectra of all variants, with errors."""
    variants = graph.experiment.variants
    inputs = {name: power(graph, name) for name in variants}
    inputs[EOR_REFERENCE] = _reference(graph, "eor")
    if any("noise" in variant.components for variant in variants.values()):
        inputs[NOISE_REFERENCE] = _reference(graph, "noise")
    return Task(SPECTRA, "wedge and spherical", {"power": graph.experiment.power, "variants": variants}, inputs)


def _reference(graph: Graph, component: Component) -> Task:
    """Return the spectra of one component alone, from which the errors of all variants that contain it come."""
    return variant_power(graph, component, Variant(components=(component,)))


def make_average(job: Job) -> Mapping[str, Any]:
    """Write the fringe-stopped average of a data set, or of each of its blocks, to average.uvh5."""
    from calstudy.power.average import average_in_blocks

    data = read_visibilities(job.inputs["data"] / job.settings["file"])
    write_visibilities(average_in_blocks(data, blocks_of(job, data)), job.output / AVERAGE)
    return {}


def blocks_of(job: Job, data: UVData) -> list[Block]:
    """Return the blocks in which the settings of a task divide a data set.

    They are the `kept` ones of `blocks` blocks within `span`, or one block with the phase centre `centre`.
    """
    import numpy as np

    from calstudy.power.average import Block, divide

    times, settings = np.unique(data.time_array), job.settings
    if "blocks" not in settings:
        return [Block(np.arange(times.size), settings.get("centre"))]
    found = divide(times, float(data.integration_time[0]), settings["blocks"], settings.get("span"))
    return [block for block in found if block.number in settings.get("kept", range(settings["blocks"]))]


def estimate(job: Job) -> Mapping[str, Any]:
    """Write the delay spectra even x odd to delay-spectra.h5, and the files of the estimator itself.

    Spectra are NaN if all data are flagged because no solve gave gains.
    """
    import numpy as np

    from calstudy.instrument.beams import make_beam
    from calstudy.power.interface import estimate_spectra
    from calstudy.power.tables import save_spectrum

    even, odd = averages = [read_visibilities(job.inputs[parity] / AVERAGE) for parity in PARITIES]
    beam = make_beam(job.settings["beam"], job.settings["channels"])
    empty = any(uvd.flag_array.all() for uvd in averages)
    if empty:
        for uvd in averages:
            uvd.flag_array[:] = False
    found = estimate_spectra(even, odd, beam, job.settings["power"], job.output)
    if empty:
        found = replace(found, power=np.full_like(found.power, np.nan))
    save_spectrum(job.output / DELAY_SPECTRA, found)
    return {"units": len(found.n_pairs), "pairs": int(found.n_pairs.sum())}


def read_delay_spectra(folder: Path) -> DelaySpectra:
    """Read a product of the stage `power`."""
    from calstudy.power.spectra import DelaySpectra
    from calstudy.power.tables import load_spectrum

    return load_spectrum(folder / DELAY_SPECTRA, DelaySpectra)


def average_spectra(job: Job) -> Mapping[str, Any]:
    """Write, for every variant, wedge.h5 and the two spherical spectra with their errors, as HDF5 and CSV.

    The noise part of the errors comes from spectra of the noise alone, the sample variance from those of the EoR alone
    (paper section Reduction of Simulation Products); each enters the variants that contain its component.
    """
    import numpy as np

    from calstudy.power.binned import cylindrical_average, spherical_average
    from calstudy.power.errors import noise_level, with_errors
    from calstudy.power.tables import save_spectrum, write_csv

    settings = job.settings["power"]
    delays = {name: read_delay_spectra(folder) for name, folder in job.inputs.items()}
    sigma_noise = noise_level(delays[NOISE_REFERENCE]) if NOISE_REFERENCE in delays else 0.0
    signals = {name: spherical_average(delays[EOR_REFERENCE], settings, excise) for name, excise in EXCISION.items()}
    for name, variant in job.settings["variants"].items():
        if not np.isfinite(delays[name].power).any():
            raise InputError(f"variants.{name}: all data are flagged, because no solve of the calibration gave gains")
        save_spectrum(job.output / spectrum_file(name, "wedge"), cylindrical_average(delays[name], settings))
        for modes, excise in EXCISION.items():
            spectrum = with_errors(
                spherical_average(delays[name], settings, excise),
                noise=sigma_noise if "noise" in variant.components else 0.0,
                signal=signals[modes] if "eor" in variant.components else None,
            )
            save_spectrum(job.output / spectrum_file(name, modes), spectrum)
            write_csv(job.output / f"{name}.{modes}.csv", spectrum)
    return {"sigma_noise_mk2_h3_mpc3": sigma_noise}


def blocks_in(averages: Iterable[Task]) -> int:
    """Return the largest number of blocks of any of the averages."""
    return max(task.settings.get("blocks", 1) for task in averages)


def _cost_of_average(task: Task) -> Cost:
    size, blocks = size_of(task), task.settings.get("blocks", 1)
    disk = blocks * size.samples / size.times * COMPLEX128
    return Cost(0.5 + 0.15 * (blocks - 1) + size.samples * 8e-8, LIBRARIES_MEMORY + 6 * size.samples * COMPLEX128, disk)


def _cost_of_power(task: Task) -> Cost:
    # Differences and noise are made from averages.
    behind = [average for source in task.inputs.values() for average in source.inputs.values()]
    size, blocks = size_of(task), blocks_in([*task.inputs.values(), *behind])
    # Each block has a file of the estimator; spectra and each unit's shares of its antennas are of all blocks.
    spectra = size.baselines * size.channels.count
    seconds = 2 + 1e-5 * spectra + (blocks - 1) * (0.9 + 0.005 * size.baselines)
    return Cost(seconds, 1.6e9, (3 + blocks) * spectra * COMPLEX128)


AVERAGE_STAGE = Stage(name="average", version=2, make=make_average, cost=_cost_of_average)
POWER = Stage(name="power", version=4, make=estimate, cost=_cost_of_power)
SPECTRA = Stage(name="spectra", version=3, make=average_spectra, cost=lambda task: Cost(2, disk=5e6))
