"""Stages `simulate-chunk` and `simulate`: from skies and beam to visibilities."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import TypeAdapter

from calstudy.instrument.antenna_beams import make_beams
from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.telescope import make_template, subset_template
from calstudy.power.cosmology import make_cosmology
from calstudy.simulate.chunks import Chunk, assemble, check_interpolation, plan_chunks, simulate_chunk
from calstudy.simulate.engine import make_engine
from calstudy.simulate.floor import DelayFloor, delay_floor, floor_buffers
from calstudy.simulate.nodes import integration_times
from calstudy.simulate.settings import SimulationSettings
from calstudy.sky.eor import EorField
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.sky.settings import Eor, Foregrounds
from calstudy.stages.files import read_visibilities, write_json, write_visibilities
from calstudy.stages.registry import Job
from calstudy.visibilities import from_cube, to_cube

if TYPE_CHECKING:
    from pyradiosky import SkyModel
    from pyuvdata import UVData

SMOOTH_SPECTRA = ("flat", "spectral_index")
TOLERATED = 100
"""Interpolation errors up to this times the tolerance, which bounds a typical one, go without a warning."""
CHECKED = 2
"""Integrations, and channels, at which interpolated visibilities are compared with directly simulated ones."""


class _Scene:
    """The instrument and the sky of one simulation, made from the settings of a job when they are asked for."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self._sky_settings = settings["sky"]
        self._cosmology = settings.get("cosmology")
        self.is_eor = settings["component"] == "eor"
        self.instrument = InstrumentSettings.model_validate(settings["instrument"])
        self.simulation = SimulationSettings.model_validate(settings["simulation"])
        self.template = make_template(self.instrument)
        self.beam = make_beams(self.instrument, self.template.telescope.Nants)
        self.engine = make_engine(self.simulation)
        self.stand_ins = [self.beam.stand_in] if self.beam.stand_in else []

    @cached_property
    def _field(self) -> EorField:
        settings = Eor.model_validate(self._sky_settings)
        return EorField(settings, self.template.freq_array, make_cosmology(self._cosmology))

    @cached_property
    def _foregrounds(self) -> SkyModel:
        settings = TypeAdapter(Foregrounds).validate_python(self._sky_settings)
        foregrounds = make_foregrounds(settings, self.template.freq_array)
        self.stand_ins = [note for note in (foregrounds.stand_in, self.beam.stand_in) if note]
        return foregrounds.sky

    @property
    def smooth(self) -> bool:
        """Whether sky and beam vary smoothly from channel to channel, so that frequency nodes suffice."""
        beams = [self.instrument.beam, *(group.beam for group in self.instrument.antenna_beams.values())]
        smooth = all(getattr(beam, "interpolation", "chebyshev") == "chebyshev" for beam in beams)
        return not self.is_eor and smooth and self._foregrounds.spectral_type in SMOOTH_SPECTRA

    @cached_property
    def chunks(self) -> list[Chunk]:
        """The pieces of the simulation; there may be fewer than asked for."""
        return plan_chunks(self.template, self.simulation, self.smooth)

    def sky(self, channels: slice | np.ndarray) -> SkyModel:
        """Return the sky, of the EoR only the given channels."""
        return self._field.sky(channels) if self.is_eor else self._foregrounds


def simulate_chunk_product(job: Job) -> Mapping[str, Any]:
    """Write a block of frequency nodes at all integrations to chunk.uvh5; a piece beyond the nodes stays empty."""
    scene = _Scene(job.settings)
    if job.settings["index"] >= len(scene.chunks):
        return {"empty": True}
    chunk = scene.chunks[job.settings["index"]]
    sky = scene.sky(chunk.channels if scene.is_eor else slice(None))
    cube = simulate_chunk(scene.engine, sky, scene.beam, scene.template, chunk)
    frame = subset_template(scene.template, integration_times(scene.template), chunk.frequencies)
    write_visibilities(from_cube(frame, cube), job.output / "chunk.uvh5")
    return {"frequencies": len(chunk.frequencies), "components": int(sky.Ncomponents)}


def assemble_product(job: Job) -> Mapping[str, Any]:
    """Write the visibilities at all channels to visibilities.uvh5, and what they are worth to quality.json."""
    scene = _Scene(job.settings)
    cubes = [to_cube(read_visibilities(job.inputs[f"chunk{n:03d}"] / "chunk.uvh5")) for n in range(len(scene.chunks))]
    data = from_cube(scene.template, assemble(scene.chunks, cubes))
    quality: dict[str, Any] = {"interpolation": _check(scene, to_cube(data))}
    if not scene.is_eor:
        quality["delay_floor"] = _floors(data)
    write_visibilities(data, job.output / "visibilities.uvh5")
    write_json(job.output / "quality.json", quality)
    return {**quality, "stand_ins": scene.stand_ins, "warnings": _warnings(scene, quality)}


def _warnings(scene: _Scene, quality: Mapping[str, Any]) -> list[str]:
    """Warn of an interpolation error far above the tolerance, as a beam much wider than `beam_extent` makes."""
    check, nodes = quality["interpolation"], scene.simulation.nodes
    if check is None or check["max_error"] <= TOLERATED * nodes.tolerance:
        return []
    return [
        f"interpolation between simulation nodes errs by {check['max_error']:.1e} of the rms, where simulation.nodes."
        f"tolerance is {nodes.tolerance:.0e}: raise simulation.nodes.beam_extent, or set simulation.nodes.enabled=false"
    ]


def _check(scene: _Scene, cube: np.ndarray) -> dict[str, Any] | None:
    grid = scene.chunks[0].grid
    if grid.at_integrations and grid.at_channels:
        return None
    # Of the EoR, whose channels are independent, only the last block is drawn again.
    channels = slice(-CHECKED, None) if scene.is_eor else slice(None)
    indices = np.arange(scene.template.Nfreqs)[channels]
    sky = scene.sky(indices)
    simulate = partial(scene.engine.simulate, sky, scene.beam)
    return asdict(check_interpolation(simulate, scene.template, cube, grid, channels=channels, count=CHECKED))


def _floors(data: UVData) -> dict[str, Any]:
    """Measure the delay floor with both tapers, where the band leaves delays beyond the horizon for them."""
    return {
        taper: _as_json(delay_floor(data, buffer=buffer, taper=taper)) for taper, buffer in floor_buffers(data).items()
    }


def _as_json(floor: DelayFloor) -> dict[str, Any]:
    """Return the floor with lists for arrays, and null for bins without baselines."""
    rounded = {
        name: [None if np.isnan(value) else round(float(value), 2) for value in getattr(floor, name)]
        for name in ("edges", "rms_db", "max_db")
    }
    return {**rounded, "buffer_s": floor.buffer, "worst_db": round(floor.worst_db, 2)}
