"""Stages `average`, `power` and `spectra`: from visibilities to averaged power spectra with errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import TypeAdapter

from calstudy.graph.tasks import EOR_REFERENCE, NOISE_REFERENCE
from calstudy.instrument.beams import make_beam
from calstudy.instrument.settings import Beam, Channels
from calstudy.power.average import fringe_stop_and_average
from calstudy.power.errors import noise_level, with_errors
from calstudy.power.estimate import estimate_power
from calstudy.power.settings import PowerSettings
from calstudy.power.spectra import DelaySpectra, delay_spectra
from calstudy.power.spherical import spherical_average
from calstudy.power.tables import save_spectrum, write_csv
from calstudy.power.wedge import cylindrical_average
from calstudy.stages.files import read_visibilities, write_visibilities
from calstudy.stages.registry import Job

EXCISION = {"all-modes": False, "outside-wedge": True}
"""Names of the spherical averages, and whether each leaves the wedge out."""


def average(job: Job) -> Mapping[str, Any]:
    """Write the fringe-stopped average of a data set to average.uvh5."""
    data = read_visibilities(job.inputs["data"] / job.settings["file"])
    write_visibilities(fringe_stop_and_average(data), job.output / "average.uvh5")
    return {}


def estimate(job: Job) -> Mapping[str, Any]:
    """Write the delay spectra even x odd to pspec.h5."""
    even, odd = (read_visibilities(job.inputs[parity] / "average.uvh5") for parity in ("even", "odd"))
    beam = make_beam(
        TypeAdapter(Beam).validate_python(job.settings["beam"]),
        Channels.model_validate(job.settings["channels"]),
    )
    settings = PowerSettings.model_validate(job.settings["power"])
    spectra = estimate_power(even, odd, beam, settings)
    spectra.write_hdf5(str(job.output / "pspec.h5"))
    return {"pairs": int(spectra.Nblpairs)}


def _read_spectra(job: Job, settings: PowerSettings) -> dict[str, DelaySpectra]:
    from hera_pspec import UVPSpec

    found = {}
    for name in job.inputs:
        uvp = UVPSpec()
        uvp.read_hdf5(str(job.inputs[name] / "pspec.h5"))
        found[name] = delay_spectra(uvp, settings)
    return found


def spectra(job: Job) -> Mapping[str, Any]:
    """Write, for every variant, wedge.h5 and the two spherical spectra with their errors, as HDF5 and CSV.

    The noise part of the errors comes from spectra of the noise alone, the sample variance from those of the EoR alone
    (paper section Reduction of Simulation Products); each enters the variants that contain its component.
    """
    settings = PowerSettings.model_validate(job.settings["power"])
    variants = {name: set(variant["components"]) for name, variant in job.settings["variants"].items()}
    delays = _read_spectra(job, settings)
    sigma_noise = noise_level(delays[NOISE_REFERENCE]) if NOISE_REFERENCE in delays else 0.0
    signals = {name: spherical_average(delays[EOR_REFERENCE], settings, excise) for name, excise in EXCISION.items()}
    for name, parts in variants.items():
        save_spectrum(job.output / f"{name}.wedge.h5", cylindrical_average(delays[name], settings))
        for modes, excise in EXCISION.items():
            spectrum = with_errors(
                spherical_average(delays[name], settings, excise),
                noise=sigma_noise if "noise" in parts else 0.0,
                signal=signals[modes] if "eor" in parts else None,
            )
            save_spectrum(job.output / f"{name}.{modes}.h5", spectrum)
            write_csv(job.output / f"{name}.{modes}.csv", spectrum)
    return {"sigma_noise_mk2_h3_mpc3": sigma_noise}
