"""Measured data as a study: calibration, power spectra of data and residual, and signal loss of an injected EoR."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any, Self

from pydantic import Field, SerializeAsAny, model_validator

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.identity import identity
from calstudy.base.plugins import guarded
from calstudy.base.schema import Section, fault
from calstudy.calibrate.calibrators.given_gains import ByFile
from calstudy.calibrate.calibrators.least_squares import Calamity
from calstudy.calibrate.execution import require_calibratable
from calstudy.calibrate.interface import CALIBRATORS, Calibrator
from calstudy.experiment.files import StudyFile, checked
from calstudy.experiment.model import FIGURES, Figures, Folders, StudyName
from calstudy.figures import figure_task, figures_for
from calstudy.instrument.interface import model_of
from calstudy.measured.defaults import with_defaults
from calstudy.measured.halves import PARITIES, Halves, modelled, read_facts, require_same_sky
from calstudy.measured.interference import require_surroundings
from calstudy.measured.settings import InjectionSettings, ObservedSettings
from calstudy.power.settings import PowerSettings
from calstudy.products.observed import ObservedGraph
from calstudy.products.observed_injection import injection_tables
from calstudy.products.observed_quality import quality
from calstudy.products.observed_spectra import observed_spectra
from calstudy.run.task import Task
from calstudy.studies.capacity import workers_for
from calstudy.studies.study import Budget, Study

DEFAULT_FIGURES = ("observed-wedge", "observed-spherical")
INJECTION_FIGURES = ("observed-signal-loss",)


class ObservedOutputs(Folders):
    """Figures, and the folders of products and runs."""

    figures: Figures | None = Field(None, description="Figures of measured data; null: all.")


class ObservedFile(Section):
    """Measured data: their selection, calibration and power spectra, and an injected signal."""

    name: StudyName
    description: str = ""
    observed: ObservedSettings
    calibration: Annotated[SerializeAsAny[Calibrator], CALIBRATORS.field("calamity")] = Field(
        default_factory=Calamity,
        description="As in an experiment. Without `solver`, Gauss-Newton steps go on longer, for data of few baselines "
        "converge slowly; without `prior` and sky model, the size of the gains fixes the scale.",
    )
    power: PowerSettings = PowerSettings()
    injection: InjectionSettings | None = Field(None, description="Measure what the calibration loses; null: do not.")
    outputs: ObservedOutputs = Field(default_factory=ObservedOutputs)
    scales: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="Named sets of overrides (dotted path: value), chosen with --scale."
    )

    @model_validator(mode="after")
    def _calibration_is_of_measured_data(self) -> ObservedFile:
        if self.calibration.assumed:
            raise fault("calibration.assumed", "is for simulated data; give the sky model as observed.sky_model")
        if isinstance(self.calibration, ByFile) and self.calibration.folder is not None:
            raise fault("calibration.folder", "is for simulated data; give gains of measured data as calibration.gains")
        return self


class ObservedStudy(Study):
    """A study of measured data, from its file and the metadata of the two halves."""

    key = "observed"
    model = ObservedFile
    heading = "Files about measured data"
    guide = (
        "A file with the key `observed` is about measured data ([measured-data.md](measured-data.md)): these are "
        "calibrated, have power spectra, and are calibrated again with an injected EoR."
    )

    def __init__(self, file: ObservedFile, halves: Halves) -> None:
        self.file, self.halves = file, halves
        self.graph = ObservedGraph(file.observed, file.calibration, file.power, file.injection, halves)

    @classmethod
    def load(cls, file: StudyFile) -> ObservedStudy:
        """Return the study of a file, with the metadata of its data."""
        content = checked(ObservedFile, with_defaults(file.changed(), file.folder), file.folder)
        for figure in figures_for("observed", content.outputs.figures or (), "outputs.figures"):
            if content.injection is None and figure.needs_injection:
                raise ExperimentError([f"outputs.figures: {figure.label!r} needs the section injection"])
        return cls(content, _halves(content))

    @property
    def stand_ins(self) -> tuple[str, ...]:
        """Assumptions about the units of the power spectra."""
        scale = self.file.observed.flux_scale
        if scale is None or scale.kind == "factor":
            return ()
        return ("flux scale: autocorrelations at an assumed system temperature",)

    @property
    def content(self) -> Any:
        """The content of the file without scales and the folders of outputs."""
        outputs = self.file.outputs.with_defaults("store", "runs")
        return identity(self.file.model_copy(update={"outputs": outputs}).with_defaults("scales"))

    def sized_to(self, budget: Budget) -> tuple[Self, int]:
        """Return the study itself and the number of workers.

        Raises InputError if a beam cannot be made, the memory is too small, the calibrator refuses the data, or they
        are too few for a search for interference.
        """
        section = self.file.observed
        if section.flag_interference is not None:
            for facts in self.halves.facts.values():
                require_surroundings(facts.times.size, facts.frequencies.size)
        with guarded(section.beam):
            model_of(section.beam).require_usable(self.halves.facts["even"].channels)
        for parity in PARITIES[:1] if self.halves.interleaved else PARITIES:
            frame = self.halves.facts[parity].frame
            if section.sky_model is not None:
                frame = modelled(frame, section.sky_model)
            require_calibratable(self.file.calibration, frame, section.sky_model is not None)
        return self, workers_for(self.targets, self.outputs.store, budget)

    @cached_property
    def figures(self) -> list[Task]:
        """The requested figures."""
        asked = self.file.outputs.figures
        if asked is None:
            names = DEFAULT_FIGURES + (INJECTION_FIGURES if self.file.injection else ())
            asked = tuple(FIGURES.make(name) for name in names)
        settings = {"wedge_buffer": self.graph.power.wedge_buffer}
        shown = figures_for("observed", asked, "outputs.figures")
        return [figure_task(figure, {"": self.graph}, self.stand_ins, settings) for figure in shown]

    @cached_property
    def tables(self) -> list[Task]:
        """The products whose files are the tables of a run."""
        return [observed_spectra(self.graph), quality(self.graph), *injection_tables(self.graph)]


def _halves(file: ObservedFile) -> Halves:
    """Return the halves of the data from their metadata; raises InputError if they cannot be calibrated or crossed."""
    section = file.observed
    selection = section.select.selection
    try:
        even = read_facts(section.data, selection, section.positions)
        odd = read_facts(section.odd, selection, section.positions) if section.odd else even
    except InputError as error:
        raise InputError(str(error).replace("--select ", "observed.select.")) from None
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
    if file.calibration.needs_noise and not (even.autos and odd.autos):
        raise InputError(
            "calibration.foreground_prior.noise: must be given, for the data have no autocorrelations that tell it"
        )
    together = file.calibration.integrations_per_solve
    halves = Halves({"even": even, "odd": odd})
    shortest = min(len(halves.times(parity)) for parity in ("even", "odd"))
    if together > shortest:
        raise InputError(
            f"calibration.integrations_per_solve = {together}: a half of the data has {shortest} integrations"
        )
    return halves
