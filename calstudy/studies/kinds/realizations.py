"""Realizations: one experiment with several draws of the EoR, the gains or the noise, pooled."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

from calstudy.base.errors import ExperimentError
from calstudy.base.schema import defaults
from calstudy.claims.evaluation import REALIZATIONS, Evaluated
from calstudy.experiment.files import dump
from calstudy.experiment.model import FIGURES, Experiment, Outputs
from calstudy.experiment.realizations import expand_realizations
from calstudy.figures import figure_task
from calstudy.products.realizations import pooled
from calstudy.run.provenance import seeds
from calstudy.run.task import Task
from calstudy.studies.folder import EXPERIMENT
from calstudy.studies.kinds.experiment import ExperimentStudy


class Realizations(ExperimentStudy):
    """An experiment whose EoR, gains or noise are drawn several times; raises ExperimentError if they cannot be.

    The first realization is the experiment itself, and shares its products with the experiment's own run. It is no
    family of experiments: what is kept are the pooled numbers, and realizations have no folders.
    """

    key = "realizations"
    # The members of a collection that have realizations are always run.
    keeps_tables = False

    def __init__(self, experiment: Experiment, folder: Path | None = None) -> None:
        expand_realizations(experiment)
        figures = experiment.outputs.figures
        # Those of every single run are the default.
        if figures and figures != defaults(Outputs)["figures"]:
            raise ExperimentError(
                [
                    "outputs.figures: are figures of single runs, and realizations have one of their own; leave them "
                    "out, or set outputs.figures=[]"
                ]
            )
        super().__init__(experiment, folder)

    @cached_property
    def figures(self) -> list[Task]:
        """The figure of all realizations."""
        return [figure_task(FIGURES.make("realizations"), {"": self.graph}, self.stand_ins)]

    @cached_property
    def tables(self) -> list[Task]:
        """The tables and verdicts of all realizations."""
        return [pooled(self.graph)]

    @property
    def evaluated(self) -> Evaluated:
        """The experiment with the figure of all realizations, which has the measurements on them."""
        return Evaluated(self.experiment, {REALIZATIONS: self.figures[0]})

    @property
    def texts(self) -> dict[str, str]:
        """The experiment."""
        return {EXPERIMENT: dump(self.file)}

    @property
    def entries(self) -> dict[str, Any]:
        """The seeds of every realization."""
        drawn = expand_realizations(self.experiment)
        return {
            self.key: [{"label": item.label, **seeds(item.experiment.model_dump(mode="json"))} for item in drawn],
        }
