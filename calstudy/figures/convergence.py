"""The bias of the residual power against the steps that a solver took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from calstudy.figures import style
from calstudy.figures.signal_loss import SIGMAS_95

SERIES = (("o", style.BLUE), ("s", style.ORANGE), ("D", style.GREEN), ("^", style.MAGENTA), ("v", style.RED))
BIAS = r"$|P^{R}|\,/\,P^{S}$, no EoR in the data"
LOWEST = 1e-3
TOTAL = r"$P^{R}/P^{S}$, EoR in the data"


@dataclass(frozen=True)
class ConvergencePath:
    """What even and odd residuals have in common after so many steps of a solver, over the power of the EoR.

    Attributes
    ----------
    solver
        Its name.
    steps
        (Ncheckpoints,) ascending.
    bias, bias_error
        Without EoR in the data, and its standard deviation, (Ncheckpoints,).
    with_eor, with_eor_error
        The same with EoR in the data.
    predicted
        The power that the solver's own distance from the minimum allows for, (Ncheckpoints,).
    """

    solver: str
    steps: np.ndarray
    bias: np.ndarray
    bias_error: np.ndarray
    with_eor: np.ndarray
    with_eor_error: np.ndarray
    predicted: np.ndarray


@style.journal_style()
def draw_convergence(
    paths: Sequence[ConvergencePath], integrations: Sequence[int], stand_ins: Sequence[str] = ()
) -> Figure:
    """Draw the bias without EoR on the left, and with EoR on the right, against steps.

    Bars are 95 % (1.96 sigma, leaving out one antenna after the other); open markers are negative. Dashes are what the
    solver predicts from where it stopped.

    Parameters
    ----------
    paths
        One for each solver, at most five.
    integrations
        Which were solved, for the title.
    stand_ins
        See `calstudy.figures.style.note_stand_ins`.

    Raises
    ------
    ValueError
        If there is no path.
    """
    if not paths:
        raise ValueError("a figure of convergence has no solver, expected at least one")
    figure = style.new_figure(style.TWO_COLUMNS, 3.0)
    left, right = figure.subplots(1, 2)
    for path, (marker, colour) in zip(paths, SERIES, strict=False):
        _draw_bias(left, path, marker, colour)
        right.errorbar(
            path.steps,
            path.with_eor,
            SIGMAS_95 * path.with_eor_error,
            fmt=marker + "-",
            color=colour,
            label=path.solver,
        )
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
    style.note_stand_ins(figure, stand_ins)
    return figure


def _draw_bias(axes: Axes, path: ConvergencePath, marker: str, colour: str) -> None:
    size = np.abs(path.bias)
    axes.plot(path.steps, size, color=colour, linewidth=0.8)
    # Bars that reach below zero have no lower end on this scale.
    reach = SIGMAS_95 * path.bias_error
    lower = np.minimum(reach, 0.999 * size)
    for positive in (True, False):
        chosen = (path.bias > 0) == positive
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
    axes.plot(path.steps, np.where(path.predicted > 0, path.predicted, np.nan), color=colour, linestyle="--")
