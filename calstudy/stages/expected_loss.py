"""Stages `expected-loss` and `expected-loss-figure`: what a fit is expected to leave of the EoR, against injection."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from calstudy.calibrate.absorption import expected_transfer
from calstudy.calibrate.measured import make_problem, measure
from calstudy.calibrate.settings import CalibrationSettings
from calstudy.calibrate.tangent import DelayModes
from calstudy.errors import InputError
from calstudy.power.cosmology import k_parallel, k_perpendicular, make_cosmology
from calstudy.power.expected import BaselineModes, ExpectedBins, bin_expected
from calstudy.power.settings import PowerSettings
from calstudy.power.spherical import make_bin_edges
from calstudy.power.tables import load_spectrum, save_spectrum
from calstudy.power.transfer import TransferFunction, TransferMap
from calstudy.stages.files import read_visibilities
from calstudy.stages.registry import Job
from calstudy.stages.selection import read_gains
from calstudy.stages.signal_loss import TRANSFER
from calstudy.visibilities import baseline_vectors, to_cube

EXPECTED = "expected-loss.h5"


def expect(job: Job) -> Mapping[str, Any]:
    """Write the expected T of one calibrated integration, in bins of k and of baseline length and delay."""
    settings, power = (
        CalibrationSettings.model_validate(job.settings["calibration"]),
        PowerSettings.model_validate(job.settings["power"]),
    )
    index = job.settings["integration"]
    data = read_visibilities(job.inputs["data"] / "data.uvh5")
    chosen = np.arange(index * data.Nbls, (index + 1) * data.Nbls)
    sky = None
    if "sky_model" in job.inputs:
        sky = read_visibilities(job.inputs["sky_model"] / "visibilities.uvh5")
        sky = sky.select(blt_inds=chosen, inplace=False, run_check=False)
    measured = measure(data.select(blt_inds=chosen, inplace=False, run_check=False), settings, sky)
    problem = make_problem(measured, settings, slice(0, 1), 0)
    fitted = read_gains(job.inputs["calibration"])
    if isinstance(problem, str) or fitted.flags[index].any():
        raise InputError(f"expected-loss: integration {index} was not calibrated in all antennas and channels")
    model = to_cube(read_visibilities(job.inputs["calibration"] / "model.uvh5"))[index, ..., 0]
    frequency = np.asarray(data.freq_array, float)
    modes = DelayModes(frequency, power.taper)
    expected = expected_transfer(problem, fitted.of(measured.numbers)[index], model, modes, job.settings["probes"])
    cosmology, centre = make_cosmology(power.cosmology), float(frequency.mean())
    lengths = np.linalg.norm(baseline_vectors(measured.data), axis=1)
    binned = bin_expected(
        BaselineModes(
            transfer=expected.transfer,
            error=expected.error,
            length=lengths,
            k_perp=k_perpendicular(cosmology, lengths, centre),
            delay=expected.delay,
            k_parallel=k_parallel(cosmology, expected.delay, centre),
        ),
        make_bin_edges(power.bins),
        power.wedge_buffer,
        power.length_bin,
    )
    save_spectrum(job.output / EXPECTED, binned)
    return {"integration": index, "probes": job.settings["probes"]}


def draw(job: Job) -> Mapping[str, Any]:
    """Draw expected and measured T side by side."""
    from calstudy.figures.expected_loss import ExpectedLoss, draw_expected_loss
    from calstudy.figures.save import figure_arrays, save_figure

    folder = job.inputs["transfer"]
    found = ExpectedLoss(
        expected=load_spectrum(job.inputs["expected"] / EXPECTED, ExpectedBins),
        measured=load_spectrum(folder / f"{TRANSFER}.outside-wedge.h5", TransferFunction),
        map=load_spectrum(folder / f"{TRANSFER}.wedge.h5", TransferMap),
    )
    figure = draw_expected_loss(found, buffer=job.settings["wedge_buffer"], stand_ins=job.settings["notes"])
    save_figure(figure, figure_arrays(found), job.output, "expected-loss")
    return {}
