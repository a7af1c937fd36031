"""Stages `difference`, `transfer` and `transfer-figure`: what a calibration leaves of the EoR."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calstudy.power.settings import PowerSettings
from calstudy.power.spectra import DelaySpectra, delay_spectra
from calstudy.power.spherical import SphericalSpectrum, make_bin_edges
from calstudy.power.tables import load_spectrum, save_spectrum, write_columns, write_transfer_csv
from calstudy.power.transfer import (
    BANDS,
    Injection,
    TransferFunction,
    TransferMap,
    correct,
    cylindrical_transfer,
    signal_response,
    spherical_transfer,
)
from calstudy.stages.files import read_visibilities, write_visibilities
from calstudy.stages.registry import Job

REGIONS = {"outside-wedge": False, "inside-wedge": True}
"""Names of the parts of Fourier space, and whether each is inside the wedge."""
TRANSFER = "transfer"
BAND = "transfer-bands"


def difference(job: Job) -> Mapping[str, Any]:
    """Write the response of an averaged residual to the signal to average.uvh5."""
    with_signal, without = (
        read_visibilities(job.inputs[name] / "average.uvh5") for name in ("with_signal", "without_signal")
    )
    write_visibilities(signal_response(with_signal, without), job.output / "average.uvh5")
    return {}


def _read(folder: Path, settings: PowerSettings) -> DelaySpectra:
    from hera_pspec import UVPSpec

    uvp = UVPSpec()
    uvp.read_hdf5(str(folder / "pspec.h5"))
    return delay_spectra(uvp, settings)


def transfer(job: Job) -> Mapping[str, Any]:
    """Write T per k outside and inside the wedge and per (|b|, tau), and the residual's power corrected by it."""
    settings = PowerSettings.model_validate(job.settings["power"])
    injection = Injection(**{name: _read(job.inputs[name], settings) for name in ("signal", "response", "cross")})
    fine, buffer = make_bin_edges(settings.bins), settings.wedge_buffer
    summary = {}
    for region, inside in REGIONS.items():
        for name, edges in ((TRANSFER, fine), (BAND, BANDS)):
            found = spherical_transfer(injection, edges, buffer, inside)
            save_spectrum(job.output / f"{name}.{region}.h5", found)
            write_transfer_csv(job.output / f"{name}.{region}.csv", found)
        summary[region] = [
            {"k": [low, high], "transfer": _json(value), "error": _json(error)}
            for low, high, value, error in zip(BANDS[:-1], BANDS[1:], found.transfer, found.transfer_error, strict=True)
        ]
    save_spectrum(job.output / f"{TRANSFER}.wedge.h5", cylindrical_transfer(injection, settings.length_bin))
    _write_corrected(job)
    return {"transfer": summary}


def _json(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


def _write_corrected(job: Job) -> None:
    found = load_spectrum(job.output / f"{TRANSFER}.outside-wedge.h5", TransferFunction)
    residual, signal = (
        load_spectrum(job.inputs["spectra"] / f"{name}.outside-wedge.h5", SphericalSpectrum)
        for name in ("residual", "eor")
    )
    power, error = correct(residual, found)
    unit = "[mK2 h-3 Mpc3]"
    write_columns(
        job.output / "residual-corrected.outside-wedge.csv",
        {
            "k [h/Mpc]": found.k,
            f"residual {unit}": residual.power.real,
            f"residual error {unit}": residual.error,
            "transfer": found.transfer,
            "transfer error": found.transfer_error,
            f"corrected {unit}": power,
            f"corrected error {unit}": error,
            f"eor {unit}": signal.power.real,
        },
    )


def draw(job: Job) -> Mapping[str, Any]:
    """Draw T per k and per (|b|, tau), as png and pdf, with the arrays as npz."""
    from calstudy.figures.save import figure_arrays, save_figure
    from calstudy.figures.signal_loss import SignalLoss, draw_signal_loss

    folder = job.inputs["transfer"]
    outside, inside = (load_spectrum(folder / f"{TRANSFER}.{name}.h5", TransferFunction) for name in REGIONS)
    loss = SignalLoss(outside, inside, load_spectrum(folder / f"{TRANSFER}.wedge.h5", TransferMap))
    figure = draw_signal_loss(loss, buffer=job.settings["wedge_buffer"], stand_ins=job.settings["notes"])
    save_figure(figure, figure_arrays(loss), job.output, "signal-loss")
    return {}
