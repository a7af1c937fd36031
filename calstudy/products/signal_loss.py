"""Signal loss: the response of the residual to the EoR, its power, and the transfer function T = P^R / P^S."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from calstudy.base.resources import Cost
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS
from calstudy.products import calibration, corruption, spectra
from calstudy.products.corruption import PARITIES
from calstudy.products.files import AVERAGE, read_json, read_visibilities, spectrum_file, write_json, write_visibilities
from calstudy.products.graph import Graph, once, size_of
from calstudy.products.spectra import blocks_in
from calstudy.run.task import Job, Stage, Task

if TYPE_CHECKING:
    from pathlib import Path

    from calstudy.power.settings import PowerSettings
    from calstudy.power.spectra import SphericalSpectrum
    from calstudy.power.transfer import Injection

REGIONS = {"outside-wedge": False, "inside-wedge": True}
"""Parts of Fourier space; true for the part inside the wedge."""
TRANSFER = "transfer"
BAND = "transfer-bands"
SCALE = "scale.json"


@once
def transfer(graph: Graph) -> Task | None:
    """Return the task that measures T, or None if the experiment does not calibrate data with the EoR and without."""
    if not graph.experiment.measures_signal_loss:
        return None
    residual, without, eor = (graph.experiment.variants[name] for name in SIGNAL_LOSS_VARIANTS)
    responses = {
        parity: Task(
            DIFFERENCE,
            f"response to the EoR {parity}",
            {},
            {
                "with_signal": spectra.average(graph, residual, parity),
                "without_signal": spectra.average(graph, without, parity),
            },
        )
        for parity in PARITIES
    }
    signal = spectra.average(graph, eor, "even")
    inputs = {
        "signal": spectra.power(graph, "eor"),
        "response": spectra.crossed(graph, "response to the EoR", responses),
        "cross": spectra.crossed(graph, "EoR x response", {"even": signal, "odd": responses["odd"]}),
        "spectra": spectra.spectra(graph),
        "scale": _flux_scale(graph),
    }
    return Task(TRANSFER_STAGE, "signal loss", {"power": graph.experiment.power}, inputs)


def _flux_scale(graph: Graph) -> Task:
    """Return the task of the flux scale of the calibration of data with the EoR.

    It is a separate product, so that T can be made again without another calibration if calibrations are not kept.
    """
    residual = graph.experiment.variants[SIGNAL_LOSS_VARIANTS[0]]
    inputs = {parity: calibration.calibration(graph, residual, parity) for parity in PARITIES}
    if residual.effects:
        inputs["gains"] = corruption.gains(graph)
    return Task(FLUX_SCALE, "flux scale", {"taper": graph.experiment.power.taper}, inputs)


def difference(job: Job) -> Mapping[str, Any]:
    """Write the response of an averaged residual to the signal to average.uvh5."""
    from calstudy.power.transfer import signal_response

    with_signal, without = (read_visibilities(job.inputs[name] / AVERAGE) for name in ("with_signal", "without_signal"))
    write_visibilities(signal_response(with_signal, without), job.output / AVERAGE)
    return {}


def measure(job: Job) -> Mapping[str, Any]:
    """Write T per k outside and inside the wedge and per (|b|, tau), and the residual's power corrected by T."""
    from calstudy.power.spectra import SphericalSpectrum, of_common_units
    from calstudy.power.tables import load_spectrum
    from calstudy.power.transfer import Injection

    settings = job.settings["power"]
    delays = {name: spectra.read_delay_spectra(job.inputs[name]) for name in ("signal", "response", "cross")}
    known = read_json(job.inputs["scale"] / SCALE)["flux_scale"]
    scale = math.nan if known is None else known
    summary = write_transfer(job.output, Injection(**of_common_units(delays)), settings, scale)
    residual, signal = (
        load_spectrum(job.inputs["spectra"] / spectrum_file(name, "outside-wedge"), SphericalSpectrum)
        for name in ("residual", "eor")
    )
    write_corrected(job.output, residual, signal)
    return {"transfer": summary, "flux_scale": _json(scale)}


def write_transfer(
    folder: Path, injection: Injection, settings: PowerSettings, scale: float, largest_error: float = math.inf
) -> dict[str, Any]:
    """Write T per k outside and inside the wedge, in fine bins and in bands, and per (|b|, tau).

    The flux scale of the calibration is NaN if it is not known. Per k, a T with an error above `largest_error` is NaN.
    Return T in bands, as plain JSON types, by part of Fourier space; errors are kept.
    """
    from calstudy.power.binned import make_bin_edges
    from calstudy.power.tables import save_spectrum, write_transfer_csv
    from calstudy.power.transfer import BANDS, cylindrical_transfer, known_within, spherical_transfer

    fine, buffer = make_bin_edges(settings.bins), settings.wedge_buffer
    summary: dict[str, Any] = {}
    for region, inside in REGIONS.items():
        for name, edges in ((TRANSFER, fine), (BAND, BANDS)):
            measured = spherical_transfer(injection, edges, buffer, inside, scale)
            found = known_within(measured, largest_error)
            save_spectrum(folder / spectrum_file(name, region), found)
            write_transfer_csv(folder / f"{name}.{region}.csv", found)
        summary[region] = [
            {"k": [low, high], "transfer": _json(value), "error": _json(error)}
            for low, high, value, error in zip(
                BANDS[:-1], BANDS[1:], found.transfer, measured.transfer_error, strict=True
            )
        ]
    save_spectrum(folder / spectrum_file(TRANSFER, "wedge"), cylindrical_transfer(injection, settings.length_bin))
    return summary


def measure_flux_scale(job: Job) -> Mapping[str, Any]:
    """Write the flux scale of the first polarization, null if it is not known, to scale.json."""
    import numpy as np

    from calstudy.power.delay import make_taper
    from calstudy.power.transfer import flux_scale, gain_ratio
    from calstudy.products.selection import read_gains

    ratios = []
    for parity in PARITIES:
        fitted = read_gains(job.inputs[parity])
        true = np.ones(fitted.values.shape)
        if "gains" in job.inputs:
            true = read_gains(job.inputs["gains"]).over(len(fitted.values), fitted.numbers)
        ratios.append(gain_ratio(true, np.where(fitted.flags, np.nan, fitted.values)))
    scale = flux_scale(ratios[0], ratios[1], make_taper(job.settings["taper"], fitted.frequency.size) ** 2)
    write_json(job.output / SCALE, {"flux_scale": scale if math.isfinite(scale) else None})
    return {}


def _json(value: float) -> float | None:
    return round(float(value), 4) if math.isfinite(value) else None


def write_corrected(folder: Path, residual: SphericalSpectrum, signal: SphericalSpectrum) -> None:
    """Write the power of the residual (with errors) outside the wedge, and the same divided by T.

    T is read from `folder`, as written by `write_transfer`.
    """
    from calstudy.power.tables import load_spectrum, write_columns
    from calstudy.power.transfer import TransferFunction, correct

    found = load_spectrum(folder / spectrum_file(TRANSFER, "outside-wedge"), TransferFunction)
    power, error = correct(residual, found)
    unit = "[mK2 h-3 Mpc3]"
    write_columns(
        folder / "residual-corrected.outside-wedge.csv",
        {
            "k [h/Mpc]": found.k,
            f"residual {unit}": residual.power.real,
            f"residual error {unit}": residual.error,
            "transfer": found.transfer,
            "transfer error": found.transfer_error,
            "cross transfer": found.cross_transfer,
            "cross transfer error": found.cross_transfer_error,
            f"corrected {unit}": power,
            f"corrected error {unit}": error,
            f"eor {unit}": signal.power.real,
        },
    )


def _cost_of_difference(task: Task) -> Cost:
    blocks = blocks_in(task.inputs.values())
    return Cost(0.3 * blocks, disk=blocks * size_of(task).baselines * 1e4)


def _cost_of_flux_scale(task: Task) -> Cost:
    return Cost(0.5 + size_of(task).samples * 2.5e-7, disk=1e3)


DIFFERENCE = Stage(name="difference", version=2, make=difference, cost=_cost_of_difference)
FLUX_SCALE = Stage(name="flux-scale", version=1, make=measure_flux_scale, cost=_cost_of_flux_scale)
TRANSFER_STAGE = Stage(name="transfer", version=4, make=measure, cost=lambda task: Cost(1, disk=1e6))
