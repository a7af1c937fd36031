"""Simulation in chunks: nodes in time and frequency, sources that rise or set, and the check of the interpolation.

A chunk is a block of consecutive frequency nodes at all integrations. Chunks are simulated independently, can be
stored, and are assembled to the visibilities. The result does not depend on the number of chunks.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from calstudy.instrument.telescope import subset_template
from calstudy.simulate.directions import split_by_horizon
from calstudy.simulate.interface import BeamSource, Engine, simulate_with
from calstudy.simulate.nodes import NodeGrid, integration_times, node_grid

if TYPE_CHECKING:
    from pyradiosky import SkyModel
    from pyuvdata import UVData

    from calstudy.instrument.antenna_beams import AntennaBeams
    from calstudy.simulate.settings import SimulationSettings

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Chunk:
    """A block of a simulation's frequency nodes.

    Attributes
    ----------
    grid
        All nodes of the simulation.
    nodes
        Which of `grid.frequencies` belong to this chunk.
    """

    grid: NodeGrid
    nodes: slice

    @property
    def frequencies(self) -> np.ndarray:
        """Frequencies of the chunk's nodes, (Nf,), Hz."""
        return self.grid.frequencies[self.nodes]

    @property
    def channels(self) -> slice:
        """The channels that the chunk's nodes are; raises ValueError where nodes are not channels."""
        if not self.grid.at_channels:
            raise ValueError("the chunk's frequency nodes are not channels, the sky must be smooth in frequency for it")
        return self.nodes


@dataclass(frozen=True)
class InterpolationCheck:
    """Comparison of interpolated with directly simulated visibilities where the error should be largest.

    Attributes
    ----------
    max_error
        Largest absolute difference over the rms of the visibilities.
    rms_error
        Rms difference over the rms of the visibilities.
    times_jd, frequencies
        Where they were compared: at every combination of these (Julian date; Hz).
    time_nodes, frequency_nodes
        How many nodes the simulation has.
    """

    max_error: float
    rms_error: float
    times_jd: list[float]
    frequencies: list[float]
    time_nodes: int
    frequency_nodes: int


def plan_chunks(template: UVData, settings: SimulationSettings, smooth_in_frequency: bool) -> list[Chunk]:
    """Split a simulation into chunks with nearly equal numbers of frequency nodes.

    Parameters
    ----------
    template
        The observation.
    settings
        Nodes and number of chunks; there are never more chunks than frequency nodes.
    smooth_in_frequency
        Whether sky and beam are smooth in frequency. If not (an EoR sky; a beam that is interpolated point to point),
        every channel is simulated, and `Chunk.channels` says which a chunk needs of the sky.
    """
    grid = node_grid(template, settings.nodes, smooth_in_frequency)
    count = min(settings.chunks, len(grid.frequencies))
    edges = np.linspace(0, len(grid.frequencies), count + 1).round().astype(int).tolist()
    return [Chunk(grid, slice(start, stop)) for start, stop in pairwise(edges)]


def simulate_chunk(
    engine: Engine, sky: SkyModel, beam: BeamSource | AntennaBeams, template: UVData, chunk: Chunk
) -> np.ndarray:
    """Simulate a chunk at all integrations.

    Sources that stay above the horizon are simulated at the time nodes and interpolated. Sources that rise or set are
    discontinuous in time, and are simulated at every integration.

    Parameters
    ----------
    engine
        Any.
    sky
        For a sky given channel by channel, at least the chunk's channels.
    beam
        Of all antennas, or of each.
    template
        The whole observation.
    chunk
        From `plan_chunks` of the same template.

    Returns
    -------
    (Ntimes, Nbls, Nf, Npols) complex128
        Visibilities in Jy at all integrations and the chunk's frequency nodes.
    """
    grid, integrations = chunk.grid, integration_times(template)
    if grid.at_integrations:
        return simulate_with(engine, sky, beam, subset_template(template, integrations, chunk.frequencies))
    times = np.concatenate([integrations, grid.times_jd])
    always_up, crossing = split_by_horizon(sky, template.telescope.location, times)
    logger.info("%d sources stay up, %d rise or set, of %d", len(always_up), len(crossing), sky.Ncomponents)
    cube = np.zeros((len(integrations), template.Nbls, len(chunk.frequencies), template.Npols), dtype=np.complex128)
    if len(always_up):
        steady = sky.select(component_inds=always_up, inplace=False, run_check=False)
        nodes = simulate_with(engine, steady, beam, subset_template(template, grid.times_jd, chunk.frequencies))
        cube += grid.interpolate_times(nodes)
        del steady
    if len(crossing):
        changing = sky.select(component_inds=crossing, inplace=False, run_check=False)
        cube += simulate_with(engine, changing, beam, subset_template(template, integrations, chunk.frequencies))
    return cube


def assemble(chunks: list[Chunk], cubes: list[np.ndarray]) -> np.ndarray:
    """Return the visibilities at all channels, (Ntimes, Nbls, Nfreqs, Npols), from the cubes of all chunks in order."""
    return chunks[0].grid.interpolate_frequencies(np.concatenate(cubes, axis=2))


def simulate_visibilities(
    engine: Engine,
    sky: SkyModel,
    beam: BeamSource | AntennaBeams,
    template: UVData,
    settings: SimulationSettings,
    smooth_in_frequency: bool,
) -> np.ndarray:
    """Simulate a complete observation in this process; see `plan_chunks`, `simulate_chunk` and `assemble`.

    Parameters
    ----------
    engine
        What computes the visibilities.
    sky
        Components of the sky.
    beam
        Of all antennas, or of each.
    template
        The observation: antennas, baselines, times, channels, polarizations.
    settings
        Nodes and number of chunks.
    smooth_in_frequency
        Whether sky and beam are, so that channels may be interpolated between nodes.

    Returns
    -------
    (Ntimes, Nbls, Nfreqs, Npols) complex128
        Visibilities in Jy.
    """
    chunks = plan_chunks(template, settings, smooth_in_frequency)
    return assemble(chunks, [simulate_chunk(engine, sky, beam, template, chunk) for chunk in chunks])


def check_interpolation(
    simulate: Callable[[UVData], np.ndarray],
    template: UVData,
    cube: np.ndarray,
    grid: NodeGrid,
    channels: slice = slice(None),
    count: int = 3,
) -> InterpolationCheck:
    """Simulate a few integrations and channels directly and compare.

    Parameters
    ----------
    simulate
        Returns the visibilities at a template's integrations and channels, (Ntimes, Nbls, Nfreqs, Npols): an engine's
        `simulate` with the sky and beam of the simulation.
    template
        Of the simulation.
    cube : (Ntimes, Nbls, Nfreqs, Npols)
        Its result at all channels.
    grid
        Its nodes, `Chunk.grid`.
    channels
        Channels to choose from: those that the sky has, if it is given channel by channel.
    count
        How many integrations and how many channels, spread over the observation, each as far from nodes as can be.
    """
    times, frequencies = integration_times(template), template.freq_array
    at_times = _farthest(times, grid.times_jd, np.arange(len(times)), count)
    at_channels = _farthest(frequencies, grid.frequencies, np.arange(len(frequencies))[channels], count)
    direct = simulate(subset_template(template, times[at_times], frequencies[at_channels]))
    errors = np.abs(cube[at_times][:, :, at_channels] - direct)
    rms = np.sqrt(np.mean(np.abs(direct) ** 2))
    return InterpolationCheck(
        max_error=float(errors.max() / rms),
        rms_error=float(np.sqrt(np.mean(errors**2)) / rms),
        times_jd=times[at_times].tolist(),
        frequencies=frequencies[at_channels].tolist(),
        time_nodes=len(grid.times_jd),
        frequency_nodes=len(grid.frequencies),
    )


def _farthest(samples: np.ndarray, nodes: np.ndarray, candidates: np.ndarray, count: int) -> np.ndarray:
    """Return one candidate from each of `count` stretches, where the polynomial with roots at the nodes is largest."""
    offsets = np.abs(samples[candidates][:, None] - nodes) / (np.ptp(samples) or 1.0)
    with np.errstate(divide="ignore"):
        size = np.log(offsets).sum(axis=1)
    stretches = np.array_split(np.arange(len(candidates)), min(count, len(candidates)))
    return candidates[[stretch[np.argmax(size[stretch])] for stretch in stretches]]
