"""Signal loss: the response of the residual to the EoR, its power, and the transfer function T = P^R / P^S."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.files import json_number
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.table import Table
from calstudy.base.visibilities import crosses_of
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS
from calstudy.power.binned import make_bin_edges
from calstudy.power.delay import make_taper
from calstudy.power.score import SPECTRA, CalibratedSpectra
from calstudy.power.score import score as measure
from calstudy.power.spectra import SphericalSpectrum
from calstudy.power.tables import TRANSFER_COLUMNS, load_spectrum, save_spectrum, write_columns, write_csv
from calstudy.power.transfer import (
    BANDS,
    Injection,
    TransferFunction,
    correct,
    cylindrical_transfer,
    flux_scale,
    gain_ratio,
    signal_response,
    spherical_transfer,
    where_measured,
)
from calstudy.products import calibration, corruption, spectra
from calstudy.products.calibration import in_words
from calstudy.products.corruption import PARITIES
from calstudy.products.files import (
    AVERAGE,
    RESIDUAL,
    SCORE,
    TRANSFER,
    TRANSFER_BANDS,
    read_json,
    read_visibilities,
    spectrum_file,
    write_json,
    write_visibilities,
)
from calstudy.products.graph import Graph, memoize, size_of
from calstudy.products.spectra import InBlocks, blocks_in
from calstudy.products.table import StudyTable
from calstudy.run.task import Input, Inputs, Task
from calstudy.verdicts.standing import marked, why_not_measured

if TYPE_CHECKING:
    from calstudy.power.settings import PowerSettings

REGIONS = {"outside-wedge": False, "inside-wedge": True}
"""Parts of Fourier space; true for the part inside the wedge."""
SCALE, SUMMARY = "scale.json", "summary.csv"
NOTE = (
    "T = P^D / P^S by injection: the power of the response of the residual to the EoR, over the power of the EoR, free "
    "of the error of the calibration's flux scale where the true gains are known. The squared coherence of response "
    "and EoR does not need these; for spectra of each baseline with itself it is the fraction of the power that is "
    "retained. One standard deviation."
)


@memoize
def transfer(graph: Graph) -> Transfer | None:
    """Return the task that measures T, or None if the experiment does not calibrate data with the EoR and without."""
    if not graph.experiment.measures_signal_loss:
        return None
    residual, without, eor = (graph.experiment.variants[name] for name in SIGNAL_LOSS_VARIANTS)
    label = "response to the EoR"
    responses = [
        difference(
            f"{label} {parity}", [spectra.average(graph, variant, parity) for variant in (residual, without)], "data"
        )
        for parity in PARITIES
    ]
    return Transfer(
        "signal loss",
        power=graph.experiment.power,
        signal=spectra.power(graph, "eor"),
        response=spectra.cross_power(graph, label, responses),
        cross=spectra.cross_power(graph, "EoR x response", [spectra.average(graph, eor, "even"), responses[1]]),
        spectra=spectra.spectra(graph),
        scale=_flux_scale(graph),
    )


def _flux_scale(graph: Graph) -> Task:
    """Return the task of the flux scale of the calibration of data with the EoR.

    It is a separate product, so that T can be made again without another calibration if calibrations are not kept.
    """
    residual = graph.experiment.variants[SIGNAL_LOSS_VARIANTS[0]]
    even, odd = (calibration.calibration(graph, residual, parity) for parity in PARITIES)
    return FluxScale(
        "flux scale",
        taper=graph.experiment.power.taper,
        polarizations=len(graph.experiment.instrument.polarizations),
        blocks=blocks_in([spectra.average(graph, residual, parity) for parity in PARITIES]),
        even=even,
        odd=odd,
        gains=corruption.gains(graph) if residual.effects else None,
    )


class TransferTable(StudyTable):
    """The signal loss."""

    of = "experiment"
    place = 3

    def products(self, graph: Graph) -> Sequence[Task | None]:
        """Return the product."""
        return [transfer(graph)]


def difference(label: str, averages: Sequence[Task], source: str) -> Task:
    """Return the task of the response to a signal, from averages of residuals with and without it, in this order.

    `source` is the input of the averages that is the calibration.
    """
    with_signal, without_signal = averages
    blocks: dict[str, Any] = {name: getattr(with_signal, name) for name in ("blocks", "centre", "span", "kept")}
    calibrations = {"with": with_signal.inputs[source], "without": without_signal.inputs[source]}
    return Difference(
        label, with_signal=with_signal, without_signal=without_signal, calibrations=calibrations, **blocks
    )


class Difference(InBlocks, stage="difference", version=4):
    """The response of a residual to the signal, averaged."""

    with_signal: Input
    without_signal: Input
    calibrations: Inputs

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the response to average.uvh5.

        Where other samples are flagged with the signal than without it, both have the flags of either before they are
        averaged: foregrounds and noise would not cancel in a difference of averages.
        """
        from calstudy.power.average import average_in_blocks

        averages = [read_visibilities(folder / AVERAGE) for folder in (self.with_signal, self.without_signal)]
        response, warnings = signal_response(*averages), []
        flags, others = (_flags_of(folder / RESIDUAL) for folder in self.calibrations.values())
        if not np.array_equal(flags, others):
            found = signal_response(*(read_visibilities(folder / RESIDUAL) for folder in self.calibrations.values()))
            found = crosses_of(found)
            found.data_array[found.flag_array] = 0
            response = average_in_blocks(found, self.blocks_of(found))
            part = np.mean(flags ^ others) / np.mean(~(flags & others))
            warnings = [f"{part:.2%} of the samples are left out of T: flagged only with the EoR, or only without"]
        write_visibilities(response, output / AVERAGE)
        return {"warnings": warnings}

    def _cost(self) -> Cost:
        size, blocks = size_of(self), blocks_in([self.with_signal, self.without_signal])
        return Cost(0.1 * blocks, LIBRARIES_MEMORY + 8 * size.samples * COMPLEX128, disk=blocks * size.baselines * 1e4)


def _flags_of(path: Path) -> np.ndarray:
    """Read the flags of visibilities alone, which takes less time than a `UVData`."""
    import h5py

    with h5py.File(path) as file:
        return np.asarray(file["Data/flags"])


def read_calibrated(folders: Mapping[str, Path]) -> CalibratedSpectra:
    """Read the delay spectra of a calibration, in common units, from the folders of each."""
    return CalibratedSpectra(**spectra.read_common(folders))


class Injected(Task):
    """The power of a signal and of the response to it, and the spectra of the residual."""

    power: PowerSettings
    signal: Input
    response: Input
    cross: Input
    spectra: Input

    def read(self) -> Injection:
        """Read the delay spectra, in common units."""
        return Injection(**spectra.read_common({name: getattr(self, name) for name in ("signal", "response", "cross")}))

    def shown(self, folder: Path) -> Sequence[Table]:
        """Return T and the squared coherence in bands of k."""
        outside, inside = (
            load_spectrum(folder / spectrum_file(TRANSFER_BANDS, part), TransferFunction) for part in REGIONS
        )
        columns = ("k (h/Mpc)", "T outside the wedge", "squared coherence outside", "T inside the wedge")
        rows = [
            (
                f"{outside.bin_edges[band]:g} to {outside.bin_edges[band + 1]:g}",
                _transfer(outside, band),
                _with_error(outside.squared_coherence[band], outside.squared_coherence_error[band]),
                _transfer(inside, band),
            )
            for band in range(outside.k.size)
        ]
        return [Table(columns, rows, "Signal loss", NOTE)]


class Transfer(Injected, stage="transfer", version=8, cost=Cost(1, disk=1e6)):
    """T per k outside and inside the wedge and per (|b|, tau)."""

    scale: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write T, and the residual's power corrected by T."""
        known = read_json(self.scale / SCALE)["flux_scale"]
        scale = math.nan if known is None else known
        summary = write_transfer(output, self.read(), self.power, scale)
        residual, signal = spectra.read_recovered(self.spectra)
        write_corrected(output, residual, signal, reduced=False)
        return {"transfer": summary, "flux_scale": _json(scale)}


def write_transfer(
    folder: Path, injection: Injection, settings: PowerSettings, scale: float, only_measured: bool = False
) -> dict[str, Any]:
    """Write T per k outside and inside the wedge, in fine bins and in bands, and per (|b|, tau).

    The flux scale of the calibration is NaN if it is not known. With `only_measured`, T per k is NaN where it is not
    measured (`calstudy.verdicts.standing`). Return T in bands, as plain JSON types, by part of Fourier space, with why
    it is not measured.
    """
    fine, buffer = make_bin_edges(settings.bins), settings.wedge_buffer
    summary: dict[str, Any] = {}
    for region, inside in REGIONS.items():
        for name, edges in ((TRANSFER, fine), (TRANSFER_BANDS, BANDS)):
            measured = spherical_transfer(injection, edges, buffer, inside, scale)
            found = where_measured(measured) if only_measured else measured
            save_spectrum(folder / spectrum_file(name, region), found)
            write_csv(folder / f"{name}.{region}.csv", found)
        summary[region] = [
            {
                "k": [low, high],
                "transfer": _json(found.transfer[band]),
                "error": _json(measured.transfer_error[band]),
                "not_measured": why_not_measured(measured.transfer[band], measured.transfer_error[band]) or None,
            }
            for band, (low, high) in enumerate(pairwise(BANDS))
        ]
    save_spectrum(folder / spectrum_file(TRANSFER, "wedge"), cylindrical_transfer(injection, settings.length_bin))
    return summary


class SweepSummary(Task, stage="sweep-summary", version=3):
    """T, bias and solves of all points of a sweep, which have by label the values of the varied fields.

    The wedge buffers are in `points` as well. `measured` has T of each by label, and as ``label:name`` its score, and
    the spectra of that.
    """

    points: Mapping[str, Mapping[str, Any]]
    measured: Inputs

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write summary.csv: a row for each point, region and band of k; the bias is that outside the wedge."""
        rows: list[dict[str, Any]] = []
        for label, point in self.points.items():
            solves = in_words(read_json(self.measured[f"{label}:score"] / SCORE)["by_status"])
            for region, inside in REGIONS.items():
                path = self.measured[label] / spectrum_file(TRANSFER_BANDS, region)
                found = load_spectrum(path, TransferFunction)
                columns = {name: values(found) for name, values in TRANSFER_COLUMNS.items()}
                if not inside:
                    powers = read_calibrated({name: self.measured[f"{label}:{name}"] for name in SPECTRA})
                    score = measure(powers, BANDS, point["wedge_buffer"], found.flux_scale)
                    columns |= {"bias": score.bias, "bias error": score.bias_error}
                first = {"point": label, **point["fields"], "region": region}
                bands = zip(*(column.tolist() for column in columns.values()), strict=True)
                rows += [{**first, **dict(zip(columns, row, strict=True)), "solves": solves} for row in bands]
        Table.of_records(rows).write_csv(output / SUMMARY)
        return {}

    def _cost(self) -> Cost:
        size, points = size_of(self), len(self.points)
        held = len(SPECTRA) * 3 * size.baselines * size.channels.count * COMPLEX128
        return Cost(1 + points * (0.1 + held * 2e-9), LIBRARIES_MEMORY + held, 1e5)

    def shown(self, folder: Path) -> Sequence[Table]:
        """Return T outside the wedge, a row for each point and a column for each band."""
        points: dict[str, dict[str, str]] = {}
        with (folder / SUMMARY).open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                if row["region"] == "outside-wedge":
                    band = f"k = {float(row['k from [h/Mpc]']):g} to {float(row['k to [h/Mpc]']):g} h/Mpc"
                    free = [float(row[f"transfer without flux scale{column}"]) for column in ("", " error")]
                    given = [float(row[f"transfer{column}"]) for column in ("", " error")]
                    number = free if math.isfinite(free[0]) else given
                    cell = marked(_with_error(*number), *number) if math.isfinite(number[0]) else "-"
                    points.setdefault(row["point"], {})[band] = cell
        bands = list(dict.fromkeys(band for found in points.values() for band in found))
        rows = [(point, *(found[band] for band in bands)) for point, found in points.items()]
        note = (
            "T = P^R / P^S outside the wedge, free of the error of the flux scale where the true gains are known, one "
            "standard deviation."
        )
        return [Table(("point", *bands), rows, "Signal loss of every point", note)]


class FluxScale(Task, stage="flux-scale", version=1):
    """The flux scale of a calibration, of all polarizations and blocks, as are the spectra that it multiplies."""

    taper: str
    polarizations: int = 1
    blocks: int = 1
    even: Input
    odd: Input
    gains: Input = None

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the flux scale, null if it is not known, to scale.json."""
        even, odd = (
            np.concatenate([self._ratio(folder, polarization) for polarization in range(self.polarizations)])
            for folder in (self.even, self.odd)
        )
        scale = flux_scale(even, odd, make_taper(self.taper, even.shape[1]) ** 2)
        write_json(output / SCALE, {"flux_scale": json_number(scale)})
        return {}

    def _ratio(self, calibration: Path, polarization: int) -> np.ndarray:
        """Return true over fitted gain products of one polarization, (Nblocks Npairs, Nfreqs)."""
        from calstudy.power.average import divide
        from calstudy.products.selection import read_gains, true_of

        fitted = read_gains(calibration, polarization)
        true = true_of(self.gains, fitted, polarization)
        values = np.where(fitted.flags, np.nan, fitted.values)
        if self.blocks == 1 or fitted.times is None:
            return gain_ratio(true, values)
        blocks = divide(fitted.times, fitted.integration, self.blocks)
        return np.concatenate([gain_ratio(true[block.times], values[block.times]) for block in blocks])

    def _cost(self) -> Cost:
        return Cost(0.1 + size_of(self).samples * 6e-8, disk=1e3)


def _with_error(value: float, error: float) -> str:
    return f"{value:.3f} ± {error:.3f}" if math.isfinite(value) else "-"


def _transfer(found: TransferFunction, band: int) -> str:
    """Write T with its error, free of the flux scale if that is known, and say where it is not measured."""
    value, error = found.transfer[band], found.transfer_error[band]
    if math.isfinite(found.flux_scale):
        value, error = found.scale_free_transfer[band], found.scale_free_transfer_error[band]
    if not math.isfinite(value):
        return "not measured" if math.isfinite(found.signal[band]) else "no modes"
    return marked(_with_error(value, error), value, error)


def _json(value: float) -> float | None:
    return round(float(value), 4) if math.isfinite(value) else None


def write_corrected(folder: Path, residual: SphericalSpectrum, signal: SphericalSpectrum, reduced: bool) -> None:
    """Write the power of the residual (with errors) outside the wedge, and the same divided by T.

    T is read from `folder`, as written by `write_transfer`; `reduced` is as in `calstudy.power.transfer.correct`.
    """
    found = load_spectrum(folder / spectrum_file(TRANSFER, "outside-wedge"), TransferFunction)
    power, error = correct(residual, found, reduced)
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
