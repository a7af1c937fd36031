"""The simulated components: the foreground visibilities F and the EoR visibilities S."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.constants import SECONDS_PER_DAY, SPEED_OF_LIGHT
from calstudy.base.errors import InputError
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.visibilities import from_cube, subset_template, to_cube
from calstudy.instrument.layouts import layout_of, size_of_instrument
from calstudy.instrument.settings import InstrumentSettings, beam_count
from calstudy.products.files import VISIBILITIES, read_visibilities, write_json, write_visibilities
from calstudy.products.graph import Graph, memoize
from calstudy.run.task import Piece, Task
from calstudy.simulate.interface import SimulationSize
from calstudy.simulate.nodes import (
    EARTH_ROTATION_RATE,
    Accuracy,
    chebyshev_count,
    frequency_bandwidth,
    frequency_blocks,
    integration_times,
    patch_nside,
    time_bandwidth,
)
from calstudy.sky.counts import FAINTEST, expected_sources
from calstudy.sky.settings import Eor, Foregrounds, NoSources, PointSources, SkySettings, SyntheticSources

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.simulate.chunks import Component
    from calstudy.simulate.floor import DelayFloor
    from calstudy.simulate.settings import SimulationSettings

CHUNK = "chunk.uvh5"
QUALITY = "quality.json"
TOLERATED = 1e-7
"""Largest interpolation error without a warning, however small the tolerance: the table of the beam has knots."""
TYPICAL_ERROR = 30
"""Relative error allowed for a typical patch, over the tolerance: most contribute little to the visibilities."""

SOURCES = 546_000
DRAWN_SOURCE = 152
"""Bytes kept for every drawn source."""
TABLE_MEMORY = 1.3e6
"""Bytes of the table of a beam for one polarization and frequency."""
TABLE_SECONDS = 0.03
"""Time to make one table, seconds."""
DIPOLE_SECONDS, DIPOLE_MEMORY, WORKERS = 20.0, 0.6e9, 4
"""Cost of the fields of the single dipoles of a tile, which each worker makes for its first chunk."""


@memoize
def foregrounds(graph: Graph) -> Task | None:
    """Return the task of the foreground visibilities F, or None if the sky has none."""
    return foregrounds_of(graph, "foregrounds", graph.experiment.sky, graph.experiment.instrument)


def foregrounds_of(graph: Graph, label: str, sky: SkySettings, instrument: InstrumentSettings) -> Task | None:
    """Return the task of the foregrounds of any sky through any instrument, or None if the sky has none."""
    if not sky.has_foregrounds:
        return None
    diffuse = None if sky.diffuse.kind == "none" else sky.diffuse
    return _simulation(graph, label, instrument=instrument, sky=sky.foregrounds, diffuse=diffuse)


@memoize
def eor(graph: Graph) -> Task:
    """Return the task of the EoR visibilities S, in absolute units."""
    experiment = graph.experiment
    settings = {"instrument": experiment.instrument, "sky": experiment.sky.eor, "cosmology": experiment.power.cosmology}
    return _simulation(graph, "eor", **settings)


def _simulation(graph: Graph, label: str, **settings: Any) -> Task:
    simulation = graph.experiment.simulation
    count = _pieces(simulation, settings["sky"], graph.experiment.instrument)
    chunks = (
        SimulateChunk(
            f"{label} {index + 1}/{count}",
            **settings,
            simulation=simulation,
            chunks=simulation.chunks,
            index=index,
            temporary=True,
        )
        for index in range(count)
    )
    return Simulate(label, **settings, simulation=simulation, chunk=tuple(chunks))


class _Simulated(Task):
    """What a simulation reads: foregrounds with the cosmology None, or the EoR."""

    instrument: InstrumentSettings
    sky: Foregrounds | Eor
    simulation: SimulationSettings
    cosmology: str | None = None
    diffuse: Any = None

    @property
    def component(self) -> Component:
        """The component, ready to be simulated."""
        from calstudy.simulate.chunks import Component

        cosmology = self.cosmology or "Planck15"
        return Component(self.instrument, self.simulation, self.sky, cosmology, self.diffuse)


class SimulateChunk(_Simulated, stage="simulate-chunk", version=4):
    """A block of frequency nodes of a component at all integrations."""

    chunks: int
    index: int

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the visibilities to chunk.uvh5; a chunk beyond the last node stays empty."""
        from calstudy.simulate.chunks import simulate_chunk as simulate

        component = self.component
        if self.index >= len(component.chunks):
            return {"empty": True}
        chunk = component.chunks[self.index]
        sky = component.sky(chunk.nodes)
        cube = simulate(component.engine, sky, component.beam, component.as_built, chunk)
        frame = subset_template(component.template, integration_times(component.template), chunk.frequencies)
        write_visibilities(from_cube(frame, cube), output / CHUNK)
        return {"frequencies": len(chunk.frequencies), "components": int(sky.Ncomponents)}

    def _cost(self) -> Cost:
        instrument, simulation, sky = self.instrument, self.simulation, self.sky
        size, eor = size_of_instrument(instrument), isinstance(sky, Eor)
        sources = 12 * sky.nside**2 if isinstance(sky, Eor) else _sources(self)
        kept = 0.0 if eor else DRAWN_SOURCE * _drawn(sky)
        accuracy = simulation.nodes.accuracy(eor)
        nodes = _node_counts(instrument, accuracy, size.longest)
        patches = _node_counts(instrument, accuracy, size.longest * _patch_radius(sources), TYPICAL_ERROR)
        pieces = _pieces(simulation, sky, instrument)
        beams = beam_count(instrument, size.antennas)
        engine = simulation.engine.cost(
            SimulationSize(
                sources=sources,
                slots=nodes[0] * nodes[1] / pieces,
                patch_slots=(patches[0] * patches[1] + _crossing(instrument) * nodes[1]) / pieces,
                antennas=size.antennas,
                beams=beams,
                tolerance=accuracy.tolerance,
                regular=layout_of(instrument.layout).regular and not instrument.as_built.positions.scatter,
            )
        )
        total = size.samples / size.channels.count * nodes[1] * COMPLEX128
        disk = total / (pieces if eor else frequency_blocks(total, pieces))
        channels = nodes[1] / pieces
        # Directions of all, and of those above the horizon in another order.
        followed = 36 * chebyshev_count(_rotation(instrument) / 2, 1e-15) + 100
        memory = engine.memory + kept + followed * sources + (30 * sources * channels if eor else 0) + 4 * disk
        seconds = 3 + engine.seconds
        if isinstance(sky, Eor) and sky.spectrum == "box" and sky.path is not None:
            from calstudy.sky.boxes import MEMORY_PER_CELL, SECONDS_PER_CELL, read_box

            cells = read_box(sky.path).n_cells(instrument.channels.band)
            memory, seconds = memory + MEMORY_PER_CELL * cells, seconds + SECONDS_PER_CELL * cells
        if beams > 1:
            seconds += beams * TABLE_SECONDS * size.polarizations * channels
            memory += beams * (TABLE_MEMORY * size.polarizations * channels + 2e7)
        if instrument.as_built.dipoles.differ:
            seconds += DIPOLE_SECONDS * min(1, WORKERS / pieces)
            memory += DIPOLE_MEMORY
        return Cost(seconds, memory, disk)


class Simulate(_Simulated, stage="simulate", version=3):
    """The visibilities of a component at all channels."""

    chunk: tuple[Piece, ...]

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the visibilities to visibilities.uvh5, and measures of their quality to quality.json."""
        from calstudy.simulate.chunks import assemble

        component = self.component
        cubes = (to_cube(read_visibilities(folder / CHUNK)) for folder in self.chunk[: len(component.chunks)])
        data = from_cube(component.template, assemble(component.chunks, cubes))
        if not np.any(data.data_array):
            raise InputError(
                f"{self.label}: no source is above the horizon; use more, or another instrument.times.start_lst"
            )
        quality: dict[str, Any] = {"interpolation": component.interpolation_error(to_cube(data))}
        if not component.is_eor:
            quality["delay_floor"] = _floors(data)
        write_visibilities(data, output / VISIBILITIES)
        write_json(output / QUALITY, quality)
        warnings = [*_warnings(component, quality), *_coarse_pixels(self)]
        return {**quality, "stand_ins": component.stand_ins, "warnings": warnings}

    def _cost(self) -> Cost:
        disk = size_of_instrument(self.instrument).samples * COMPLEX128
        return Cost(0.4 + disk * 1.7e-8, LIBRARIES_MEMORY + 4 * disk, disk)


def _warnings(component: Component, quality: Mapping[str, Any]) -> list[str]:
    """Warn of an interpolation error far above the tolerance, for example from a beam much wider than `beam_extent`."""
    check, allowed = quality["interpolation"], component.accuracy.tolerance
    if check is None or check["max_error"] <= max(allowed, TOLERATED):
        return []
    field = "eor_tolerance" if component.is_eor else "tolerance"
    return [
        f"interpolation between simulation nodes errs by {check['max_error']:.1e} of the rms, where simulation.nodes."
        f"{field} is {allowed:.0e}: raise simulation.nodes.beam_extent, or set simulation.nodes.enabled=false"
    ]


def _coarse_pixels(task: _Simulated) -> list[str]:
    """Warn of map pixels larger than half a fringe: as point sources, they are aliased by long baselines."""
    if task.diffuse is None:
        return []
    pixel = (4 * math.pi / (12 * task.diffuse.nside**2)) ** 0.5
    longest = size_of_instrument(task.instrument).longest
    fringe = SPEED_OF_LIGHT / (task.instrument.channels.band[1] * longest)
    if pixel <= fringe / 2:
        return []
    return [
        f"the pixels of the diffuse map ({math.degrees(pixel):.2f} deg) are larger than half a fringe of the longest "
        f"baseline ({math.degrees(fringe):.2f} deg): raise sky.diffuse.nside"
    ]


def _floors(data: UVData) -> dict[str, Any]:
    """Measure the delay floor with both tapers, where the band has delays beyond the horizon for them."""
    from calstudy.simulate.floor import delay_floor, floor_buffers

    return {
        taper: _as_json(delay_floor(data, buffer=buffer, taper=taper)) for taper, buffer in floor_buffers(data).items()
    }


def _as_json(floor: DelayFloor) -> dict[str, Any]:
    """Return the floor with lists for arrays, and null for bins without baselines."""
    rounded = {
        name: [None if value != value else round(float(value), 2) for value in getattr(floor, name)]
        for name in ("edges", "rms_db", "max_db")
    }
    return {**rounded, "buffer_s": floor.buffer, "worst_db": round(floor.worst_db, 2)}


def _node_counts(
    instrument: InstrumentSettings, accuracy: Accuracy, length: float, error: float = 1.0
) -> tuple[int, int]:
    """Estimate the nodes in time and frequency for a baseline length (m) and an error relative to the tolerance."""
    times, channels, tolerance = instrument.times, instrument.channels, error * accuracy.tolerance
    if not tolerance:
        return times.count, channels.count
    length += accuracy.beam_extent
    days = np.array([0.0, times.integration * (times.count - 1) / SECONDS_PER_DAY])
    low, high = channels.band
    in_time = min(chebyshev_count(time_bandwidth(days, high, length), tolerance), times.count)
    if not accuracy.smooth_sky:
        return in_time, channels.count
    in_frequency = chebyshev_count(frequency_bandwidth(np.array([low, high]), length), tolerance)
    return in_time, min(in_frequency, channels.count)


def _pieces(simulation: SimulationSettings, sky: Foregrounds | Eor, instrument: InstrumentSettings) -> int:
    """Return the maximum number of chunks of a component."""
    eor = isinstance(sky, Eor)
    return min(simulation.pieces(eor), instrument.channels.count) if eor else simulation.pieces(eor)


def _rotation(instrument: InstrumentSettings) -> float:
    """Return the rotation angle of the Earth from the first to the last integration, rad."""
    return EARTH_ROTATION_RATE * instrument.times.integration * (instrument.times.count - 1)


def _crossing(instrument: InstrumentSettings) -> float:
    """Estimate the integrations of all sources that rise or set, divided by the number of sources above the horizon."""
    return instrument.times.count * min(1.0, _rotation(instrument) / np.pi)


def _patch_radius(sources: float) -> float:
    """Estimate the radius of a patch, rad."""
    nside = patch_nside(sources)
    return 0.7 / nside if nside else 1.0


def _drawn(sky: Foregrounds | Eor) -> float:
    """Estimate the number of drawn sources, of which only the brightest are used."""
    return expected_sources(max(sky.flux_limit, FAINTEST)) if isinstance(sky, SyntheticSources) else 0.0


def _sources(task: _Simulated) -> int:
    """Estimate the number of foreground components: sources from their counts above the flux limit, pixels of a map."""
    sky, found = task.sky, 0 if task.diffuse is None else 12 * task.diffuse.nside**2
    if isinstance(sky, PointSources):
        expected = int(expected_sources(max(sky.flux_limit, FAINTEST)))
        return found + max(min(sky.count or expected, expected), 1)
    return found if isinstance(sky, NoSources) else found + SOURCES
