"""Stages `gains`, `levels` and `corrupt`: from simulated components to measurements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from calstudy.corrupt.gains import make_gains
from calstudy.corrupt.levels import Levels, rms, set_levels
from calstudy.corrupt.measure import corrupt_by_gains
from calstudy.corrupt.noise import thermal_noise
from calstudy.corrupt.settings import CorruptionSettings, Gains
from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.telescope import make_template
from calstudy.stages.files import read_json, read_visibilities, write_json, write_visibilities
from calstudy.stages.registry import Job
from calstudy.visibilities import from_cube, to_cube


def draw_gains(job: Job) -> Mapping[str, Any]:
    """Write the true gains to gains.calh5."""
    template = make_template(InstrumentSettings.model_validate(job.settings["instrument"]))
    settings = TypeAdapter(Gains).validate_python(job.settings["gains"])
    make_gains(settings, template).write_calh5(job.output / "gains.calh5")
    return {}


def measure_levels(job: Job) -> Mapping[str, Any]:
    """Write the scales of EoR and noise to levels.json."""
    measured = {
        name: rms(to_cube(read_visibilities(job.inputs[name] / "visibilities.uvh5"))) if name in job.inputs else 0.0
        for name in ("foregrounds", "eor")
    }
    settings = CorruptionSettings.model_validate(
        {"eor_level": job.settings["eor_level"], "noise": job.settings["noise"]}
    )
    levels = asdict(set_levels(measured["foregrounds"], measured["eor"], settings))
    write_json(job.output / "levels.json", levels)
    return {"levels_jy": levels, "warnings": _floor_warnings(job)}


def _floor_warnings(job: Job) -> list[str]:
    """Warn if the simulated foregrounds leak more beyond the horizon than the EoR that is put on them."""
    if "foregrounds" not in job.inputs or job.settings["eor_level"] is None:
        return []
    floors = read_json(job.inputs["foregrounds"] / "quality.json")["delay_floor"]
    level = CorruptionSettings.model_validate({"eor_level": job.settings["eor_level"]}).eor_level
    return [
        f"the simulated foregrounds have a delay floor of {floor['worst_db']} dB beyond the horizon "
        f"({taper} taper), above the EoR at {level:g} dB"
        for taper, floor in floors.items()
        if floor["worst_db"] > level
    ]


def corrupt(job: Job) -> Mapping[str, Any]:
    """Write g_a g_b* (F + S + N), or those parts of it that are asked for, to data.uvh5."""
    levels = Levels(**read_json(job.inputs["levels"] / "levels.json"))
    template = make_template(InstrumentSettings.model_validate(job.settings["instrument"]))
    components = job.settings["components"]
    cube = np.zeros((template.Ntimes, template.Nbls, template.Nfreqs, template.Npols), dtype=np.complex128)
    for name, factor in (("foregrounds", 1.0), ("eor", levels.eor_factor)):
        if name in components:
            cube += factor * to_cube(read_visibilities(job.inputs[name] / "visibilities.uvh5"))
    if "noise" in components:
        cube += thermal_noise(cube.shape, levels.noise_std, job.settings["noise_seed"])
    data = from_cube(template, cube)
    if "gains" in job.inputs:
        from pyuvdata import UVCal

        data = corrupt_by_gains(data, UVCal.from_file(job.inputs["gains"] / "gains.calh5"))
    write_visibilities(data, job.output / "data.uvh5", single=True)
    return {"rms_jy": rms(to_cube(data))}
