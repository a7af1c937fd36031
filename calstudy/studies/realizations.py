"""Realizations: one experiment with several draws of the EoR, the gains or the noise, pooled."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Self

from calstudy.claims.paper import stand_ins
from calstudy.claims.product import claims
from calstudy.experiment.files import dump
from calstudy.experiment.model import FIGURES, Experiment, Outputs
from calstudy.experiment.realizations import expand_realizations
from calstudy.figures import figure_task
from calstudy.products.graph import Graph
from calstudy.products.pooled_realizations import pooled
from calstudy.products.realizations import realization_graphs
from calstudy.run.provenance import seeds
from calstudy.run.task import Task
from calstudy.studies.capacity import fit
from calstudy.studies.experiment import experiment_folder
from calstudy.studies.folder import EXPERIMENT, product_entries, publish, write, write_manifest
from calstudy.studies.preflight import notes_of, require_possible
from calstudy.studies.study import Budget, Made, Study


class Realizations(Study):
    """An experiment whose EoR, gains or noise are drawn several times.

    Products that several realizations need have one key, and are made once. The first realization is the experiment
    itself, and shares its products with the experiment's own run.

    Raises
    ------
    ExperimentError
        With one sentence per fault of the realizations.
    """

    def __init__(self, experiment: Experiment) -> None:
        expand_realizations(experiment)
        self.experiment = experiment
        self.name, self.description = experiment.name, experiment.description
        self.graph = Graph(experiment)

    @property
    def outputs(self) -> Outputs:
        """Store and folder of runs."""
        return self.experiment.outputs

    @property
    def folder(self) -> Path:
        """The run folder."""
        return experiment_folder(self.experiment)

    def fitted(self, budget: Budget) -> tuple[Self, int]:
        """Return the study with simulations and solves cut to the memory, and the number of workers."""
        require_possible(self.experiment)
        experiment, count = fit(self.experiment, budget, _targets_of)
        return type(self)(experiment), count

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Notes of a plan on settings that are allowed, but probably a mistake."""
        return notes_of(self.experiment)

    @cached_property
    def stand_ins(self) -> tuple[str, ...]:
        """Substitutions for the papers' own ingredients."""
        return stand_ins(self.experiment)

    @cached_property
    def figure(self) -> Task:
        """The figure of all realizations."""
        return figure_task(self.graph, FIGURES.make("realizations"), self.stand_ins)

    @property
    def table(self) -> Task:
        """The tables and verdicts of all realizations."""
        return pooled(self.graph)

    @cached_property
    def claims(self) -> Task | None:
        """The statements of the experiment's papers that realizations measure, or None."""
        return claims(self.graph, self.stand_ins)

    @property
    def targets(self) -> Sequence[Task]:
        """The figure, the tables and claims."""
        return [self.table, self.figure, *([self.claims] if self.claims else [])]

    def fill(self, made: Made) -> None:
        """Write figure, tables, claims, the experiment and the manifest."""
        folder, figure = self.folder, made.products[self.figure.key]
        publish([figure], folder / "figures")
        publish([made.products[self.table.key]], folder / "tables")
        if self.claims is not None:
            publish([made.products[self.claims.key]], folder)
        write(folder / EXPERIMENT, dump(self.experiment))
        fields = {
            "description": self.description,
            "stand_ins": list(self.stand_ins),
            "captions": {self.figure.label: self.figure.settings["figure"].caption},
            "realizations": [
                {"label": item.realization.label, **seeds(item.realization.experiment.model_dump(mode="json"))}
                for item in realization_graphs(self.graph)
            ],
            "products": product_entries(self.tasks, made.products, made.tasks),
        }
        write_manifest(folder, self.name, fields)


def _targets_of(experiment: Experiment) -> Sequence[Task]:
    return Realizations(experiment).targets
