"""An experiment as a study: its figures, tables and claims."""

from __future__ import annotations

import csv
import io
from functools import cached_property
from pathlib import Path
from typing import Self

from calstudy.base.identity import identity
from calstudy.claims.paper import stand_ins
from calstudy.claims.product import claims
from calstudy.experiment.files import dump
from calstudy.experiment.model import Experiment, Outputs
from calstudy.figures import figure_task, figures_of
from calstudy.instrument.as_built import COLUMNS, as_built_rows
from calstudy.instrument.layouts import make_layout
from calstudy.products import sky_model
from calstudy.products.agreement import agreement
from calstudy.products.graph import Graph
from calstudy.products.score import score
from calstudy.products.signal_loss import transfer
from calstudy.products.spectra import spectra
from calstudy.run.provenance import seeds
from calstudy.run.task import Task
from calstudy.studies.capacity import fit, require_data_fit
from calstudy.studies.folder import EXPERIMENT, product_entries, publish, run_folder, write, write_manifest
from calstudy.studies.preflight import notes_of, require_possible
from calstudy.studies.study import Budget, Made, Study

SKY_MODEL_TABLE = "sky-model.csv"
AS_BUILT_TABLE = "as-built.csv"


class ExperimentStudy(Study):
    """One validated experiment without a sweep; `folder` is its run folder if another study decides it."""

    def __init__(self, experiment: Experiment, folder: Path | None = None) -> None:
        self.experiment = experiment
        self.name, self.description = experiment.name, experiment.description
        self.graph = Graph(experiment)
        self._folder = folder

    @property
    def outputs(self) -> Outputs:
        """Store and folder of runs."""
        return self.experiment.outputs

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self._folder or experiment_folder(self.experiment)

    def fitted(self, budget: Budget) -> tuple[Self, int]:
        """Return the study with simulations and solves cut to the memory, and the number of workers."""
        require_data_fit(self.experiment, budget)
        require_possible(self.experiment)
        experiment, count = fit(self.experiment, budget, self._targets_of)
        fitted = self if experiment is self.experiment else type(self)(experiment, self._folder)
        return fitted, count

    def _targets_of(self, experiment: Experiment) -> list[Task]:
        """Return the products of an experiment, without computing those of the study's own again."""
        return self.targets if experiment is self.experiment else targets_of(experiment)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Notes of a plan on settings that are allowed, but probably a mistake."""
        return notes_of(self.experiment)

    @cached_property
    def stand_ins(self) -> tuple[str, ...]:
        """Substitutions for the papers' own ingredients."""
        return stand_ins(self.experiment)

    @cached_property
    def figures(self) -> list[Task]:
        """The requested figures."""
        return [figure_task(self.graph, figure, self.stand_ins) for figure in figures_of(self.experiment)]

    @cached_property
    def tables(self) -> list[Task]:
        """The products whose files are the tables of a run."""
        graph = self.graph
        found = (spectra(graph), agreement(graph), transfer(graph), score(graph), self._sky_model_error)
        return [task for task in found if task is not None]

    @cached_property
    def calibrates(self) -> bool:
        """True if any variant is calibrated."""
        return any(variant.calibrate for variant in self.experiment.variants.values())

    @property
    def _sky_model_error(self) -> Task | None:
        return sky_model.error(self.graph) if self.calibrates else None

    @cached_property
    def claims(self) -> Task | None:
        """The statements of the papers that the experiment names, or None."""
        return claims(self.graph, self.stand_ins)

    @property
    def targets(self) -> list[Task]:
        """Figures, tables and claims."""
        return [*self.figures, *self.tables, *([self.claims] if self.claims else [])]

    def fill(self, made: Made) -> None:
        """Write figures, tables, claims, the resolved experiment and the manifest."""
        folder, products = self.folder, made.products
        publish([products[task.key] for task in self.figures], folder / "figures")
        publish([products[task.key] for task in self.tables], folder / "tables")
        if self.claims is not None:
            publish([products[self.claims.key]], folder)
        if self.calibrates:
            write(folder / "tables" / SKY_MODEL_TABLE, self._sky_model_table())
        if self.experiment.instrument.as_built.note:
            write(folder / "tables" / AS_BUILT_TABLE, self._as_built_table())
        write(folder / EXPERIMENT, dump(self.experiment))
        fields = {
            "stand_ins": list(self.stand_ins),
            **({"sky_model": sky_model.described(self.graph)} if self.calibrates else {}),
            "captions": {figure.label: figure.caption for figure in figures_of(self.experiment)},
            "seeds": seeds(self.experiment.model_dump(mode="json")),
            "products": product_entries(self.tasks, made.products, made.tasks, self.tables),
        }
        write_manifest(folder, self.name, fields)

    def _as_built_table(self) -> str:
        """Return as CSV the deviations of each antenna from the nominal instrument."""
        instrument = self.experiment.instrument
        numbers = make_layout(instrument.layout).numbers
        table = io.StringIO()
        rows = csv.writer(table, lineterminator="\n")
        rows.writerow(("number", *COLUMNS))
        found = as_built_rows(instrument.as_built, len(numbers))
        rows.writerows((number, *row) for number, row in zip(numbers, found, strict=True))
        return table.getvalue()

    def _sky_model_table(self) -> str:
        """Return as CSV the false assumptions of the calibrator, after a line that describes its sky model."""
        table = io.StringIO()
        table.write(f"# sky model: {sky_model.described(self.graph)}\n")
        rows = csv.writer(table, lineterminator="\n")
        rows.writerows([("field", "true", "assumed"), *sky_model.differences(self.graph)])
        return table.getvalue()


def targets_of(experiment: Experiment) -> list[Task]:
    """Return the products that a run of an experiment makes for its user."""
    return ExperimentStudy(experiment).targets


def experiment_folder(experiment: Experiment) -> Path:
    """Return the run folder of an experiment: its name, and a digest of its content without output paths."""
    outputs = experiment.outputs.with_defaults("store", "runs")
    content = identity(experiment.model_copy(update={"outputs": outputs}).with_defaults("scales"))
    return run_folder(experiment.outputs.runs, experiment.name, content)
