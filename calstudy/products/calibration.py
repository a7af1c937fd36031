"""The calibration under test: gains, foreground models and residuals, solved in runs of consecutive integrations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from shutil import copyfile
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from calstudy.base.observation import Observation
from calstudy.base.resources import COMPLEX64, COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.calibrate.execution import cost_of, run_calibrator
from calstudy.calibrate.interface import Assumed, Calibrator
from calstudy.calibrate.records import SETTLED, USABLE, CalibrationResult, Solve
from calstudy.calibrate.sky_model import common_baselines
from calstudy.experiment.model import Variant
from calstudy.products import corruption, sky_model
from calstudy.products.corruption import read_noise
from calstudy.products.files import (
    DATA,
    GAINS,
    MODEL,
    RESIDUAL,
    SOLUTION,
    VISIBILITIES,
    integration_times,
    read_json,
    read_visibilities,
    write_json,
    write_visibilities,
)
from calstudy.products.graph import Graph, memoize, size_of
from calstudy.run.task import Input, Task

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.calibrate.preparation import PreparedFit
    from calstudy.calibrate.settings import GainFit


@memoize
def calibration(graph: Graph, variant: Variant, parity: str) -> Task:
    """Return the task of the calibration of one noise realization ("even" or "odd") of a variant."""
    return calibration_of(graph, calibration_inputs(graph, variant, parity))


def calibration_inputs(graph: Graph, variant: Variant, parity: str) -> dict[str, Task | None]:
    """Return the inputs of the calibration of one noise realization ("even" or "odd") of a variant."""
    calibrator = graph.experiment.calibration
    return {
        "data": corruption.data(graph, variant, parity),
        "sky_model": sky_model.sky_model(graph),
        "levels": corruption.noise_level(graph, variant) if calibrator.needs_noise else None,
        "autocorrelations": corruption.autocorrelations(graph, variant, parity) if calibrator.needs_autos else None,
    }


def solved(graph: Graph, variant: Variant, parity: str) -> dict[str, Any]:
    """Return the fields of what is made of the calibration of one noise realization ("even" or "odd") of a variant."""
    return {
        "calibration": calibration(graph, variant, parity),
        "calibrator": graph.experiment.calibration.with_defaults("assumed"),
        **calibration_inputs(graph, variant, parity),
    }


def calibration_of(graph: Graph, inputs: Mapping[str, Task | None], measured: bool = False) -> Task:
    """Return the task of the calibration of any data by the calibrator of a study, with the inputs of `Calibrated`."""
    data, sky = cast(Task, inputs["data"]), inputs["sky_model"]
    # The assumed world enters only through the sky model, which is an input.
    settings = graph.experiment.calibration.for_data(data.key, sky.key if sky else None).with_defaults("assumed")
    solves = -(-size_of(data).times // settings.integrations_per_solve)
    # Gains smoothed in time need all integrations.
    together = settings.smooth_gains is not None and settings.smooth_gains.over_time
    count = 1 if together else min(settings.chunks, solves)
    chunks = (
        CalibrateChunk(
            f"{data.label} {index + 1}/{count}",
            calibration=settings,
            index=index,
            count=count,
            temporary=True,
            **inputs,
        )
        for index in range(count)
    )
    return Calibrate(data.label, chunk=tuple(chunks), measured=measured, temporary=not graph.keep_visibilities)


def _times_of_chunk(path: Path, index: int, count: int, together: int) -> np.ndarray:
    """Return the times of run `index` of `count` runs of consecutive integrations, which are as equal as possible.

    A run ends at the end of a group of integrations that are solved `together`.
    """
    times = integration_times(path)
    together = min(together, times.size)
    groups = -(-times.size // together)
    edges = np.linspace(0, groups, count + 1).round().astype(int) * together
    return times[edges[index] : edges[index + 1]]


def with_autocorrelations(data: UVData, autos: UVData) -> UVData:
    """Return data with the autocorrelations of each integration after all other baselines."""
    joined = data.fast_concat([autos], "blt", inplace=False)
    rows = [np.arange(uvd.Nblts).reshape(uvd.Ntimes, uvd.Nbls) for uvd in (data, autos)]
    joined.reorder_blts(order=np.hstack([rows[0], data.Nblts + rows[1]]).ravel(), run_check=False)
    return joined


def prepared_fit(calibrator: GainFit, data: UVData, sky: UVData | None, noise: float | None) -> PreparedFit:
    """Return the fit of data with a sky model and the level of the noise, if they are known."""
    from calstudy.calibrate.preparation import prepare

    assumed = Assumed(None if sky is None else Observation(sky), noise=noise)
    return prepare(Observation(data), calibrator, assumed)


def read_result(folder: Path) -> CalibrationResult:
    """Read a product of stage `calibrate`."""
    from pyuvdata import UVCal

    model, residual = (read_visibilities(folder / name) for name in (MODEL, RESIDUAL))
    records = tuple(map(Solve.from_json, read_json(folder / SOLUTION)["records"]))
    return CalibrationResult(gains=UVCal.from_file(folder / GAINS), model=model, residual=residual, solutions=records)


class Calibrated(Task):
    """What is made of data that are calibrated.

    There may be a sky model, the level of the noise if the calibrator needs it, and the autocorrelations if it needs
    them and the data have none.
    """

    data: Input
    sky_model: Input = None
    levels: Input = None
    autocorrelations: Input = None

    def read(self, times: np.ndarray | None = None) -> tuple[UVData, UVData | None, float | None]:
        """Read data, sky model and noise level at some integrations (JD), by default all; None for what is lacking."""
        data = read_visibilities(self.data / DATA, times)
        sky = None if self.sky_model is None else read_visibilities(self.sky_model / VISIBILITIES, times)
        if self.autocorrelations is not None:
            data = with_autocorrelations(data, read_visibilities(self.autocorrelations / DATA, times))
            if sky is not None:
                sky, data, _ = common_baselines(sky, data, autos=False)
        return data, sky, None if self.levels is None else read_noise(self.levels)


class CalibrateChunk(Calibrated, stage="calibrate-chunk", version=6):
    """The calibration of a run of consecutive integrations."""

    calibration: Calibrator
    index: int
    count: int

    def make(self, output: Path) -> Mapping[str, Any]:
        """Calibrate, and write gains, model, residual and the records of the solves."""
        from calstudy.calibrate.weights import conspicuous

        together = self.calibration.integrations_per_solve
        times = _times_of_chunk(self.data / DATA, self.index, self.count, together)
        data, sky, noise = self.read(times)
        remarks = conspicuous(Observation(data), self.calibration)
        result = run_calibrator(self.calibration, data, sky, noise=noise)
        result.gains.write_calh5(output / GAINS)
        for name, uvd in ((MODEL, result.model), (RESIDUAL, result.residual)):
            write_visibilities(uvd, output / name, single=True)
        summary = result.summary()
        write_json(output / SOLUTION, {**summary, "remarks": remarks})
        return {"by_status": summary["by_status"]}

    def _cost(self) -> Cost:
        size, pieces = size_of(self), self.count
        solves = cost_of(self.calibration, replace(size, times=-(-size.times // pieces)))
        # Data and sky model, with flags and sample counts, and results.
        files = (COMPLEX64 + COMPLEX128 + 10 + 8 * COMPLEX128) * size.samples / pieces
        return Cost(solves.seconds, solves.memory + files, 2 * size.samples * COMPLEX64 / pieces)


class Calibrate(Task, stage="calibrate", version=2):
    """The calibration of all integrations."""

    chunk: tuple[Input, ...]
    measured: bool = False

    def make(self, output: Path) -> Mapping[str, Any]:
        """Join the runs of integrations into one set of gains, model, residual and records of solves."""
        from pyuvdata import UVCal

        gains = UVCal.from_file([str(folder / GAINS) for folder in self.chunk], axis="time")
        if len(self.chunk) == 1:
            for name in (GAINS, MODEL, RESIDUAL):
                copyfile(self.chunk[0] / name, output / name)
        else:
            gains.write_calh5(output / GAINS)
            for name in (MODEL, RESIDUAL):
                first, *others = (read_visibilities(folder / name) for folder in self.chunk)
                write_visibilities(first.fast_concat(others, "blt", inplace=False), output / name, single=True)
        solutions = [read_json(folder / SOLUTION) for folder in self.chunk]
        records = [record for solution in solutions for record in solution["records"]]
        remarks = list(dict.fromkeys(text for solution in solutions for text in solution.get("remarks", [])))
        records.sort(key=lambda record: (record["polarization"], record["time"]))
        by_status = dict(sorted(Counter(record["status"] for record in records).items()))
        for record in records:
            record["integration"] = int(np.abs(gains.time_array - record["time"]).argmin())
        write_json(output / SOLUTION, {"by_status": by_status, "records": records})
        seconds = [record["seconds"] for record in records]
        steps = [record["n_steps"] for record in records if record["n_steps"] is not None]
        return {
            "by_status": by_status,
            **({"median_steps": float(np.median(steps))} if steps else {}),
            "median_seconds_per_solve": float(np.median(seconds)),
            "warnings": remarks + _warnings(by_status, records, self.measured),
        }

    def _cost(self) -> Cost:
        disk = 2 * size_of(self).samples * COMPLEX64
        return Cost(0.2 + disk * 6e-9, LIBRARIES_MEMORY + 3 * disk, disk)


def _warnings(by_status: Mapping[str, int], records: list[Mapping[str, Any]], measured: bool) -> list[str]:
    unconverged = [record for record in records if record["status"] not in SETTLED]
    if not unconverged:
        return []
    example = unconverged[0]
    lost = sum(record["status"] not in USABLE for record in records) / len(records)
    sentences = []
    if "stalled" in by_status:
        sentences.append(
            "where solves stall, results depend on where they start: neither gains nor T are determined better than by "
            "the spread of two starts, such as with another 'calibration.chunks'; T of the linear response does not "
            "depend on them"
        )
    if 0 < lost < 1:
        sentences.append(
            f"{100 * lost:.2g} % of the solves gave no gains, and their samples are lost"
            # Measured noise is that of the difference of the halves, which lack the samples as well.
            + ("" if measured else "; errors of spectra by noise count them, and are too small by as much")
        )
    sentences.append(
        f"{len(unconverged)} of {len(records)} solves did not converge ({in_words(by_status)}); integration "
        f"{example['integration']}: {example['message']}"
    )
    return sentences


def in_words(by_status: Mapping[str, int]) -> str:
    """Return numbers of solves by status in words."""
    return ", ".join(f"{count} {status}" for status, count in by_status.items())
