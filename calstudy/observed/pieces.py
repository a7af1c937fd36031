"""Calibration in pieces of consecutive integrations, each kept in a folder, so that an interrupted one can resume."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from pyuvdata import UVCal, UVData

from calstudy import __version__
from calstudy.base.identity import digest_json
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.interface import Calibrator, Progress
from calstudy.calibrate.records import CalibrationResult, Solve
from calstudy.observed.output import writing_to
from calstudy.products.files import GAINS, MODEL, RESIDUAL

RECORDS = "records.json"


@dataclass(frozen=True)
class Given:
    """Data and sky model of a calibration, and gains to start from, of which the closest in time are taken."""

    data: UVData
    sky_model: UVData | None = None
    gains: UVCal | None = None


def pieces_folder(output: Path, paths: Sequence[Path], content: Mapping[str, Any]) -> Path:
    """Return the folder of the pieces, another one for other settings (`content`, JSON types) or changed files."""
    files = [[str(path.resolve()), path.stat().st_mtime_ns, path.stat().st_size] for path in paths]
    return output / f".unfinished-{digest_json({'version': __version__, 'files': files, **content})[:12]}"


def calibrate_in_pieces(calibrator: Calibrator, given: Given, folder: Path, progress: Progress) -> CalibrationResult:
    """Calibrate `calibrator.chunks` pieces of integrations; pieces in the folder are not made again.

    The calibrator is fitted to the memory. The caller removes the folder, which a single piece does not use. `progress`
    is called after each solve with the number done and the total.
    """
    groups = calibrator.solves(given.data.Ntimes)
    count = min(calibrator.chunks, len(groups))
    edges = np.linspace(0, len(groups), count + 1).round().astype(int)
    total, done, results = len(groups) * given.data.Npols, 0, []
    for index in range(count):
        times = slice(groups[edges[index]].start, groups[edges[index + 1] - 1].stop)
        before = done

        def show(number: int, _: int, before: int = before) -> None:
            progress(before + number, total)

        place = folder / f"piece-{index:03d}"
        found = _read(place) if count > 1 and place.is_dir() else None
        if found is None:
            data, sky = (_integrations(uvd, times) for uvd in (given.data, given.sky_model))
            assert data is not None
            found = run_calibrator(calibrator, data, sky, given.gains, show)
            if count > 1:
                _write(found, place)
        results.append(_shifted(found, times.start))
        done += (edges[index + 1] - edges[index]) * given.data.Npols
        progress(done, total)
    return _joined(results)


def _integrations(uvd: UVData | None, times: slice) -> UVData | None:
    if uvd is None or (times.start == 0 and times.stop == uvd.Ntimes):
        return uvd
    rows = np.arange(times.start * uvd.Nbls, times.stop * uvd.Nbls)
    return uvd.select(blt_inds=rows, inplace=False, run_check=False)


def _shifted(result: CalibrationResult, first: int) -> CalibrationResult:
    records = tuple(replace(record, integration=record.integration + first) for record in result.solutions)
    return replace(result, solutions=records)


def _joined(results: Sequence[CalibrationResult]) -> CalibrationResult:
    """Join pieces in time; records are ordered by polarization, then time."""
    if len(results) == 1:
        return results[0]
    (first, *others), order = results, results[0].model.polarization_array.tolist()
    records = [record for result in results for record in result.solutions]
    records.sort(key=lambda record: (order.index(record.polarization), record.integration))
    return CalibrationResult(
        first.gains.fast_concat([result.gains for result in others], "time", inplace=False),
        first.model.fast_concat([result.model for result in others], "blt", inplace=False),
        first.residual.fast_concat([result.residual for result in others], "blt", inplace=False),
        tuple(records),
    )


def _write(result: CalibrationResult, place: Path) -> None:
    """Write a piece completely or not at all."""
    work = place.with_name(f".writing-{uuid4().hex}")
    try:
        with writing_to(work):
            result.gains.write_calh5(str(work / GAINS))
            for name, uvd in ((MODEL, result.model), (RESIDUAL, result.residual)):
                uvd.write_uvh5(str(work / name), data_write_dtype=np.dtype(np.complex128))
            records = [record.detail() for record in result.solutions]
            (work / RECORDS).write_text(json.dumps(records, allow_nan=False), encoding="utf-8")
            work.rename(place)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _read(place: Path) -> CalibrationResult | None:
    """Return a piece, or None if its files cannot be read."""
    try:
        model, residual = (
            UVData.from_file(place / name, file_type="uvh5", run_check=False) for name in (MODEL, RESIDUAL)
        )
        gains = UVCal.from_file(place / GAINS, file_type="calh5", run_check=False)
        records = json.loads((place / RECORDS).read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError):
        return None
    return CalibrationResult(gains, model, residual, tuple(map(Solve.from_json, records)))
