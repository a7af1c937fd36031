"""The bias of the residual power against the steps of a solver."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, ClassVar

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

BIAS = r"$|P^{R}|\,/\,P^{S}$, no EoR in the data"
LOWEST = 1e-3
TOTAL = r"$P^{R}/P^{S}$, EoR in the data"


@dataclass(frozen=True)
class ConvergencePath:
    """Power common to even and odd residuals after a number of steps of a solver, over the power of the EoR.

    `bias` is without EoR in the data, `with_eor` with it; `predicted` is the power that corresponds to the solver's own
    distance from the minimum, (Ncheckpoints,).
    """

    solver: str
    steps: np.ndarray
    bias: np.ndarray
    bias_error: np.ndarray
    with_eor: np.ndarray
    with_eor_error: np.ndarray
    predicted: np.ndarray


def draw_convergence(paths: Sequence[ConvergencePath], integrations: Sequence[int]) -> style.Figure:
    """Draw the bias without EoR on the left, and with EoR on the right, against the steps of solvers.

    Bars are 95 % by leaving out antennas; open markers are negative; dashes are what the solver predicts.
    """
    from matplotlib.ticker import StrMethodFormatter

    figure = style.new_figure(style.TWO_COLUMNS, 3.0)
    left, right = figure.subplots(1, 2)
    for path, (marker, colour) in zip(paths, style.SERIES, strict=False):
        look = {"fmt": marker, "color": colour, "elinewidth": 0.7}
        _draw_path(left, path, path.bias, path.bias_error, look)
        left.plot(path.steps, np.where(path.predicted > 0, path.predicted, np.nan), color=colour, linestyle="--")
        _draw_path(right, path, path.with_eor, path.with_eor_error, look)
    left.plot([], [], color=style.GREY, linestyle="--", label="predicted where it stopped")
    for axes, label in ((left, BIAS), (right, TOTAL)):
        axes.axhline(1.0, color=style.GREY, linewidth=0.7, zorder=0)
        axes.set(xscale="log", yscale="log", xlabel="step", ylabel=label)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    left.set_ylim(bottom=max(LOWEST, left.get_ylim()[0]))
    left.legend(loc="lower right")
    right.legend(loc="upper right")
    solved = f"{len(integrations)} integration{'s' if len(integrations) > 1 else ''}"
    figure.suptitle(f"even x odd outside the wedge, {solved}, each solved from unity gains", fontsize=8.5)
    return figure


def _draw_path(
    axes: style.Axes, path: ConvergencePath, power: np.ndarray, error: np.ndarray, look: dict[str, Any]
) -> None:
    size, reach = np.abs(power), SIGMAS_95 * error
    axes.plot(path.steps, size, color=look["color"], linewidth=0.8)
    # Bars that reach below zero have no lower end on this scale.
    bars = np.array([np.minimum(reach, 0.999 * size), reach])
    for chosen, its in (
        (power > 0, {"markerfacecolor": look["color"], "label": path.solver}),
        (~(power > 0), {"markerfacecolor": "white"}),
    ):
        axes.errorbar(path.steps[chosen], size[chosen], bars[:, chosen], **look, **its)


COLUMNS = ("solver", "steps", "bias", "bias error", "with EoR", "with EoR error", "predicted")


class Convergence(StudyFigure):
    """The bias of the residual power against the steps of several solvers, with convergence.csv."""

    version: ClassVar[int] = 2

    kind: str = "convergence"

    caption = "What solvers leave of the foregrounds in even and odd alike, against their steps, over the EoR."
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
        solvers = graph.experiment.outputs.convergence.solvers.items()
        kinds = tuple(zip(("with", "without"), SIGNAL_LOSS_VARIANTS, strict=False))
        return {
            f"{label} {kind} {integration}": followed(graph, variant, solver, integration)
            for (label, solver), (kind, variant), integration in product(solvers, kinds, self._integrations(graph))
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
            solver, *columns = vars(path).values()
            rows += [[solver, *row] for row in zip(*(column.tolist() for column in columns), strict=True)]
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
    longest = max((item["checkpoints"] for items in found.values() for item in items), key=len)
    rows = range(len(longest))
    (bias, bias_error), (with_eor, with_eor_error) = (
        np.array([_ratio(items, row) for row in rows]).T for items in found.values()
    )
    predicted = np.array([np.mean([_predicted(item, row) for item in found["without"]]) for row in rows])
    steps = np.array([max(row["steps"]) for row in longest])
    return ConvergencePath(label, steps, bias, bias_error, with_eor, with_eor_error, predicted)


def _checkpoint(item: Mapping[str, Any], row: int) -> Mapping[str, Any]:
    return item["checkpoints"][min(row, len(item["checkpoints"]) - 1)]


def _ratio(items: Sequence[Mapping[str, Any]], row: int) -> tuple[float, float]:
    power = np.sum([_checkpoint(item, row)["power"] for item in items], axis=0)
    signal = np.sum([item["signal"] for item in items], axis=0)
    return ratio_over_antennas(power, signal, np.array(items[0]["antennas"]))


def _predicted(item: Mapping[str, Any], row: int) -> float:
    """Return the power that the solver predicts to leave, as if all of it were common, over that of the EoR."""
    even, odd = _checkpoint(item, row)["decrement_rms"]
    return even * odd / item["signal_rms"] ** 2
