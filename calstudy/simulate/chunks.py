"""Components of the sky through one instrument, simulated in chunks; their assembly, and a check of the interpolation.

A chunk is a block of consecutive frequency nodes at all integrations, for the whole sky or one part of it. Chunks are
simulated independently, can be stored, and are added up to the visibilities. Their number changes the result by less
than the tolerance of the interpolation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.visibilities import subset_template
from calstudy.instrument.antenna_beams import make_beams
from calstudy.instrument.interface import AntennaBeam, AntennaBeams, model_of
from calstudy.instrument.telescope import make_template
from calstudy.power.cosmology import make_cosmology
from calstudy.simulate.interface import Engine, simulate_with
from calstudy.simulate.nodes import Accuracy, Axis, frequency_axis, frequency_blocks, integration_times, time_axis
from calstudy.simulate.sources import sky_cells
from calstudy.sky.eor import EorField
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.sky.settings import Diffuse, Eor, Foregrounds

if TYPE_CHECKING:
    from pyradiosky import SkyModel
    from pyuvdata import UVData

    from calstudy.instrument.settings import InstrumentSettings
    from calstudy.simulate.settings import SimulationSettings

PART_NSIDE = 8
"""Resolution of the grid whose cells are divided between the parts of the sky."""
SMOOTH_SPECTRA = ("flat", "spectral_index")
CHECKED = 2
"""Number of integrations, and of channels, at which interpolated visibilities are compared with direct ones."""


@dataclass(frozen=True)
class Chunk:
    """One piece of a simulation.

    `axis` has all frequency nodes of the simulation, and `nodes` selects those of this chunk: channels, unless sky and
    beam are smooth. `part` is the index of the part of the sky, and the number of parts.
    """

    axis: Axis
    nodes: slice
    part: tuple[int, int]
    accuracy: Accuracy

    @property
    def frequencies(self) -> np.ndarray:
        """Frequencies of the nodes of the chunk, (Nf,), Hz."""
        return self.axis.nodes[self.nodes]

    def select(self, sky: SkyModel) -> SkyModel | None:
        """Select the chunk's part of a sky, or None if it is empty; every n-th cell of a grid, for equal times."""
        index, count = self.part
        if count == 1:
            return sky
        chosen = np.flatnonzero(sky_cells(sky, PART_NSIDE) % count == index)
        return sky.select(component_inds=chosen, inplace=False, run_check=False) if len(chosen) else None


def plan_chunks(template: UVData, accuracy: Accuracy, count: int) -> list[Chunk]:
    """Split a simulation into at most `count` chunks that take about equal times.

    A sky given channel by channel (the EoR), or seen through a beam that is not smooth in frequency, is split by
    channels. A smooth sky needs relatively fewer frequency nodes the wider the band is (`calstudy.simulate.patches`),
    so it is split into parts of the sky, and by frequency only where a chunk would be too large.
    """
    axis = frequency_axis(template, accuracy)
    blocks = min(count, len(axis.nodes))
    if not axis.at_samples:
        blocks = frequency_blocks(16.0 * template.Nblts * template.Npols * len(axis.nodes), blocks)
    parts = 1 if axis.at_samples else count // blocks
    edges = np.linspace(0, len(axis.nodes), blocks + 1).round().astype(int).tolist()
    return [
        Chunk(axis, slice(start, stop), (part, parts), accuracy)
        for start, stop in pairwise(edges)
        for part in range(parts)
    ]


def simulate_chunk(
    engine: Engine, sky: SkyModel, beam: AntennaBeam | AntennaBeams, template: UVData, chunk: Chunk
) -> np.ndarray:
    """Simulate a chunk in Jy at all integrations and at its frequency nodes, (Ntimes, Nbls, Nf, Npols) complex128.

    Template and sky are the whole ones; a sky that is given channel by channel needs only the channels of the chunk.
    """
    frame = subset_template(template, integration_times(template), chunk.frequencies)
    part = chunk.select(sky)
    if part is None:
        return np.zeros((frame.Ntimes, frame.Nbls, frame.Nfreqs, frame.Npols), dtype=np.complex128)
    return simulate_with(engine, part, beam, frame, chunk.accuracy)


def assemble(chunks: list[Chunk], cubes: Iterable[np.ndarray]) -> np.ndarray:
    """Return the visibilities at all channels, (Ntimes, Nbls, Nfreqs, Npols), from the cubes of all chunks in order."""
    axis = chunks[0].axis
    blocks: dict[int, np.ndarray] = {}
    for chunk, cube in zip(chunks, cubes, strict=True):
        start = chunk.nodes.start
        blocks[start] = blocks[start] + cube if start in blocks else cube
    whole = np.concatenate([blocks[start] for start in sorted(blocks)], axis=2)
    return np.moveaxis(axis.interpolate(np.moveaxis(whole, 2, 0)), 0, 2)


def simulate_visibilities(
    engine: Engine,
    sky: SkyModel,
    beam: AntennaBeam | AntennaBeams,
    template: UVData,
    accuracy: Accuracy,
    count: int = 1,
) -> np.ndarray:
    """Simulate an observation chunk by chunk in this process, (Ntimes, Nbls, Nfreqs, Npols) complex128, Jy."""
    chunks = plan_chunks(template, accuracy, count)
    return assemble(chunks, (simulate_chunk(engine, sky, beam, template, chunk) for chunk in chunks))


def check_interpolation(
    simulate: Callable[[UVData], np.ndarray],
    template: UVData,
    cube: np.ndarray,
    chunk: Chunk,
    channels: slice = slice(None),
    count: int = 3,
) -> dict[str, Any]:
    """Compare interpolated visibilities with a direct simulation where the error should be largest.

    Errors, the largest and the rms, are relative to the rms of the visibilities, and of all combinations of a few
    integrations (Julian dates) and channels (Hz). They are returned with the numbers of nodes, as plain JSON types.

    Parameters
    ----------
    simulate
        Returns the visibilities at the integrations and channels of a template, (Ntimes, Nbls, Nfreqs, Npols): an
        engine's `simulate` with the sky and beam of the simulation.
    cube : interpolated visibilities at all channels, (Ntimes, Nbls, Nfreqs, Npols)
    chunk : any chunk of the simulation, for its nodes
    channels : channels to choose from: those of the sky, if it is given channel by channel
    count : number of integrations, and of channels, spread over the observation; each is as far from nodes as possible
    """
    times, frequencies = integration_times(template), template.freq_array
    nodes = time_axis(template, chunk.accuracy).nodes
    at_times = _farthest(times, nodes, np.arange(len(times)), count)
    at_channels = _farthest(frequencies, chunk.axis.nodes, np.arange(len(frequencies))[channels], count)
    direct = simulate(subset_template(template, times[at_times], frequencies[at_channels]))
    errors = np.abs(cube[at_times][:, :, at_channels] - direct)
    # Sources may be up in other integrations only.
    rms = np.sqrt(np.mean(np.abs(direct if direct.any() else cube) ** 2))
    return {
        "max_error": float(errors.max() / rms),
        "rms_error": float(np.sqrt(np.mean(errors**2)) / rms),
        "times_jd": times[at_times].tolist(),
        "frequencies": frequencies[at_channels].tolist(),
        "time_nodes": len(nodes),
        "frequency_nodes": len(chunk.axis.nodes),
    }


def _farthest(samples: np.ndarray, nodes: np.ndarray, candidates: np.ndarray, count: int) -> np.ndarray:
    """Return one candidate from each of `count` intervals, where the polynomial with roots at the nodes is largest."""
    offsets = np.abs(samples[candidates][:, None] - nodes) / (np.ptp(samples) or 1.0)
    with np.errstate(divide="ignore"):
        size = np.log(offsets).sum(axis=1)
    stretches = np.array_split(np.arange(len(candidates)), min(count, len(candidates)))
    return candidates[[stretch[np.argmax(size[stretch])] for stretch in stretches]]


class Component:
    """Sources or the EoR seen by the instrument as built; expensive parts are made on demand.

    `template` is the observation with the nominal antenna positions, which data files have. `as_built` has the true
    positions, for which it is simulated. The cosmology converts the P(k) of the EoR to brightness. Diffuse emission is
    added to sources.
    """

    def __init__(
        self,
        instrument: InstrumentSettings,
        simulation: SimulationSettings,
        sky: Foregrounds | Eor,
        cosmology: str,
        diffuse: Diffuse | None = None,
    ) -> None:
        self._sky, self._cosmology, self._diffuse = sky, cosmology, diffuse
        self.is_eor = isinstance(sky, Eor)
        self.instrument, self.simulation = instrument, simulation
        self.template = make_template(instrument)
        moved = instrument.as_built.positions.scatter > 0
        self.as_built = make_template(instrument, as_built=True) if moved else self.template
        self.beam = make_beams(instrument, self.template.telescope.Nants)
        self.engine = simulation.engine
        self.stand_ins = self._notes(None)

    def _notes(self, sky: str | None) -> list[str]:
        return [note for note in (sky, self.beam.stand_in, self.instrument.as_built.note) if note]

    @cached_property
    def _source(self) -> EorField | SkyModel:
        if isinstance(self._sky, Eor):
            return EorField(self._sky, self.template.freq_array, make_cosmology(self._cosmology))
        foregrounds = make_foregrounds(self._sky, self.template.freq_array, self._diffuse)
        self.stand_ins = self._notes(foregrounds.stand_in)
        return foregrounds.sky

    @cached_property
    def accuracy(self) -> Accuracy:
        """Tolerance of the interpolation, and whether beam and sky are smooth in frequency."""
        groups = self.instrument.antenna_beams.values()
        beams = [model_of(beam) for beam in (self.instrument.beam, *(group.beam for group in groups))]
        smooth_sky = getattr(self._source, "spectral_type", None) in SMOOTH_SPECTRA
        return self.simulation.nodes.accuracy(
            self.is_eor, all(beam.smooth for beam in beams), smooth_sky, max(beam.extent for beam in beams)
        )

    @cached_property
    def chunks(self) -> list[Chunk]:
        """Chunks of the simulation, at most as many as the settings ask for."""
        return plan_chunks(self.as_built, self.accuracy, self.simulation.pieces(self.is_eor))

    def sky(self, channels: slice | np.ndarray) -> SkyModel:
        """Return the sky; for the EoR only at the given channels."""
        return self._source.sky(channels) if isinstance(self._source, EorField) else self._source

    def interpolation_error(self, cube: np.ndarray) -> dict[str, Any] | None:
        """Compare interpolated visibilities, (Ntimes, Nbls, Nfreqs, Npols), Jy, with directly simulated ones.

        Return None if nothing is interpolated.
        """
        if not self.accuracy.tolerance:
            return None
        # The channels of the EoR are independent, so only the last ones are drawn again.
        channels = slice(-CHECKED, None) if self.is_eor else slice(None)
        sky = self.sky(np.arange(self.template.Nfreqs)[channels])
        simulate = partial(simulate_with, self.engine, sky, self.beam)
        return check_interpolation(simulate, self.as_built, cube, self.chunks[0], channels, CHECKED)
