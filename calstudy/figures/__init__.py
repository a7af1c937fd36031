"""Figures of studies: one module each, with its caption, its inputs, its drawing, and its tolerances.

A `StudyFigure` declares all that the rest of the package needs to know about it. Its name is that of its module; a
user's own figure is named by the path of its file in ``outputs.figures``.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, cast

from calstudy.base.errors import InputError
from calstudy.base.plugins import Plugin, guarded
from calstudy.base.resources import Cost
from calstudy.calibrate.settings import GainFit
from calstudy.experiment.model import FIGURES, Experiment
from calstudy.run.task import Job, Stage, Task
from calstudy.verdicts.tolerances import Drawn, Rules, spread_of_scale

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calstudy.products.comparison import Case
    from calstudy.products.graph import Graph
    from calstudy.products.observed import DataGraph


class Drawing(NamedTuple):
    """A drawn figure.

    Attributes
    ----------
    figure
        From matplotlib.
    shown
        The arrays that it shows: dataclasses, mappings and sequences of them (`calstudy.plotting.save.figure_arrays`).
    notes
        JSON-able, kept in the record of the product.
    """

    figure: Figure
    shown: Any
    notes: Mapping[str, Any] = {}


class StudyFigure(Plugin):
    """The base of all figures of a study.

    Attributes
    ----------
    caption
        One sentence for the report.
    variants
        Names of the variants of the data that it requires.
    needs_calibration
        True if `residual` must be calibrated data with foregrounds and effects.
    needs_signal_loss
        True if the experiment must calibrate data with the EoR and without.
    needs_least_squares
        True if the calibrator must fit by least squares: it is repeated, or its tangent space is needed.
    shows_sky
        True if a stand-in for sky, beam or scale enters it, and so is printed on it.
    tolerances
        Allowed differences of its arrays from a reference: pairs of a pattern of array names and a tolerance, of which
        the first that matches counts (`calstudy.verdicts.tolerances`).
    """

    registry: ClassVar = FIGURES
    caption: ClassVar[str] = ""
    variants: ClassVar[tuple[str, ...]] = ()
    needs_calibration: ClassVar[bool] = False
    needs_signal_loss: ClassVar[bool] = False
    needs_least_squares: ClassVar[bool] = False
    shows_sky: ClassVar[bool] = True
    tolerances: ClassVar[Rules] = ()

    kind: str

    def refusal(self, experiment: Experiment) -> str | None:
        """Return why the figure cannot be drawn of an experiment, to follow its name, or None."""
        missing = [name for name in self.variants if name not in experiment.variants]
        if missing:
            return f"needs the variant(s) {', '.join(missing)}"
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

    @abstractmethod
    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the products that the figure shows, by names of its own."""

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return further settings that the figure takes from the experiment: sections and JSON-able values."""
        del graph
        return {}

    @abstractmethod
    def draw(self, job: Job) -> Drawing:
        """Draw the figure.

        Parameters
        ----------
        job
            Its `inputs` are folders of products; its `settings` are those of the method `settings`, and ``notes``: the
            stand-ins to print.
        """


class ComparisonFigure(StudyFigure):
    """A figure of a collection: it compares the members that play certain roles.

    Attributes
    ----------
    titles
        The roles that are compared, from left to right, and their headings; empty: all members, by their names in place
        of roles. Its `draw` finds the product ``name`` of a member's `inputs` under ``name:role`` in ``job.inputs``,
        and its layout in ``job.settings["layouts"]``.
    """

    titles: ClassVar[Mapping[str, str]] = {"minimally_redundant": "Minimally redundant", "redundant": "Redundant"}

    def roles(self, played: Collection[str]) -> Sequence[str]:
        """Return the roles that the figure compares, given those played by members: by default all of `titles`."""
        del played
        return tuple(self.titles)

    def refusal(self, experiment: Experiment) -> str:
        """Refuse: a single experiment has nothing to compare."""
        return "compares the members of a collection, and cannot be drawn of a single experiment"

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the products of one member that the figure shows: by default its averaged spectra."""
        from calstudy.products.spectra import spectra

        return {"spectra": spectra(graph)}

    def member_settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the entry of one member in ``job.settings["members"]``, by role; by default nothing."""
        del graph
        return {}


class CasesFigure(StudyFigure):
    """A figure of a comparison: calibrators in worlds. `draw` finds those of its `settings` that all cases share.

    Attributes
    ----------
    scores
        The scores that it shows, and saves as its arrays: those in ``bands`` of k, or in the experiment's ``bins``.
    """

    scores: ClassVar[Literal["bands", "bins"]] = "bands"
    tolerances = ((r".*\.flux_scale", Drawn(spread_of_scale, "the flux scale of other noise")),)

    def refusal(self, experiment: Experiment) -> str:
        """Refuse: a single experiment has nothing to compare."""
        return "compares calibrators, and cannot be drawn of a single experiment"

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the scores of one case."""
        from calstudy.products.graph import required
        from calstudy.products.score import score

        return {"score": required(score(graph))}

    @abstractmethod
    def draw_cases(self, cases: Mapping[str, Mapping[str, Case]], job: Job) -> Figure:
        """Draw the figure.

        Parameters
        ----------
        cases
            By the labels of world and calibrator, in the order of the file; without those that a calibrator refuses.
        job
            Its `settings` have ``calibrators`` and ``worlds``, their labels, and ``notes``: the stand-ins to print.
        """

    def draw(self, job: Job) -> Drawing:
        """Read the scores, and draw them."""
        from calstudy.products.comparison import read_cases

        cases = read_cases(job)
        shown = {
            world: {name: getattr(case, self.scores) for name, case in found.items()} for world, found in cases.items()
        }
        return Drawing(self.draw_cases(cases, job), shown)


class ObservedFigure(StudyFigure):
    """A figure of measured data; `needs_injection` is true if a signal must be injected."""

    needs_injection: ClassVar[bool] = False

    def refusal(self, experiment: Experiment) -> str:
        """Refuse: an experiment has no measured data."""
        return "shows measured data, and cannot be drawn of an experiment"

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return nothing: there is no experiment to show."""
        del graph
        return {}

    @abstractmethod
    def observed_inputs(self, graph: Any) -> Mapping[str, Task]:
        """Return the products that the figure shows, by names of its own.

        `graph` is an `ObservedGraph` of `calstudy.products.observed`, for diagnostics any `DataGraph`.
        """


def figures_of(experiment: Experiment) -> tuple[StudyFigure, ...]:
    """Return the figures of an experiment; their registry accepts no other plug-ins."""
    return cast(tuple[StudyFigure, ...], experiment.outputs.figures)


def draw(job: Job) -> Mapping[str, Any]:
    """Write one figure as png and pdf, and its arrays as npz.

    Raise InputError if a user's figure fails, or returns anything but a drawing with plain arrays.
    """
    from matplotlib.figure import Figure

    from calstudy.plotting.save import figure_arrays, save_figure

    shown: StudyFigure = job.settings["figure"]
    with guarded(shown):
        drawing = shown.draw(job)
    if not isinstance(drawing, Drawing) or not isinstance(drawing.figure, Figure):
        raise InputError(f"figure {shown.label!r}: draw returned a {type(drawing).__name__}, expected a Drawing")
    try:
        arrays = figure_arrays(drawing.shown)
    except ValueError as error:
        raise InputError(f"figure {shown.label!r}: {error}") from None
    save_figure(drawing.figure, arrays, job.output, shown.label)
    return {"caption": shown.caption, **drawing.notes}


DRAW = Stage(name="figure", version=4, make=draw, cost=lambda task: Cost(3, disk=1e6))


def comparison_task(graphs: Mapping[str, Graph], figure: ComparisonFigure, stand_ins: Sequence[str]) -> Task:
    """Return the task that draws one figure of a collection.

    `graphs` are those of the members, by role, or by name for a figure of all members. `stand_ins` are printed on the
    figure if it shows the sky.
    """
    settings: dict[str, Any] = {"layouts": {role: graph.experiment.instrument.layout for role, graph in graphs.items()}}
    with guarded(figure):
        members = {role: figure.member_settings(graph) for role, graph in graphs.items()}
        if any(members.values()):
            settings["members"] = members
        inputs = {
            f"{name}:{role}": task for role, graph in graphs.items() for name, task in figure.inputs(graph).items()
        }
    return _task(figure, stand_ins, settings, inputs)


def figure_task(graph: Graph, figure: StudyFigure, stand_ins: Sequence[str]) -> Task:
    """Return the task that draws one figure of an experiment, with the stand-ins printed on it if it shows the sky."""
    with guarded(figure):
        return _task(figure, stand_ins, figure.settings(graph), figure.inputs(graph))


def _task(
    figure: StudyFigure, stand_ins: Sequence[str], settings: Mapping[str, Any], inputs: Mapping[str, Task]
) -> Task:
    notes = list(stand_ins) if figure.shows_sky else []
    return Task(DRAW, figure.label, {"figure": figure, "notes": notes, **settings}, inputs)


def cases_task(
    figure: CasesFigure, graphs: Mapping[str, Graph], labels: Mapping[str, Sequence[str]], stand_ins: Sequence[str]
) -> Task:
    """Return the task that draws one figure of a comparison.

    `graphs` are those of all cases, by `calstudy.products.comparison.case_name`; `labels` those of the calibrators and
    the worlds. `stand_ins` are printed on the figure if it shows the sky.
    """
    with guarded(figure):
        inputs = {name: figure.inputs(graph)["score"] for name, graph in graphs.items()}
        first, *others = [figure.settings(graph) for graph in graphs.values()] or [{}]
    common = {
        key: value for key, value in first.items() if all(key in other and other[key] == value for other in others)
    }
    return _task(figure, stand_ins, {**labels, **common}, inputs)


def observed_task(figure: ObservedFigure, graph: DataGraph, stand_ins: Sequence[str]) -> Task:
    """Return the task that draws one figure of measured data, with the stand-ins printed on it if it shows the sky."""
    with guarded(figure):
        inputs = figure.observed_inputs(graph)
    return _task(figure, stand_ins, graph.figure_settings, inputs)
