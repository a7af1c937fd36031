"""The bias of the residual power against the steps of a solver."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.base.table import Table
from calstudy.calibrate.agreement import ratio_over_antennas
from calstudy.calibrate.settings import GainFit, GainWeights
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS, Experiment
from calstudy.figures import Drawing, StudyFigure
from calstudy.plotting import style
from calstudy.products.agreement import spread
from calstudy.products.convergence import PATHS, followed
from calstudy.products.files import read_json
from calstudy.products.graph import Graph
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, half

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


BIAS = r"$|P^{R}|\,/\,P^{S}$, no EoR in the data"
LOWEST = 1e-3
TOTAL = r"$P^{R}/P^{S}$, EoR in the data"


@dataclass(frozen=True)
class ConvergencePath:
    """Power common to even and odd residuals after a number of steps of a solver, over the power of the EoR.

    All arrays are (Ncheckpoints,), `steps` ascending. `bias` is without EoR in the data, and `with_eor` with it, each
    with its standard deviation; `predicted` is the power that corresponds to the solver's own distance from the
    minimum.
    """

    solver: str
    steps: np.ndarray
    bias: np.ndarray
    bias_error: np.ndarray
    with_eor: np.ndarray
    with_eor_error: np.ndarray
    predicted: np.ndarray


@style.journal_style()
def draw_convergence(paths: Sequence[ConvergencePath], integrations: Sequence[int]) -> Figure:
    """Draw the bias without EoR on the left, and with EoR on the right, against steps, of one to five solvers.

    Bars are 95 % (1.96 sigma, leaving out one antenna after the other); open markers are negative. Dashes are the
    predictions of the solver from where it stopped. The title names the solved integrations.
    """
    from matplotlib.ticker import FuncFormatter

    figure = style.new_figure(style.TWO_COLUMNS, 3.0)
    left, right = figure.subplots(1, 2)
    for path, (marker, colour) in zip(paths, style.SERIES, strict=False):
        _draw_path(left, path, (path.bias, path.bias_error), marker, colour)
        left.plot(path.steps, np.where(path.predicted > 0, path.predicted, np.nan), color=colour, linestyle="--")
        _draw_path(right, path, (path.with_eor, path.with_eor_error), marker, colour)
    left.plot([], [], color=style.GREY, linestyle="--", label="predicted where it stopped")
    for axes, label in ((left, BIAS), (right, TOTAL)):
        axes.axhline(1.0, color=style.GREY, linewidth=0.7, zorder=0)
        axes.set(xscale="log", yscale="log", xlabel="step", ylabel=label)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    left.set_ylim(bottom=max(LOWEST, left.get_ylim()[0]))
    left.legend(loc="lower right")
    right.legend(loc="upper right")
    count = len(integrations)
    figure.suptitle(
        f"even x odd outside the wedge, {count} integration{'s' if count > 1 else ''}, each solved from unity gains",
        fontsize=8.5,
    )
    return figure


def _draw_path(
    axes: Axes, path: ConvergencePath, measured: tuple[np.ndarray, np.ndarray], marker: str, colour: str
) -> None:
    power, error = measured
    size = np.abs(power)
    axes.plot(path.steps, size, color=colour, linewidth=0.8)
    # Bars that reach below zero have no lower end on this scale.
    reach = SIGMAS_95 * error
    lower = np.minimum(reach, 0.999 * size)
    for positive in (True, False):
        chosen = (power > 0) == positive
        axes.errorbar(
            path.steps[chosen],
            size[chosen],
            [lower[chosen], reach[chosen]],
            fmt=marker,
            color=colour,
            markerfacecolor=colour if positive else "white",
            elinewidth=0.7,
            label=path.solver if positive else None,
        )


COLUMNS = ("solver", "steps", "bias", "bias error", "with EoR", "with EoR error", "predicted")


class Convergence(StudyFigure):
    """The bias of the residual power against the steps of several solvers, with convergence.csv."""

    version: ClassVar[int] = 2

    kind: str = "convergence"

    caption = "What solvers leave of the foregrounds in even and odd alike, against their steps, over the EoR."
    variants = SIGNAL_LOSS_VARIANTS
    needs_signal_loss = True
    needs_least_squares = True
    needs_calibration = True
    tolerances = ((r".*\.predicted", Drawn(half, "an estimate to within a factor of two; half of it")),)

    def refusal(self, experiment: Experiment) -> str | None:
        """Return that the weights change between steps, or another reason against the figure, or None."""
        reason, calibration = super().refusal(experiment), experiment.calibration
        if reason is None and isinstance(calibration, GainFit) and isinstance(calibration.weights, GainWeights):
            return "needs weights that stay as they are: with calibration.weights 'gains' solvers run several times"
        return reason

    def _integrations(self, graph: Graph) -> list[int]:
        experiment = graph.experiment
        every = np.arange(experiment.instrument.times.count)
        return spread(every, experiment.outputs.convergence.integrations).tolist()

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return every solver on every integration of data with the EoR and without."""
        solvers = graph.experiment.outputs.convergence.solvers
        names = dict(zip(("with", "without"), SIGNAL_LOSS_VARIANTS, strict=False))
        return {
            f"{label} {kind} {integration}": followed(graph, names[kind], solver, integration)
            for (label, solver), kind, integration in itertools.product(
                solvers.items(), names, self._integrations(graph)
            )
        }

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the names of the solvers, and the integrations."""
        solvers = list(graph.experiment.outputs.convergence.solvers)
        return {"solvers": solvers, "integrations": self._integrations(graph)}

    def draw(self, job: Job) -> Drawing:
        """Combine the integrations of every solver, write convergence.csv, and draw them."""
        paths = [_path(job, label) for label in job.settings["solvers"]]
        rows: list[list[Any]] = []
        for path in paths:
            columns = (path.steps, path.bias, path.bias_error, path.with_eor, path.with_eor_error, path.predicted)
            rows += [[path.solver, *row] for row in zip(*(part.tolist() for part in columns), strict=True)]
        Table(COLUMNS, rows).write_csv(job.output / "convergence.csv")
        figure = draw_convergence(paths, job.settings["integrations"])
        notes = {path.solver: {"steps": int(path.steps[-1]), "bias": round(float(path.bias[-1]), 4)} for path in paths}
        return Drawing(figure, {"paths": paths}, notes)


def _path(job: Job, label: str) -> ConvergencePath:
    """Return the path of a solver over all integrations, whose powers of the baselines add up."""
    found = {
        variant: [read_json(job.inputs[f"{label} {variant} {index}"] / PATHS) for index in job.settings["integrations"]]
        for variant in ("without", "with")
    }
    # Integrations that end early keep their last value.
    longest = {name: max(items, key=lambda item: len(item["checkpoints"])) for name, items in found.items()}
    count = max(len(item["checkpoints"]) for item in longest.values())
    steps = max(longest.values(), key=lambda item: len(item["checkpoints"]))["checkpoints"]
    ratios = {name: [_ratio(items, row) for row in range(count)] for name, items in found.items()}
    predicted = [np.mean([_predicted(item, row) for item in found["without"]]) for row in range(count)]
    columns = {name: np.array(values).T for name, values in ratios.items()}
    return ConvergencePath(
        solver=label,
        steps=np.array([max(row["steps"]) for row in steps]),
        bias=columns["without"][0],
        bias_error=columns["without"][1],
        with_eor=columns["with"][0],
        with_eor_error=columns["with"][1],
        predicted=np.array(predicted),
    )


def _checkpoint(item: Mapping[str, Any], row: int) -> Mapping[str, Any]:
    return item["checkpoints"][min(row, len(item["checkpoints"]) - 1)]


def _ratio(items: Sequence[Mapping[str, Any]], row: int) -> tuple[float, float]:
    power = np.sum([_checkpoint(item, row)["power"] for item in items], axis=0)
    return ratio_over_antennas(
        power, np.sum([item["signal"] for item in items], axis=0), np.array(items[0]["antennas"])
    )


def _predicted(item: Mapping[str, Any], row: int) -> float:
    """Return the power that the solver predicts to leave, as if all of it were common, over that of the EoR."""
    even, odd = _checkpoint(item, row)["decrement_rms"]
    return even * odd / item["signal_rms"] ** 2
