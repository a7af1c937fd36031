"""Calibration of measured data: what all studies of such data have, and the study that calibrates and no more."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeVar

import numpy as np
from filelock import FileLock, Timeout
from pydantic import Field, SerializeAsAny, model_validator
from rich.console import Console

from calstudy import __version__
from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.errors import InputError
from calstudy.base.gain_files import read_gains, write_gains
from calstudy.base.gains import closest_solutions, gain_products, solutions
from calstudy.base.observation import Frame, Observation
from calstudy.base.paths import leaves
from calstudy.base.plugins import guarded
from calstudy.base.schema import Section, fault
from calstudy.base.visibilities import antenna_pairs, flag_cube
from calstudy.calibrate.calibrators.given_gains import ByFile
from calstudy.calibrate.execution import require_calibratable
from calstudy.calibrate.interface import CALIBRATORS, Calibrator, SolvePlan
from calstudy.calibrate.problem import fitted_baselines
from calstudy.calibrate.settings import GainFit, WeightedFit
from calstudy.experiment.files import StudyFile, apply_scale, checked
from calstudy.experiment.model import FIGURES, Figures, Folders, StudyName
from calstudy.figures import figure_task
from calstudy.products.files import (
    GAINS,
    MODEL,
    RESIDUAL,
    SOLUTION,
    read_json,
    read_visibilities,
    write_visibilities,
)
from calstudy.products.gain_errors import ERRORS, observed_gain_errors
from calstudy.products.graph import MeasuredGraph
from calstudy.products.observed import calibrated, observed
from calstudy.products.observed_injection import EXPECTED_TRANSFER, expected_transfer
from calstudy.products.observed_results import QUALITY, quality
from calstudy.realdata.halves import WHOLE, Facts, Parts, modelled, read_facts
from calstudy.realdata.interference import require_surroundings
from calstudy.realdata.settings import DataSettings, with_defaults
from calstudy.run.execution import Budget, Workers
from calstudy.run.store import Store, require_writable
from calstudy.run.task import Task
from calstudy.studies.capacity import fit
from calstudy.studies.folder import LOG, log_to, publish
from calstudy.studies.study import RunProducts, Study, make

if TYPE_CHECKING:
    from pyuvdata import UVCal

FIGURE, UNFINISHED, IN_USE = "diagnostics", ".unfinished", ".calibrating"
GainFormat = Literal["calfits", "h5parm", "hyperdrive", "mwaocal"]
SUFFIXES = {"calfits": ".calfits", "h5parm": ".h5", "hyperdrive": ".fits", "mwaocal": ".bin"}
CALFITS_TOLERANCE = 1e-3
"""Distances of times (s) and of channels (Hz) that differ by more are not equal, as pyuvdata has it."""
LINEAR = {-5, -6}
"""Polarizations xx and yy, as pyuvdata numbers them."""
FIGURE_FILES = tuple(f"{FIGURE}.{ending}" for ending in ("npz", "pdf", "png"))


class ObservedOutputs(Folders):
    """Figures, and the folders of products and runs."""

    figures: Figures | None = Field(None, description="Figures of measured data; null: all.")


class DataFile(Section):
    """Measured data and their calibration."""

    name: StudyName
    description: str = ""
    observed: DataSettings
    calibration: Annotated[SerializeAsAny[Calibrator], CALIBRATORS.field("calamity")] = Field(
        default_factory=lambda: CALIBRATORS.make("calamity"),
        description="As in an experiment. Without `solver`, Gauss-Newton steps go on longer, for data of few baselines "
        "converge slowly; without `prior` and sky model, the size of the gains fixes the scale.",
    )
    outputs: ObservedOutputs = Field(default_factory=ObservedOutputs)

    @model_validator(mode="after")
    def _calibration_is_of_measured_data(self) -> Self:
        if self.calibration.assumed:
            raise fault("calibration.assumed", "is for simulated data; give the sky model as observed.sky_model")
        if getattr(self.calibration, "boards", None) is not None:
            raise fault("calibration.boards", "is for simulated data so far; correct losses of measured data before")
        if isinstance(self.calibration, ByFile) and self.calibration.folder is not None:
            raise fault("calibration.folder", "is for simulated data; give gains of measured data as calibration.gains")
        return self


File = TypeVar("File", bound=DataFile)


def read_file(model: type[File], file: StudyFile) -> File:
    """Return the content of a file of measured data, with the defaults for such data; errors as for `checked`."""
    content = with_defaults(apply_scale(file.content, file.scale), file.changed(), file.folder)
    changed = replace(file, content=content, scale=None).changed()
    return checked(model, changed, file.folder)


def read_selected(file: DataFile, files: tuple[Path, ...], even: bool = True) -> Facts:
    """Read the metadata of the selected data; raises InputError as `read_facts`, or if the noise is not known."""
    section = file.observed
    try:
        facts = read_facts(files, section.select.selection, section.positions, even)
    except InputError as error:
        raise InputError(str(error).replace("--select ", "observed.select.")) from None
    if file.calibration.needs_noise and not facts.autos:
        raise InputError(
            "calibration.foreground_prior.noise: must be given, for the data have no autocorrelations that tell it"
        )
    return facts


class DataStudy(Study):
    """A study of measured data, from its file and the metadata of their parts."""

    def __init__(self, file: Any, data: Parts) -> None:
        self.file, self.data = file, data
        self.graph = MeasuredGraph(file, data)

    @cached_property
    def frames(self) -> list[Frame]:
        """Antennas, baselines and channels of the data that are calibrated, of each data set."""
        path = self.file.observed.sky_model
        frames = list({id(facts): facts.frame for facts in self.data.facts.values()}.values())
        return frames if path is None else [modelled(frame, path) for frame in frames]

    @cached_property
    def solve_plan(self) -> SolvePlan:
        """Properties of the calibration that are known before it starts."""
        with guarded(self.file.calibration):
            return self.file.calibration.plan(self.frames[0])

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of the calibrator on settings that will not work well, and on integrations that are days apart."""
        gap = max(np.diff(np.sort(facts.times)).max(initial=0.0) for facts in self.data.facts.values())
        apart = f"observed.data: integrations are up to {gap:.3g} days apart, and are treated as one run"
        return (*self.solve_plan.notes, *([apart] if gap >= 1 else []))

    def sized_to(self, budget: Budget) -> tuple[Self, int]:
        """Return the study fitted to a budget, and the number of workers; raises InputError for unusable data."""
        if self.file.observed.flag_interference is not None:
            for facts in self.data.facts.values():
                require_surroundings(facts.times.size, facts.frequencies.size)
        for frame in self.frames:
            require_calibratable(self.file.calibration, frame, self.file.observed.sky_model is not None)
        file, workers = fit(self.file, budget, lambda file: type(self)(file, self.data).targets)
        return type(self)(file, self.data), workers


class CalibrationFile(DataFile):
    """Measured data that are calibrated as a whole, and the results that are wanted; they go to `outputs.runs`."""

    also: tuple[GainFormat, ...] = Field(
        (),
        description="Also write the gains as calfits, H5Parm, FITS of hyperdrive, or `.bin` of calibrate (mwaocal).",
    )
    gain_errors: bool | Annotated[int, Field(ge=2)] = Field(
        True,
        description="Give gains their errors by noise. A number: where a fit has none of its own, find them by so many "
        "more calibrations, of realizations of the noise; they are known to one over the root of twice their number.",
    )
    expected_loss: bool = Field(False, description="Also write the signal loss that the fit is expected to cause.")


class DataCalibration(DataStudy):
    """The calibration of all data together, in their own unit."""

    @classmethod
    def load(cls, file: StudyFile) -> DataCalibration:
        """Return the calibration of a file, with the metadata of its data."""
        content = read_file(CalibrationFile, file)
        fit = content.calibration
        if content.expected_loss:
            if not isinstance(fit, GainFit):
                raise InputError(f"expected_loss: is known for fits by least squares, and {fit.label} is none")
            if field := fit.not_in_expected_loss:
                raise InputError(
                    f"expected_loss: lacks the effect of calibration.{field} on the residual; leave out one of the two"
                )
        facts = read_selected(content, content.observed.data, even=False)
        if {"hyperdrive", "mwaocal"} & set(content.also) and set(facts.polarizations) != LINEAR:
            raise InputError(
                "also: hyperdrive and mwaocal hold gains of xx and yy, which the data do not both have; take calfits "
                "or h5parm"
            )
        if "calfits" in content.also:
            for what, values in (("integrations", facts.times * SECONDS_PER_DAY), ("channels", facts.frequencies)):
                if values.size > 2 and np.ptp(np.diff(values)) > CALFITS_TOLERANCE:
                    raise InputError(
                        f"also: calfits holds gains at equal distances, and the {what} of the data have gaps; take "
                        f"h5parm, or {GAINS} alone"
                    )
        found = cls(content, Parts({WHOLE: facts}))
        found._require_kept_inputs()
        return found

    @property
    def _inputs(self) -> set[Path]:
        """The files that are read, with their links resolved."""
        section = self.file.observed
        named = (value for _, value in leaves(self.file.calibration.model_dump()) if isinstance(value, Path))
        return {path.resolve() for path in (*section.data, section.sky_model, *named) if path is not None}

    def _require_kept_inputs(self) -> None:
        """Raise InputError if a result would replace a file that is read."""
        also = (Path(GAINS).with_suffix(SUFFIXES[kind]).name for kind in self.file.also)
        for name in (GAINS, MODEL, RESIDUAL, SOLUTION, *also):
            if self.outputs.runs.resolve() / name in self._inputs:
                raise InputError(
                    f"output = {self.outputs.runs}: {name} in it is an input, and a result would replace it; choose "
                    "another folder"
                )

    @property
    def content(self) -> Any:
        """Nothing: results go to the folder of the user's choice."""
        return None

    @cached_property
    def figures(self) -> list[Task]:
        """The diagnostics."""
        figure = FIGURES.make({"kind": FIGURE, "gain_errors": self.file.gain_errors})
        return [figure_task(figure, {"": self.graph}, (), {})]

    @cached_property
    def tables(self) -> list[Task]:
        """The calibration, its gains again with their errors, its quality, and the signal loss, as far as wanted."""
        expected = [expected_transfer(self.graph, WHOLE)] if self.file.expected_loss else []
        wanted = self.file.gain_errors
        errors = [observed_gain_errors(self.graph, WHOLE, wanted)] if wanted else []
        return [calibrated(self.graph, WHOLE), *errors, quality(self.graph), *expected]

    def described(self) -> str:
        """Return a sentence on the data and the solves."""
        frame, details = self.frames[0], self.solve_plan.details
        cross = frame.n_baselines - int(frame.autos.sum())
        solves = len(self.file.calibration.solves(frame.n_times)) * frame.n_polarizations
        memory = max(task.cost.memory for task in self.tables[0].needs.values())
        return (
            f"{frame.n_antennas} antennas, {cross} baselines, {frame.n_channels} channels, {frame.n_times} "
            f"integrations, {frame.n_polarizations} polarizations: {solves} solves{f', {details}' if details else ''}, "
            f"about {memory / 1e9:.1f} GB"
        )

    def read(self) -> list[str]:
        """Read all input files without calibrating; return sentences on what is done to the data, and on doubts.

        Raises InputError if a file cannot be used.
        """
        from calstudy.calibrate.preparation import starting_gains
        from calstudy.calibrate.weights import conspicuous, make_weights

        data, _, notes = observed(self.graph, WHOLE).read()
        observation, calibrator = Observation(data), self.file.calibration
        doubts = conspicuous(observation, calibrator)
        if isinstance(calibrator, WeightedFit):
            fitted = fitted_baselines(observation, getattr(calibrator, "autos", False))
            if not make_weights(observation, fitted, calibrator.weights).any():
                kind = calibrator.weights.kind
                doubts.append(f"Every sample is flagged or has no weight by weights: {kind}; no solve will give gains.")
            if self.start is not None:
                gains = read_gains(self.start, "calibration.initial_gains.path", data)
                starting_gains(observation.baselines(fitted), gains)
                doubts += self._without_start(gains)
        return [*notes, *doubts]

    def _without_start(self, gains: UVCal) -> list[str]:
        """Return a sentence if the data have antennas, channels or single samples without a gain to start from."""
        facts, frame = self.data.facts[WHOLE], self.frames[0]
        numbers = frame.numbers[np.unique(frame.antennas[~frame.autos])]
        known = np.isin(numbers, gains.ant_array)
        times = closest_solutions(gains, facts.times)
        values, flags = solutions(gains, numbers[known], facts.frequencies, np.array(facts.polarizations))
        unknown = np.ones((numbers.size, *values.shape[1:]), bool)
        unknown[known] = flags | ~np.isfinite(values) | (values == 0)
        unknown = unknown[:, :, times]
        antennas = unknown.all(axis=(1, 2, 3))
        channels = unknown[~antennas].all(axis=(0, 2, 3))
        samples = unknown[~antennas][:, ~channels]
        counts = {"antennas": antennas, "channels": channels, "other gains": samples}
        found = [f"{of.sum()} of {of.size} {name}" for name, of in counts.items() if of.any()]
        return [f"No gains to start from are known for {', '.join(found)}; these start from unity."] if found else []

    @property
    def start(self) -> Path | None:
        """The file of gains from which the calibration starts; None for another start."""
        gains = getattr(self.file.calibration, "initial_gains", None)
        return gains.path if gains is not None and gains.kind == "file" else None

    def run(self, console: Console) -> dict[str, Any]:
        """Calibrate, write the results to the folder, and return the content of solution.json.

        The products are kept in a hidden folder until the results are written, so that another run resumes.
        """
        store = Store(self.outputs.store)
        store.prepare()
        with _alone(self.outputs.runs):
            with log_to(store.root / LOG):
                made = make(self.targets, store, Workers(1, store.root / LOG), console)
                solution = self._write(made)
            shutil.rmtree(store.root, ignore_errors=True)
        return solution

    def _write(self, made: RunProducts) -> dict[str, Any]:
        """Write all results or none."""
        from pyuvdata import UVCal

        folder = self.outputs.runs
        with tempfile.TemporaryDirectory(dir=folder, prefix=".writing-") as temporary:
            work = Path(temporary)
            publish([made.products[task.key] for task in self.targets], work)
            solution = self._solution(made, read_json(work / SOLUTION), read_json(work / QUALITY)[WHOLE])
            if self.start is not None:
                # A file that was removed since does not cost the results.
                with suppress(InputError):
                    gains = read_gains(self.start, "calibration.initial_gains.path", UVCal.from_file(work / GAINS))
                    solution["notes"] += self._without_start(gains)
            if self.file.gain_errors:
                for record, found in zip(solution["records"], read_json(work / ERRORS)["records"], strict=True):
                    record["gain_errors"] = found
            for name in (QUALITY, ERRORS):
                (work / name).unlink(missing_ok=True)
            if any(record.get("gain_errors", {}).get("lost_antennas") for record in solution["records"]):
                flag_unsolved(work)
            (work / SOLUTION).write_text(json.dumps(solution, indent=1, allow_nan=False), encoding="utf-8")
            for kind in self.file.also:
                gains, path = UVCal.from_file(work / GAINS), (work / GAINS).with_suffix(SUFFIXES[kind])
                if kind == "calfits":
                    gains.write_calfits(str(path))
                else:
                    write_gains(gains, path)
            self._remove_earlier(folder, {path.name for path in work.iterdir()})
            for path in work.iterdir():
                path.replace(folder / path.name)
        return solution

    def _remove_earlier(self, folder: Path, written: Container[str]) -> None:
        """Remove results of an earlier calibration that this one does not replace, but for files that it reads."""
        if not (folder / SOLUTION).exists():
            return
        for path in (folder / name for name in results_in(folder)):
            if path.name not in written and path.resolve() not in self._inputs:
                path.unlink()

    def _solution(self, made: RunProducts, solved: Mapping[str, Any], found: dict[str, Any]) -> dict[str, Any]:
        """Return the request, the changes of the data, what stands out, and every solve, as plain JSON types."""
        section = self.file.observed
        tasks = (observed(self.graph, WHOLE), *self.tables)
        notes = [made.products[task.key].record["notes"] for task in tasks]
        return {
            "calstudy": __version__,
            "data": [str(path) for path in section.data],
            "sky_model": None if section.sky_model is None else str(section.sky_model),
            "gains": None if self.start is None else str(self.start),
            "selection": asdict(section.select.selection),
            "flag_interference": section.flag_interference is not None,
            "settings": self.file.calibration.model_dump(mode="json"),
            "notes": notes[0]["changes"],
            "warnings": [text for note in notes for text in note.get("warnings", ())],
            "plan": self.described(),
            "quality": found.pop("quality"),
            "chi_squared": found or None,
            "solves": len(solved["records"]),
            "by_status": solved["by_status"],
            "seconds": sum(record["seconds"] for record in solved["records"]),
            "records": solved["records"],
        }


def flag_unsolved(folder: Path) -> None:
    """Flag model and residual in a folder where its gains are flagged."""
    from pyuvdata import UVCal

    gains = UVCal.from_file(folder / GAINS)
    for name in (MODEL, RESIDUAL):
        data = read_visibilities(folder / name)
        flag_cube(data)[gain_products(gains, antenna_pairs(data))[1]] = True
        if name == RESIDUAL:
            data.data_array[data.flag_array] = 0
        (folder / name).unlink()
        write_visibilities(data, folder / name, single=True)


def calibration_file(sections: Mapping[str, Any], output: Path, overrides: Sequence[str] = ()) -> StudyFile:
    """Return the content of a `CalibrationFile` for a folder of results; paths start at the working directory."""
    outputs = {"store": str(output / UNFINISHED), "runs": str(output)}
    content = {"name": "calibration", **sections, "outputs": outputs}
    return StudyFile(Path("calibration.yaml"), content, overrides=list(overrides))


def require_free(output: Path, overwrite: bool) -> None:
    """Raise InputError if a folder cannot be written, or has results of a calibration that may not be replaced."""
    if (present := results_in(output)) and not overwrite:
        raise InputError(f"output = {output}: holds {', '.join(present)} already; use `overwrite` or another folder")
    require_writable(output.absolute(), f"output = {output}")


def results_in(folder: Path) -> list[str]:
    """Return the names of the results of a calibration that are in a folder."""
    gains = (str(Path(GAINS).with_suffix(suffix)) for suffix in SUFFIXES.values())
    names = (GAINS, *gains, MODEL, RESIDUAL, SOLUTION, *FIGURE_FILES)
    found = [name for name in names if (folder / name).exists()]
    return found + [path.name for path in sorted(folder.glob(f"{EXPECTED_TRANSFER}.*.h5"))]


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold a folder of results within the block; raises InputError if another calibration does."""
    path = folder / IN_USE
    lock = FileLock(path, fallback_to_soft=False)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise InputError(
            f"output = {folder}: another calibration writes to it; wait for its end, or take another folder"
        ) from None
    except OSError as error:
        raise InputError(f"output = {folder}: cannot be locked ({error.strerror}); take another folder") from None
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        lock.release()
