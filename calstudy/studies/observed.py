"""Measured data as a study: calibration, power spectra of data and residual, and signal loss of an injected EoR."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Generic, Self, TypeVar

import yaml
from pydantic import Field, SerializeAsAny, ValidationError, model_validator

from calstudy.base.errors import ExperimentError, InputError, nearest
from calstudy.base.identity import identity
from calstudy.base.observation import Frame
from calstudy.base.plugins import Plugin, guarded
from calstudy.base.schema import Section, fault
from calstudy.calibrate.calibrators.by_file import ByFile
from calstudy.calibrate.calibrators.calamity import Calamity
from calstudy.calibrate.execution import require_calibratable
from calstudy.calibrate.interface import CALIBRATORS, Calibrator, Outline
from calstudy.experiment.files import apply_scale, input_files, override, parse_override
from calstudy.experiment.messages import sentences
from calstudy.experiment.model import FIGURES, StudyName
from calstudy.figures import ObservedFigure, observed_task
from calstudy.instrument.interface import model_of
from calstudy.power.settings import PowerSettings
from calstudy.products.observed import ObservedGraph
from calstudy.products.observed_injection import injection_tables
from calstudy.products.observed_quality import quality
from calstudy.products.observed_spectra import observed_spectra
from calstudy.realdata.halves import PARITIES, Facts, Parts, modelled, read_facts, require_same_sky
from calstudy.realdata.interference import require_surroundings
from calstudy.realdata.settings import DataSettings, InjectionSettings, ObservedSettings, with_defaults
from calstudy.run.task import Task
from calstudy.studies.capacity import fit
from calstudy.studies.folder import EXPERIMENT, product_entries, publish, run_folder, write, write_manifest
from calstudy.studies.study import Budget, Made, Study

KEY = "observed"
"""Key that marks a file of measured data."""
DEFAULT_FIGURES = ("diagnostics", "observed-wedge", "observed-spherical")
INJECTION_FIGURES = ("observed-signal-loss",)


class ObservedOutputs(Section):
    """Figures, and the folders of products and runs."""

    figures: Annotated[tuple[Annotated[SerializeAsAny[Plugin], FIGURES.field()], ...], Field(strict=False)] | None = (
        Field(None, description="Figures of measured data; null: all.")
    )
    store: Path = Field(Path("store"), strict=False, description="Folder of products, shared by all experiments.")
    runs: Path = Field(Path("runs"), strict=False, description="Folder in which each run gets its own folder.")


class DataFile(Section):
    """Measured data and their calibration."""

    name: StudyName
    description: str = ""
    observed: DataSettings
    calibration: Annotated[SerializeAsAny[Calibrator], CALIBRATORS.field("calamity")] = Field(
        default_factory=Calamity,
        description="As in an experiment. Without `solver`, Gauss-Newton steps go on longer, for data of few baselines "
        "converge slowly; without `prior` and sky model, the size of the gains fixes the scale.",
    )
    outputs: ObservedOutputs = Field(default_factory=ObservedOutputs)

    @model_validator(mode="after")
    def _calibration_is_of_measured_data(self) -> Self:
        if self.calibration.assumed:
            raise fault("calibration.assumed", "is for simulated data; give the sky model as observed.sky_model")
        if isinstance(self.calibration, ByFile) and self.calibration.folder is not None:
            raise fault("calibration.folder", "is for simulated data; give gains of measured data as calibration.gains")
        return self


class ObservedFile(DataFile):
    """Measured data: their selection, calibration and power spectra, and an injected signal."""

    observed: ObservedSettings
    power: PowerSettings = PowerSettings()
    injection: InjectionSettings | None = Field(None, description="Measure what the calibration loses; null: do not.")
    scales: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="Named sets of overrides (dotted path: value), chosen with --scale."
    )


File = TypeVar("File", bound=DataFile)


class DataStudy(ABC, Generic[File]):
    """A study of measured data, from its file and the metadata of their parts."""

    def __init__(self, file: File, data: Parts) -> None:
        self.file, self.data = file, data
        self.name, self.description = file.name, file.description

    @property
    def outputs(self) -> ObservedOutputs:
        """Store and folder of runs."""
        return self.file.outputs

    @property
    @abstractmethod
    def targets(self) -> Sequence[Task]:
        """Products that a run makes for its user."""

    @cached_property
    def frames(self) -> list[Frame]:
        """Antennas, baselines and channels of the data that are calibrated, of each data set."""
        path = self.file.observed.sky_model
        frames = list({id(facts): facts.frame for facts in self.data.facts.values()}.values())
        return frames if path is None else [modelled(frame, path) for frame in frames]

    @cached_property
    def outline(self) -> Outline:
        """Properties of the calibration that are known before it starts."""
        with guarded(self.file.calibration):
            return self.file.calibration.outline(self.frames[0])

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of the calibrator on settings that will not work well."""
        return self.outline.notes

    def fitted(self, budget: Budget) -> tuple[Self, int]:
        """Return the study fitted to a budget, and the number of workers.

        Raises InputError if the memory is too small, the calibrator refuses the data, or they are too few for a search
        for interference.
        """
        if self.file.observed.flag_interference is not None:
            for facts in self.data.facts.values():
                require_surroundings(facts.times.size, facts.frequencies.size)
        for frame in self.frames:
            require_calibratable(self.file.calibration, frame, self.file.observed.sky_model is not None)
        file, workers = fit(self.file, budget, lambda file: type(self)(file, self.data).targets)
        return type(self)(file, self.data), workers


class ObservedStudy(DataStudy[ObservedFile], Study):
    """A study of measured data, from its file and the metadata of the two halves."""

    def __init__(self, file: ObservedFile, data: Parts) -> None:
        super().__init__(file, data)
        self.graph = ObservedGraph(file.observed, file.calibration, file.power, file.injection, data)

    @property
    def stand_ins(self) -> tuple[str, ...]:
        """Assumptions about the units of the power spectra."""
        scale = self.file.observed.flux_scale
        if scale is None or scale.kind == "factor":
            return ()
        return ("flux scale: autocorrelations at an assumed system temperature",)

    @property
    def folder(self) -> Path:
        """The run folder: the name, and a digest of the content of the file without output paths."""
        outputs = self.file.outputs.reset("store", "runs")
        return run_folder(
            self.outputs.runs, self.name, identity(self.file.model_copy(update={"outputs": outputs}).reset("scales"))
        )

    def fitted(self, budget: Budget) -> tuple[Self, int]:
        """Return the study fitted to a budget, and the number of workers; also refuse a beam that cannot be made."""
        beam = self.file.observed.beam
        with guarded(beam):
            model_of(beam).require_usable(self.data.facts["even"].channels)
        return super().fitted(budget)

    @cached_property
    def shown(self) -> list[ObservedFigure]:
        """The requested figures."""
        figures = self.file.outputs.figures
        if figures is None:
            names = DEFAULT_FIGURES + (INJECTION_FIGURES if self.file.injection else ())
            figures = tuple(FIGURES.make(name) for name in names)
        return [figure for figure in figures if isinstance(figure, ObservedFigure)]

    @cached_property
    def figures(self) -> list[Task]:
        """Tasks of the figures."""
        return [observed_task(figure, self.graph, self.stand_ins) for figure in self.shown]

    @cached_property
    def tables(self) -> list[Task]:
        """The products whose files are the tables of a run."""
        return [observed_spectra(self.graph), quality(self.graph), *injection_tables(self.graph)]

    @property
    def targets(self) -> Sequence[Task]:
        """Figures and tables."""
        return [*self.figures, *self.tables]

    def fill(self, made: Made) -> None:
        """Write figures, tables, the file and the manifest."""
        folder, products = self.folder, made.products
        publish([products[task.key] for task in self.figures], folder / "figures")
        publish([products[task.key] for task in self.tables], folder / "tables")
        text = yaml.safe_dump(self.file.model_dump(mode="json"), sort_keys=False, allow_unicode=True, width=100)
        write(folder / EXPERIMENT, text)
        fields = {
            "description": self.description,
            "stand_ins": list(self.stand_ins),
            "captions": {figure.label: figure.caption for figure in self.shown},
            "products": product_entries(self.tasks, made.products, made.tasks),
        }
        write_manifest(folder, self.name, fields)


def load_observed(
    path: Path, data: Mapping[str, Any], scale: str | None = None, overrides: Sequence[str] = ()
) -> ObservedStudy:
    """Validate the content of a file of measured data, and read their metadata.

    Parameters and errors are as for `calstudy.studies.load.load_study`.
    """
    plain, folder = apply_scale(data, scale), path.resolve().parent
    file = validated(ObservedFile, plain, overrides, folder)
    for place, figure in enumerate(file.outputs.figures or ()):
        if not isinstance(figure, ObservedFigure):
            built_in = [name for name in FIGURES.built_in() if issubclass(FIGURES.find(name), ObservedFigure)]
            hint = f"{nearest(figure.label, built_in)} (built in: {', '.join(built_in)})"
            raise ExperimentError([f"outputs.figures.{place}: {figure.label!r} is no figure of measured data{hint}"])
        if file.injection is None and figure.needs_injection:
            raise ExperimentError([f"outputs.figures.{place}: {figure.label!r} needs the section injection"])
    return ObservedStudy(file, _halves(file))


def validated(model: type[File], content: Mapping[str, Any], overrides: Sequence[str], folder: Path) -> File:
    """Validate the content of a file of measured data; relative paths start at `folder`.

    Fields of the calibration that the content lacks have the defaults for measured data; then the overrides are
    applied, ``path=value`` texts. Raises ExperimentError if fields are unknown, missing or have values that are not
    allowed, or an input file does not exist.
    """

    def overridden(plain: dict[str, Any]) -> dict[str, Any]:
        for text in overrides:
            plain = override(plain, *parse_override(text))
        return plain

    plain = overridden(with_defaults(content, overridden(dict(content)), folder))
    try:
        file = model.model_validate(plain, context={"folder": folder})
    except ValidationError as error:
        raise ExperimentError(sentences(error, model, plain)) from None
    for field, block, name in input_files(file.calibration):
        path = getattr(block, name)
        if not (folder / path).exists():
            raise ExperimentError([f"calibration.{field} = {str(path)!r}: no such file"])
        plain = override(plain, f"calibration.{field}", str((folder / path).resolve()))
    return model.model_validate(plain, context={"folder": folder})


def read_selected(file: DataFile, files: tuple[Path, ...], even: bool = True) -> Facts:
    """Read the metadata of the selected data; raises InputError as `read_facts`, or if the noise is not known.

    `even` requires equally spaced channels.
    """
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


def _halves(file: ObservedFile) -> Parts:
    """Return the halves of the data from their metadata; raises InputError if they cannot be calibrated or crossed."""
    section = file.observed
    even = read_selected(file, section.data)
    odd = read_selected(file, section.odd) if section.odd else even
    if section.odd:
        require_same_sky(even, odd)
    elif even.times.size < 2:
        raise InputError(
            f"observed.data: {even.times.size} integration; two are needed, for even and odd, or other data of the "
            "same sky as observed.odd"
        )
    if even.unit.lower() != "jy" and section.flux_scale is None and section.sky_model is None:
        raise InputError(
            f"observed.flux_scale: the data are in {even.unit!r}, and power spectra need Jy: give {{kind: factor, "
            "unit: 1 Jy}, or system-temperature, or a sky model"
        )
    together = file.calibration.integrations_per_solve
    halves = Parts({"even": even, "odd": odd})
    shortest = min(len(halves.times(parity)) for parity in PARITIES)
    if together > shortest:
        raise InputError(
            f"calibration.integrations_per_solve = {together}: a half of the data has {shortest} integrations"
        )
    return halves
