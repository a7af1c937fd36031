"""Measured data as a study: calibration, power spectra of data and residual, and signal loss of an injected EoR."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, Self

from pydantic import Field

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.plugins import guarded
from calstudy.base.visibilities import require_earth_orientation
from calstudy.experiment.files import StudyFile
from calstudy.experiment.model import FIGURES, Scales
from calstudy.figures import figure_task, figures_for
from calstudy.instrument.interface import model_of
from calstudy.power.interface import require_antennas, require_modes
from calstudy.power.settings import PowerSettings
from calstudy.products.table import tables_of
from calstudy.realdata.halves import PARITIES, Parts, require_same_samples, require_same_sky
from calstudy.realdata.settings import InjectionSettings, ObservedSettings
from calstudy.run.execution import Budget
from calstudy.run.task import Task
from calstudy.studies.calibration import DataFile, DataStudy, read_file, read_selected
from calstudy.studies.kinds.experiment import content_of
from calstudy.studies.preflight import note_of_maps, require_fine_maps

DEFAULT_FIGURES = ("diagnostics", "observed-wedge", "observed-spherical")
INJECTION_FIGURES = ("observed-signal-loss",)


class ObservedFile(DataFile):
    """Measured data: their selection, calibration and power spectra, and an injected signal."""

    observed: ObservedSettings
    power: PowerSettings = PowerSettings()
    injection: InjectionSettings | None = Field(None, description="Measure what the calibration loses; null: do not.")
    scales: Scales = Field(default_factory=dict)


class ObservedStudy(DataStudy):
    """A study of measured data, from its file and the metadata of the two halves."""

    key = "observed"
    model = ObservedFile
    heading = "Files about measured data"
    guide = (
        "A file with the key `observed` is about measured data ([measured-data.md](measured-data.md)): these are "
        "calibrated, have power spectra, and are calibrated again with an injected EoR."
    )

    @classmethod
    def load(cls, file: StudyFile) -> ObservedStudy:
        """Return the study of a file, with the metadata of its data."""
        content = read_file(ObservedFile, file)
        for figure in figures_for("observed", content.outputs.figures or (), "outputs.figures"):
            if content.injection is None and figure.needs_injection:
                raise ExperimentError([f"outputs.figures: {figure.label!r} needs the section injection"])
        return cls(content, _halves(content))

    @property
    def stand_ins(self) -> tuple[str, ...]:
        """Assumptions about the units of the power spectra."""
        section, sky = self.file.observed, self.file.observed.sky_model
        assumed = section.flux_scale is not None and section.flux_scale.kind != "factor"
        found = ("flux scale: autocorrelations at an assumed system temperature",) if assumed else ()
        if (assumed and sky is None) or section.pol_convention is not None:
            return found
        from calstudy.realdata.reading import read_metadata

        told = (self.data.facts["even"] if sky is None else read_metadata((sky,))).pol_convention
        return found if told else (*found, "I = XX + YY (pol_convention)")

    @property
    def setup(self) -> str:
        """The array, the band, the times, the injected EoR and the calibrator."""
        section, injection, facts = self.file.observed, self.file.injection, self.data.facts["even"]
        level = "" if injection is None or injection.level is None else f" at {injection.level:g} dB"
        return "; ".join(
            (
                f"{facts.antennas} antennas, baselines to {facts.size(1).longest:.3g} m, beam {section.beam.label}",
                facts.channels.label,
                f"{facts.times.size} integrations of {facts.integration:.3g} s"
                + (" in each half" if section.odd or section.difference else ""),
                "no EoR injected" if injection is None else f"EoR injected{level}",
                self.file.calibration.label,
            )
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes of a calibration, and which baselines see more of the injected EoR than its maps have."""
        facts, injection = self.data.facts["even"], self.file.injection
        if injection is None:
            return super().notes
        note = note_of_maps(injection.eor, facts.frame.lengths, facts.channels.band, "injection.eor")
        return (*super().notes, *([note] if note else []))

    @property
    def content(self) -> Any:
        """The content of the file without scales and the folders of outputs."""
        return content_of(self.file)

    def sized_to(self, budget: Budget) -> tuple[Self, int]:
        """Return the study fitted to a budget, and the number of workers; also refuse a beam that cannot be made."""
        beam = self.file.observed.beam
        with guarded(beam):
            model_of(beam).require_usable(self.data.facts["even"].channels)
        return super().sized_to(budget)

    @cached_property
    def figures(self) -> list[Task]:
        """The requested figures."""
        asked = self.file.outputs.figures
        if asked is None:
            names = DEFAULT_FIGURES + (INJECTION_FIGURES if self.file.injection else ())
            asked = tuple(FIGURES.make(name) for name in names)
        settings = {"wedge_buffer": self.file.power.wedge_buffer}
        shown = figures_for("observed", asked, "outputs.figures")
        return [figure_task(figure, {"": self.graph}, self.stand_ins, settings) for figure in shown]

    @cached_property
    def tables(self) -> list[Task]:
        """The products whose files are the tables of a run."""
        return tables_of("observed", self.graph)


def _halves(file: ObservedFile) -> Parts:
    """Return the halves of the data from their metadata; raises InputError if they cannot be calibrated or crossed."""
    section = file.observed
    even = read_selected(file, section.data)
    odd = read_selected(file, section.odd) if section.odd else even
    for facts in (even, odd):
        require_antennas(file.power, facts.frame.numbers, "leave them out by observed.select.antennas")
        require_modes(file.power, facts.frame.lengths, facts.frame.frequencies)
        if file.injection is not None:
            require_fine_maps(file.injection.eor, facts.frame.lengths, facts.channels.band, "injection.eor")
            require_earth_orientation(facts.times, "observed.data")
    if section.odd:
        require_same_sky(even, odd, section.sky_model)
    elif section.difference:
        require_same_samples(even, read_selected(file, section.difference))
        # Of the same metadata, and not interleaved.
        odd = replace(even)
    elif even.times.size < 2:
        raise InputError(
            f"observed.data: {even.times.size} integration; two are needed, for even and odd, or other data of the "
            "same sky as observed.odd, or what the correlator writes of differences as observed.difference"
        )
    elif even.copied:
        raise InputError(
            "observed.data: baselines are averaged over different times, and alternating integrations would share "
            "samples; give other data of the same sky as observed.odd, or average all baselines alike "
            "(pyuvdata: downsample_in_time)"
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
