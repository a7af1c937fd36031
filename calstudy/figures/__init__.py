"""Figures of studies, one module for each subject: captions, inputs, drawing, and tolerances.

A `StudyFigure` declares all that the rest of the package needs to know about it. Its name is the default of its field
`kind`; a user's own figure is named by the path of its file in ``outputs.figures``.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, cast

import numpy as np

from calstudy.base.errors import ExperimentError, InputError, nearest
from calstudy.base.plugins import Plugin, guarded
from calstudy.calibrate.settings import GainFit
from calstudy.experiment.model import FIGURES, SIGNAL_LOSS_VARIANTS, Experiment
from calstudy.plotting.style import figure_arrays, journal_style, note_stand_ins, save_figure
from calstudy.products import calibration, corruption
from calstudy.products.comparison import Case, read_cases
from calstudy.products.graph import Graph, required
from calstudy.products.score import score
from calstudy.products.spectra import spectra
from calstudy.run.task import Inputs, Job, Task
from calstudy.verdicts.tolerances import BY_OWN_ERROR, ERROR_OF_ERROR, Arrays, Drawn, Rules, spread_of_scale

if TYPE_CHECKING:
    from matplotlib.figure import Figure


TWO_ARRAYS = {"minimally_redundant": "Minimally redundant", "redundant": "Redundant"}
"""Roles and headings of the two arrays of a collection."""


class Drawing(NamedTuple):
    """A drawn figure.

    Attributes
    ----------
    figure
        From matplotlib.
    shown
        The arrays that it shows: dataclasses, mappings and sequences of them (`calstudy.plotting.style.figure_arrays`).
    notes
        JSON-able, kept in the record of the product.
    """

    figure: Figure
    shown: Any
    notes: Mapping[str, Any] = {}


class StudyFigure(Plugin):
    """The base of all figures: of one run, or of a family of experiments.

    Attributes
    ----------
    of
        Kinds of study that the figure can be drawn of, the names of modules of `calstudy.studies.kinds`.
    titles
        Of a figure that compares members of a collection: their roles, from left to right, and headings. Empty: all
        members, by their names.
    caption
        One sentence for the report.
    variants, needs_calibration, needs_signal_loss, needs_least_squares, needs_foregrounds
        What the experiment must have: variants of the data; `residual` of calibrated data with foregrounds and effects;
        data calibrated with the EoR and without; a calibrator that fits by least squares; foregrounds.
    sections
        Sections and fields (dotted path) of the experiment that it reads; see `settings`.
    reads
        The products that it shows of a run, or of each member of a family: functions of the graph that return a task,
        by names of the figure's own, the keys of `job.inputs`. Empty: the settings are sufficient. See `inputs`.
    needs_injection
        True if a signal must be injected into measured data.
    shows_sky
        True if a stand-in for sky, beam or scale enters it, and so is printed on it.
    tolerances
        Patterns of names of its arrays with their tolerance; the first that matches counts.
    """

    registry: ClassVar = FIGURES
    of: ClassVar[tuple[str, ...]] = ("experiment",)
    caption: ClassVar[str] = ""
    titles: ClassVar[Mapping[str, str]] = {}
    variants: ClassVar[tuple[str, ...]] = ()
    needs_calibration: ClassVar[bool] = False
    needs_signal_loss: ClassVar[bool] = False
    needs_least_squares: ClassVar[bool] = False
    needs_foregrounds: ClassVar[bool] = False
    sections: ClassVar[tuple[str, ...]] = ()
    reads: ClassVar[Mapping[str, Callable[[Any], Task | None]]] = {"spectra": spectra}
    needs_injection: ClassVar[bool] = False
    shows_sky: ClassVar[bool] = True
    tolerances: ClassVar[Rules] = ()

    kind: str

    def refusal(self, experiment: Experiment) -> str | None:
        """Return why the figure cannot be drawn of an experiment, to follow its name, or None."""
        if "experiment" not in self.of:
            return f"is a figure {_listed(self.of)}, and cannot be drawn of a single experiment"
        wanted = self.variants or (SIGNAL_LOSS_VARIANTS if self.needs_signal_loss else ())
        missing = [name for name in wanted if name not in experiment.variants]
        if missing:
            return f"needs the variant(s) {', '.join(missing)}"
        if self.needs_foregrounds and not experiment.sky.has_foregrounds:
            return "needs foregrounds, and sky.foregrounds is 'none'"
        residual = experiment.variants.get("residual")
        complete = residual and residual.effects and residual.calibrate and "foregrounds" in residual.components
        if self.needs_calibration and not complete:
            return "needs variants.residual to have foregrounds, effects: true and calibrate: true"
        if self.needs_signal_loss and not experiment.measures_signal_loss:
            return (
                "needs the variants residual and residual_without_eor, which differ in the EoR alone and have "
                "calibrate: true, and eor, with components [eor] alone"
            )
        if self.needs_least_squares and not isinstance(experiment.calibration, GainFit):
            return "needs a calibrator that fits by least squares, such as calamity"
        return None

    def captioned(self) -> str:
        """Return the caption, with what the fields of the figure add to it: by default nothing."""
        return self.caption

    def roles(self, played: Collection[str]) -> Sequence[str]:
        """Return the roles that the figure compares, given those played by members: by default all of `titles`."""
        del played
        return tuple(self.titles)

    def inputs(self, graph: Any) -> Mapping[str, Task]:
        """Return the tasks of `reads`, by names of the figure's own, of a run or of one member of a family.

        The graph is a `calstudy.products.graph.Graph`, of measured data a `MeasuredGraph`. If the figure shows a single
        product of each member, its name may be empty.
        """
        return {name: required(product(graph)) for name, product in self.reads.items()}

    def settings(self, graph: Any) -> Mapping[str, Any]:
        """Collect further inputs from a run, or one member: by default the `sections`, by their names."""
        return {path.rpartition(".")[2]: attrgetter(path)(graph.experiment) for path in self.sections}

    @abstractmethod
    def draw(self, job: Job) -> Drawing:
        """Draw the figure.

        Parameters
        ----------
        job
            Its `inputs` are folders of products, by the names of the method `inputs`; those of members of a family
            have names ``name:label`` (`members_of`). Its `settings` are those of the method `settings`, and
            ``notes``: the stand-ins, which are printed below the figure. Of a family, ``layouts`` has the array
            layout of each member, by label, and ``members`` the settings of each if there are any.
        """


class InspectedFigure(StudyFigure):
    """A figure of two antennas in one integration, those of `outputs.inspect`: of their gains, or of their baseline."""

    sections = ("instrument.layout", "outputs.inspect.antennas", "outputs.inspect.integration")
    shown: ClassVar[Mapping[str, str]] = {}

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the true gains, the calibration of `residual`, and the data of the variants `shown`."""
        variants, realization = graph.experiment.variants, graph.experiment.outputs.inspect.realization
        fitted = calibration.calibration(graph, variants["residual"], realization)
        data = {name: corruption.data(graph, variants[found], realization) for name, found in self.shown.items()}
        return {"gains": corruption.gains(graph), "calibration": fitted, **data}


CONVERGED, MOST = "converged", 0.5
"""Name of the array with the fraction of the solves of a case that converged, and the least fraction of a result."""


def _error_of_transfer(arrays: Arrays, name: str) -> np.ndarray:
    return arrays[name.replace("cross_transfer", "transfer_error")]


def _tenth(arrays: Arrays, name: str) -> np.ndarray:
    return np.full(np.shape(arrays[name]), 0.1)


def _of_solutions(error: Callable[[Arrays, str], np.ndarray]) -> Callable[[Arrays, str], np.ndarray]:
    """Make an error infinite in a case of which most solves did not converge: it depends on where they stopped."""

    def found(arrays: Arrays, name: str) -> np.ndarray:
        share = arrays.get(f"{name.rpartition('.')[0]}.{CONVERGED}", 1.0)
        return error(arrays, name) if share >= MOST else np.full(np.shape(arrays[name]), np.inf)

    return found


class CasesFigure(StudyFigure):
    """A figure of the scores of a comparison, calibrators in worlds: those in ``bands`` of k, or in its ``bins``.

    The fraction of solves that converged is saved beside them.
    """

    of = ("comparison",)
    reads: ClassVar = {"": score}
    scores: ClassVar[Literal["bands", "bins"]] = "bands"
    tolerances = (
        (r".*\.flux_scale", Drawn(_of_solutions(spread_of_scale), "the flux scale of other noise")),
        (r".*\.cross_transfer", Drawn(_of_solutions(_error_of_transfer), "the error of T, of which C has no other")),
        (rf".*\.{CONVERGED}", Drawn(_tenth, "rounding decides how a few solves end; a tenth", largest=3.0)),
        (r".*_error", Drawn(_of_solutions(ERROR_OF_ERROR.error), ERROR_OF_ERROR.why)),
        (r".*\.(transfer|bias|recovered)", Drawn(_of_solutions(BY_OWN_ERROR.error), BY_OWN_ERROR.why)),
    )

    @abstractmethod
    def draw_cases(self, cases: Mapping[str, Mapping[str, Case]], job: Job) -> Figure:
        """Draw the figure.

        Parameters
        ----------
        cases
            By the labels of world and calibrator, in the order of the file; without those that a calibrator refuses.
        job
            Its `settings` have ``calibrators`` and ``worlds``, their labels.
        """

    def draw(self, job: Job) -> Drawing:
        """Read the scores, and draw them."""
        cases = read_cases(job.settings["calibrators"], job.settings["worlds"], job.inputs)
        shown = {
            world: {
                name: {**vars(getattr(case, self.scores)), CONVERGED: case.converged} for name, case in found.items()
            }
            for world, found in cases.items()
        }
        return Drawing(self.draw_cases(cases, job), shown)


def figures_for(kind: str, figures: Sequence[Plugin], field: str) -> tuple[StudyFigure, ...]:
    """Return the figures of a field of a file; raises ExperimentError if the kind of study cannot draw one."""
    for place, figure in enumerate(cast(Sequence[StudyFigure], figures)):
        if kind not in figure.of:
            known = [name for name in FIGURES.built_in() if kind in FIGURES.find(name).of]
            hint = f"{nearest(figure.label, known)} (built in: {', '.join(known)})"
            sentence = f"is a figure {_listed(figure.of)}, not {_listed((kind,))}{hint}"
            raise ExperimentError([f"{field}.{place}: {figure.label!r} {sentence}"])
    return cast(tuple[StudyFigure, ...], tuple(figures))


def _listed(kinds: Sequence[str]) -> str:
    return f"for {' or '.join(kinds)} files"


class Draw(Task, stage="figure", version=6):
    """One figure; `own` are the settings of its own, which are keyed beside the others."""

    figure: StudyFigure
    notes: Sequence[str]
    own: Mapping[str, Any]
    products: Inputs

    @cached_property
    def settings(self) -> Mapping[str, Any]:
        """The settings that the figure is given."""
        return {"figure": self.figure, "notes": self.notes, **self.own}

    def drawing(self, output: Path) -> Drawing:
        """Draw the figure, with the stand-ins below it; raises InputError if it fails or returns no drawing."""
        from matplotlib.figure import Figure

        with journal_style(), guarded(self.figure):
            found = self.figure.draw(Job(settings=self.settings, inputs=self.products, output=output))
        if not isinstance(found, Drawing) or not isinstance(found.figure, Figure):
            name = type(found).__name__
            raise InputError(f"figure {self.figure.label!r}: draw returned a {name}, expected a Drawing")
        with journal_style():
            note_stand_ins(found.figure, self.notes)
        return found

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the figure as png and pdf, and its arrays as npz."""
        drawing = self.drawing(output)
        try:
            arrays = figure_arrays(drawing.shown)
        except ValueError as error:
            raise InputError(f"figure {self.figure.label!r}: {error}") from None
        save_figure(drawing.figure, arrays, output, self.figure.label)
        return {"caption": self.figure.captioned(), **drawing.notes}


def figure_task(
    figure: StudyFigure,
    members: Mapping[str, Graph],
    stand_ins: Sequence[str],
    settings: Mapping[str, Any] | None = None,
) -> Task:
    """Return the task that draws a figure of members by label, or of a single run, whose label is empty.

    Stand-ins are printed on it if it shows the sky; `settings` replace those of its own method.
    """
    with guarded(figure):
        own = {label: figure.settings(graph) for label, graph in members.items()} if settings is None else {}
        inputs = {
            ":".join(filter(None, (name, label))): task
            for label, graph in members.items()
            for name, task in figure.inputs(graph).items()
        }
    if wrong := {name: made for name, made in inputs.items() if not isinstance(made, Task)}:
        raise InputError(f"{figure.label}: inputs returned {wrong!r}; tasks are needed, such as those of the graph")
    if settings is None and "" not in members:
        layouts = {label: graph.experiment.instrument.layout for label, graph in members.items()}
        settings = {"layouts": layouts, **({"members": own} if any(own.values()) else {})}
    return draw_task(figure, inputs, stand_ins, own[""] if settings is None else settings)


def draw_task(
    figure: StudyFigure, inputs: Mapping[str, Task], stand_ins: Sequence[str], settings: Mapping[str, Any]
) -> Task:
    """Return the task that draws a figure of given products."""
    notes = list(stand_ins) if figure.shows_sky else []
    return Draw(figure.label, figure=figure, notes=notes, own=settings, products=inputs)


def members_of(job: Job) -> dict[str, dict[str, Path]]:
    """Return the folders of a job by member and by the figure's own names; the label of a single run is empty."""
    if "layouts" not in job.settings:
        return {"": dict(job.inputs)}
    return {
        label: {
            f":{name}".removesuffix(f":{label}")[1:]: folder
            for name, folder in job.inputs.items()
            if f":{name}".endswith(f":{label}")
        }
        for label in job.settings["layouts"]
    }
