"""From visibilities to power spectra: coherent averages, delay spectra even x odd, wedge and spherical averages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.experiment.model import Component, Variant
from calstudy.power.binned import cylindrical_average, noise_level, spherical_average, with_errors
from calstudy.power.interface import estimate_spectra, polarizations_without_data
from calstudy.power.spectra import DelaySpectra, SphericalSpectrum, of_common_units
from calstudy.power.tables import load_spectrum, save_spectrum, write_csv
from calstudy.products import calibration, corruption
from calstudy.products.corruption import PARITIES
from calstudy.products.files import (
    AVERAGE,
    DATA,
    RESIDUAL,
    read_json,
    read_visibilities,
    spectrum_file,
    write_json,
    write_visibilities,
)
from calstudy.products.graph import Graph, memoize, size_of
from calstudy.products.table import StudyTable
from calstudy.run.task import Input, Inputs, Task

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.instrument.settings import Beam, Channels
    from calstudy.power.average import Block
    from calstudy.power.settings import PowerSettings

EXCISION = {"all-modes": False, "outside-wedge": True}
"""Spherical averages; true for the one without the wedge."""
NOT_OF_DELAY_SPECTRA = ("coherent_time", "bins", "wedge_buffer", "length_bin")
"""Fields of the power section that act before or after the estimate of delay spectra."""
DELAY_SPECTRA, SAMPLES = "delay-spectra.h5", "samples.json"


@memoize
def average(graph: Graph, variant: Variant, parity: str) -> Task:
    """Return the task of one realization ("even" or "odd") of a variant, fringe-stopped and averaged over the run."""
    make = calibration.calibration if variant.calibrate else corruption.data
    source = make(graph, variant, parity)
    label = f"residual of {source.label}" if variant.calibrate else source.label
    file = RESIDUAL if variant.calibrate else DATA
    times = graph.experiment.instrument.times
    count = graph.experiment.power.n_blocks(times.integration * times.count, times.integration)
    return Average(label, file=file, blocks=count, data=source)


def power(graph: Graph, name: str) -> Task:
    """Return the task of the delay power spectra of a variant, even x odd."""
    return variant_power(graph, name, graph.experiment.variants[name])


@memoize
def variant_power(graph: Graph, label: str, variant: Variant) -> Task:
    """Return the task of the delay power spectra of a variant, which need not be one of the experiment's."""
    return cross_power(graph, label, [average(graph, variant, parity) for parity in PARITIES])


def cross_power(graph: Graph, label: str, averages: Sequence[Task], power: PowerSettings | None = None) -> Task:
    """Return the task of the delay power spectra of two averages; `power` replaces the study's own settings."""
    even, odd = averages
    used = (power or graph.experiment.power).with_defaults(*NOT_OF_DELAY_SPECTRA)
    return Power(label, beam=graph.beam, channels=graph.channels, power=used, even=even, odd=odd)


@memoize
def spectra(graph: Graph) -> Task:
    """Return the task of the wedge and spherical spectra of all variants, with errors."""
    variants, reference = graph.experiment.variants, {"eor": _reference(graph, "eor")}
    if any("noise" in variant.components for variant in variants.values()):
        reference["noise"] = _reference(graph, "noise")
    return Spectra(
        "wedge and spherical",
        power=graph.experiment.power,
        variants=variants,
        spectra={name: power(graph, name) for name in variants},
        reference=reference,
    )


def _reference(graph: Graph, component: Component) -> Task:
    """Return the spectra of one component alone, from which the errors of all variants that contain it come."""
    return variant_power(graph, component, Variant(components=(component,)))


class SpectraTable(StudyTable):
    """The power spectra of all variants."""

    of = "experiment"
    place = 1

    def products(self, graph: Graph) -> Sequence[Task | None]:
        """Return the product."""
        return [spectra(graph)]


class InBlocks(Task):
    """An average in the `kept` ones of `blocks` blocks within `span`, or in one with the phase centre `centre`."""

    blocks: int = 1
    centre: float | None = None
    span: Sequence[float] | None = None
    kept: Sequence[int] | None = None

    def blocks_of(self, data: UVData) -> list[Block]:
        """Return the blocks of a data set."""
        from calstudy.power.average import Block, divide

        times = np.unique(data.time_array)
        if self.blocks == 1:
            return [Block(np.arange(times.size), self.centre)]
        found = divide(times, float(data.integration_time[0]), self.blocks, self.span)
        return [block for block in found if self.kept is None or block.number in self.kept]


class Average(InBlocks, stage="average", version=2):
    """The fringe-stopped average of a data set, or of each of its blocks."""

    file: str
    data: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the average to average.uvh5."""
        from calstudy.power.average import average_in_blocks

        data = read_visibilities(self.data / self.file)
        write_visibilities(average_in_blocks(data, self.blocks_of(data)), output / AVERAGE)
        return {}

    def _cost(self) -> Cost:
        size, blocks = size_of(self), self.blocks
        disk = blocks * size.samples / size.times * COMPLEX128
        seconds = 0.1 + 0.15 * (blocks - 1) + size.samples * 1.2e-7
        return Cost(seconds, LIBRARIES_MEMORY + 6 * size.samples * COMPLEX128, disk)


class Power(Task, stage="power", version=7):
    """The delay power spectra of two averages, and how much noise missing samples add."""

    beam: Beam
    channels: Channels
    power: PowerSettings
    even: Input
    odd: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the delay spectra even x odd, NaN if all data are flagged, and the files of the estimator itself."""
        from calstudy.instrument.beams import make_beam

        even, odd = averages = [read_visibilities(folder / AVERAGE) for folder in (self.even, self.odd)]
        empty = any(uvd.flag_array.all() for uvd in averages)
        write_json(output / SAMPLES, {"noise": _noise_of_missing_samples(averages)})
        if empty:
            for uvd in averages:
                uvd.flag_array[:] = False
        found = estimate_spectra(even, odd, make_beam(self.beam, self.channels), self.power, output)
        if empty:
            found = replace(found, power=np.full_like(found.power, np.nan))
        save_spectrum(output / DELAY_SPECTRA, found)
        without = polarizations_without_data(even, odd)
        warnings = {"warnings": [f"{len(without)} polarization(s) without data are left out"]} if without else {}
        return {"units": len(found.n_pairs), "pairs": int(found.n_pairs.sum()), **warnings}

    def _cost(self) -> Cost:
        # Differences and noise are made from averages.
        behind = [average for source in (self.even, self.odd) for average in source.inputs.values()]
        size, blocks = size_of(self), blocks_in([self.even, self.odd, *behind])
        # Each block has a file of the estimator; spectra and each unit's shares of its antennas are of all blocks.
        spectra = size.baselines * size.channels.count
        seconds = 0.3 + 6e-4 * size.baselines * (1 + (size.baselines / 2000) ** 2)
        seconds += (blocks - 1) * (0.9 + 0.002 * size.baselines)
        return Cost(seconds, 1.6e9, (3 + blocks) * spectra * COMPLEX128)


def _noise_of_missing_samples(averages: Sequence[UVData]) -> float | None:
    """Return the rms noise of even times odd over that of averages of all samples, None if all are flagged."""
    used = ~np.logical_or.reduce([uvd.flag_array for uvd in averages])
    if not used.any():
        return None
    return float(np.sqrt(np.prod([np.mean(1 / uvd.nsample_array[used].astype(float)) for uvd in averages])))


def excess_noise(folder: Path, noise: Path) -> float:
    """Return sigma_N of spectra over that of the spectra of `noise` alone, two products of the stage `power`.

    Integrations without a solution are flagged in calibrated data, and not in the noise.
    """
    found, of_noise = (read_json(product / SAMPLES)["noise"] for product in (folder, noise))
    return (found or of_noise) / of_noise


def read_delay_spectra(folder: Path) -> DelaySpectra:
    """Read a product of the stage `power`."""
    return load_spectrum(folder / DELAY_SPECTRA, DelaySpectra)


def read_common(folders: Mapping[str, Path]) -> dict[str, DelaySpectra]:
    """Read products of the stage `power`, by name, in the units that all have."""
    return of_common_units({name: read_delay_spectra(folder) for name, folder in folders.items()})


def read_recovered(folder: Path) -> list[SphericalSpectrum]:
    """Read P^R and P^S outside the wedge from a product of the stage `spectra`."""
    files = (folder / spectrum_file(name, "outside-wedge") for name in ("residual", "eor"))
    return [load_spectrum(file, SphericalSpectrum) for file in files]


class Spectra(Task, stage="spectra", version=5):
    """Wedge and spherical spectra of all variants, with errors.

    The noise part of the errors comes from spectra of the noise alone, the sample variance from those of the EoR alone
    (paper section Reduction of Simulation Products); each enters the variants that contain its component.
    """

    power: PowerSettings
    variants: Mapping[str, Variant]
    spectra: Inputs
    reference: Mapping[str, Input]

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write, for every variant, wedge.h5 and the two spherical spectra, as HDF5 and CSV."""
        noise, eor = self.reference.get("noise"), read_delay_spectra(self.reference["eor"])
        sigma_noise = 0.0 if noise is None else noise_level(read_delay_spectra(noise))
        signals = {name: spherical_average(eor, self.power, excise) for name, excise in EXCISION.items()}
        for name, variant in self.variants.items():
            found = read_delay_spectra(self.spectra[name])
            if not np.isfinite(found.power).any():
                raise InputError(f"variants.{name}: all data are flagged, because no solve gave gains")
            save_spectrum(output / spectrum_file(name, "wedge"), cylindrical_average(found, self.power))
            own_noise = 0.0
            if noise is not None and "noise" in variant.components:
                own_noise = sigma_noise * excess_noise(self.spectra[name], noise)
            for modes, excise in EXCISION.items():
                spectrum = with_errors(
                    spherical_average(found, self.power, excise),
                    noise=own_noise,
                    signal=signals[modes] if "eor" in variant.components else None,
                )
                save_spectrum(output / spectrum_file(name, modes), spectrum)
                write_csv(output / f"{name}.{modes}.csv", spectrum)
        return {"sigma_noise_mk2_h3_mpc3": sigma_noise}

    def _cost(self) -> Cost:
        baselines = size_of(self).baselines
        return Cost(0.5 + 2e-3 * baselines + 1e-6 * baselines**2, disk=5e6)


def blocks_in(averages: Iterable[Task]) -> int:
    """Return the largest number of blocks of any of the averages."""
    return max(getattr(task, "blocks", 1) for task in averages)
