"""Calibration of measured data alone: gains, model, residual, a record of the solves and diagnostics, in one folder."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import Field
from rich.console import Console

from calstudy import __version__
from calstudy.base.errors import InputError
from calstudy.calibrate.settings import GainFit
from calstudy.experiment.model import FIGURES
from calstudy.figures import ObservedFigure, observed_task
from calstudy.products.files import GAINS, MODEL, RESIDUAL, SOLUTION, read_json
from calstudy.products.observed import DataGraph, calibrated, observed, read_part
from calstudy.products.observed_quality import QUALITY, TRANSFER, expected_transfer, quality
from calstudy.realdata.halves import WHOLE, Parts
from calstudy.run.execution import Workers
from calstudy.run.store import Store, require_writable
from calstudy.run.task import Task
from calstudy.studies.folder import LOG, log_to, publish
from calstudy.studies.observed import DataFile, DataStudy, read_selected, validated
from calstudy.studies.study import Budget, Made, make

CALFITS, FIGURE, UNFINISHED = "gains.calfits", "diagnostics", ".unfinished"
FIGURE_FILES = tuple(f"{FIGURE}.{ending}" for ending in ("npz", "pdf", "png"))


class CalibrationFile(DataFile):
    """Measured data that are calibrated as a whole, and the results that are wanted; they go to `outputs.runs`."""

    calfits: bool = Field(False, description="Also write the gains as calfits.")
    expected_loss: bool = Field(False, description="Also write the signal loss that the fit is expected to cause.")


class DataCalibration(DataStudy[CalibrationFile]):
    """The calibration of all data of a file together, in their own unit."""

    def __init__(self, file: CalibrationFile, data: Parts) -> None:
        super().__init__(file, data)
        self.graph = DataGraph(file.observed, file.calibration, data)

    @cached_property
    def published(self) -> list[Task]:
        """The products whose files are results."""
        figure = FIGURES.make(FIGURE)
        assert isinstance(figure, ObservedFigure)
        expected = [expected_transfer(self.graph, WHOLE)] if self.file.expected_loss else []
        return [calibrated(self.graph, WHOLE), observed_task(figure, self.graph, ()), *expected]

    @property
    def targets(self) -> Sequence[Task]:
        """Results, and the quality of the calibration."""
        return [*self.published, quality(self.graph)]

    def described(self) -> str:
        """Return a sentence on the data and the solves."""
        frame, details = self.frames[0], self.outline.details
        cross = frame.n_baselines - int(frame.autos.sum())
        solves = len(self.file.calibration.solves(frame.n_times)) * frame.n_polarizations
        memory = max(task.cost.memory for task in self.published[0].needs.values())
        return (
            f"{frame.n_antennas} antennas, {cross} baselines, {frame.n_channels} channels, {frame.n_times} "
            f"integrations, {frame.n_polarizations} polarizations: {solves} solves{f', {details}' if details else ''}, "
            f"about {memory / 1e9:.1f} GB"
        )

    def read(self) -> list[str]:
        """Read all input files without calibrating; return sentences on what is done to the data, and on doubts.

        Raises InputError if a file cannot be used.
        """
        from calstudy.base.gains import read_gains
        from calstudy.base.observation import Observation
        from calstudy.calibrate.amplitudes import conspicuous

        data, _, notes = read_part(observed(self.graph, WHOLE).settings)
        if self.start is not None:
            read_gains(self.start, "calibration.initial_gains.path")
        return [*notes, *conspicuous(Observation(data))]

    @property
    def start(self) -> Path | None:
        """The file of gains from which the calibration starts; None for another start."""
        gains = getattr(self.file.calibration, "initial_gains", None)
        return gains.path if gains is not None and gains.kind == "file" else None

    def run(self, console: Console) -> dict[str, Any]:
        """Calibrate, write the results to the folder, and return the content of solution.json.

        The products are kept in a hidden folder until the results are written, so that another run resumes. Raises
        InputError if a stage refuses its input, or the folder cannot be written.
        """
        store = Store(self.outputs.store)
        store.prepare()
        with log_to(store.root / LOG):
            made = make(self.targets, store, Workers(1, store.root / LOG), console)
            solution = self._write(made)
        shutil.rmtree(store.root, ignore_errors=True)
        return solution

    def _write(self, made: Made) -> dict[str, Any]:
        """Write all results or none."""
        folder = self.outputs.runs
        with tempfile.TemporaryDirectory(dir=folder, prefix=".writing-") as temporary:
            work = Path(temporary)
            publish([made.products[task.key] for task in self.published], work)
            solution = self._solution(made, read_json(work / SOLUTION))
            (work / SOLUTION).write_text(json.dumps(solution, indent=1, allow_nan=False), encoding="utf-8")
            if self.file.calfits:
                from pyuvdata import UVCal

                UVCal.from_file(work / GAINS).write_calfits(str(work / CALFITS))
            for path in work.iterdir():
                path.replace(folder / path.name)
        return solution

    def _solution(self, made: Made, solved: Mapping[str, Any]) -> dict[str, Any]:
        """Return the request, the changes of the data, what stands out, and every solve, as plain JSON types."""
        section = self.file.observed
        tasks = (observed(self.graph, WHOLE), self.published[0], quality(self.graph))
        data, fit, standing = (made.products[task.key] for task in tasks)
        found = read_json(standing.path / QUALITY)[WHOLE]
        return {
            "calstudy": __version__,
            "data": [str(path) for path in section.data],
            "sky_model": None if section.sky_model is None else str(section.sky_model),
            "gains": None if self.start is None else str(self.start),
            "selection": asdict(section.select.selection),
            "flag_interference": section.flag_interference is not None,
            "settings": self.file.calibration.model_dump(mode="json"),
            "notes": data.record["notes"]["changes"],
            "warnings": [text for product in (fit, standing) for text in product.record["notes"]["warnings"]],
            "plan": self.described(),
            "quality": found.pop("quality"),
            "chi_squared": found or None,
            "solves": len(solved["records"]),
            "by_status": solved["by_status"],
            "seconds": sum(record["seconds"] for record in solved["records"]),
            "records": solved["records"],
        }


def load_calibration(
    content: Mapping[str, Any], overrides: Sequence[str], output: Path, budget: Budget
) -> DataCalibration:
    """Validate a calibration of measured data, read their metadata, and fit it to a budget.

    The fields of `content` are those of `CalibrationFile`, but for `name` and `outputs`; `overrides` are ``path=value``
    texts. Relative paths start at the working directory, and results go to `output`. Raises InputError if the data, the
    settings or the memory cannot be used.
    """
    outputs = {"store": str(output / UNFINISHED), "runs": str(output)}
    file = validated(CalibrationFile, {"name": "calibration", **content, "outputs": outputs}, overrides, Path.cwd())
    if file.expected_loss and not isinstance(file.calibration, GainFit):
        raise InputError(f"--expected-loss: is known for fits by least squares, and {file.calibration.label} is none")
    facts = read_selected(file, file.observed.data, even=False)
    return DataCalibration(file, Parts({WHOLE: facts})).fitted(budget)[0]


def require_free(output: Path, overwrite: bool) -> None:
    """Raise InputError if a folder cannot be written, or has results of a calibration that may not be replaced."""
    if output.exists() and not output.is_dir():
        raise InputError(f"--output {output}: is a file, not a folder")
    names = (GAINS, CALFITS, MODEL, RESIDUAL, SOLUTION, *FIGURE_FILES)
    present = [name for name in names if (output / name).exists()]
    present += [path.name for path in sorted(output.glob(f"{TRANSFER}.*.h5"))]
    if present and not overwrite:
        raise InputError(f"--output {output}: holds {', '.join(present)} already; use --overwrite or another folder")
    require_writable(output.absolute(), f"--output {output}")
