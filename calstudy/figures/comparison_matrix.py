"""Bias and transfer function of calibrators in worlds, as a matrix for each band of k."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from calstudy.base.table import number
from calstudy.figures import CasesFigure
from calstudy.plotting import style
from calstudy.products.comparison import Case
from calstudy.products.tolerances import SIGMAS, upper_limit
from calstudy.run.task import Job

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

LIMITS, COLOURS = (1e-2, 1e2), "YlOrRd"
"""Limits of the bias, and the scale of colours between them."""
DARK = 10.0
"""Bias above which the text is white."""
ROW_HEIGHT, HEADING_HEIGHT = 0.3, 0.45
LABELS_WIDTH = 72
"""Number of characters that fit below the matrix."""
LARGE_ERROR = 0.1
"""Largest standard deviation of T that is written with two decimals alone; a larger one would make it look exact."""
ABSURD = 10.0
"""T from which on gains are no solution, and only its order of magnitude is written."""
ROOM_FOR_ERROR = 8
"""Largest number of worlds side by side in whose cells T fits with its error; with more, it has one decimal."""


@style.journal_style()
def draw_matrix(
    cases: Mapping[str, Mapping[str, Case]], calibrators: Sequence[str], stand_ins: Sequence[str] = ()
) -> Figure:
    """Draw a matrix for each band of k: worlds from left to right, calibrators from top to bottom.

    The colour is the bias. For a bias within two standard deviations of zero, the 95 % upper limit is written and
    coloured. `cases` are by world and calibrator; a case without scores is left white and labelled.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    worlds = list(cases)
    edges = next(case for found in cases.values() for case in found.values()).bands.bin_edges
    n_bands = edges.size - 1
    height = n_bands * (HEADING_HEIGHT + ROW_HEIGHT * len(calibrators)) + 0.4
    figure = style.new_figure(style.TWO_COLUMNS if len(worlds) > 2 else style.ONE_COLUMN + 1, height)
    panels = figure.subplots(n_bands, 1, squeeze=False, sharex=True)[:, 0]
    shades = ScalarMappable(LogNorm(*LIMITS), COLOURS)
    for band, axes in enumerate(panels):
        _draw_band(axes, cases, calibrators, band, shades)
        axes.set_title(rf"$k = {edges[band]:g}$–${edges[band + 1]:g}$ $h\,\mathrm{{Mpc}}^{{-1}}$", loc="left")
    _name_worlds(panels[-1], worlds)
    bar = figure.colorbar(shades, ax=panels, extend="both", aspect=40, pad=0.01)
    bar.set_label(r"bias $s^2\,|P^{R_0}| / P^S$")
    style.note_stand_ins(figure, stand_ins)
    return figure


def _name_worlds(axes: Axes, worlds: Sequence[str]) -> None:
    """Write the labels of the columns, in several lines or, if words are wider than a column, slanted."""
    width = LABELS_WIDTH // len(worlds)
    if max(len(word) for world in worlds for word in world.split()) <= width:
        axes.set_xticks(range(len(worlds)), [textwrap.fill(world, width) for world in worlds])
    else:
        axes.set_xticks(range(len(worlds)), worlds, rotation=30, ha="right", rotation_mode="anchor")


def _draw_band(
    axes: Axes,
    cases: Mapping[str, Mapping[str, Case]],
    calibrators: Sequence[str],
    band: int,
    shades: ScalarMappable,
) -> None:
    colours = np.full((len(calibrators), len(cases), 4), 1.0)
    for column, found in enumerate(cases.values()):
        for row, name in enumerate(calibrators):
            if name not in found:
                axes.text(column, row, "no scores", ha="center", va="center", size=style.SMALL_SIZE, color=style.GREY)
                continue
            case = found[name]
            bands = case.bands
            shown, bias = _bias(bands.bias[band], bands.bias_error[band])
            if np.isfinite(shown):
                colours[row, column] = shades.to_rgba(np.asarray(shown))
            axes.text(
                column,
                row,
                f"{bias}\n$T$ = {_transfer(bands.transfer[band], bands.transfer_error[band], len(cases))}",
                ha="center",
                va="center",
                fontsize=style.SMALL_SIZE,
                color="white" if shown > DARK else style.BLACK,
                linespacing=1.1,
            )
    axes.imshow(colours, aspect="auto")
    axes.set_yticks(range(len(calibrators)), calibrators)
    axes.tick_params(length=0)


def _bias(bias: float, error: float) -> tuple[float, str]:
    """Return the size that is coloured, the bias or its upper limit, and the text."""
    if np.isfinite(error) and abs(bias) < SIGMAS * error:
        limit = upper_limit(bias, error)
        return limit, f"bias < {_digits(limit)}"
    return abs(bias), f"bias {_digits(bias)}"


def _transfer(value: float, error: float, n_worlds: int) -> str:
    if not np.isfinite(value):
        return "–"
    if abs(value) >= ABSURD:
        return _digits(value)
    if not (np.isfinite(error) and error > LARGE_ERROR):
        return f"{value:.2f}"
    return number(value, error) if n_worlds <= ROOM_FOR_ERROR else f"{value:.1f}"


def _digits(value: float) -> str:
    if not np.isfinite(value):
        return "–"
    if abs(value) >= 1e4:
        return f"{value:.0e}".replace("e+0", "e")
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"


class ComparisonMatrix(CasesFigure):
    """A matrix of calibrators and worlds for each band of k: colour and number are the bias, T is written below it."""

    version: ClassVar[int] = 3
    caption = (
        "Bias of every calibrator in every world, in units of the EoR (<: 95 % upper limit), and the part T of the EoR "
        "that is left."
    )

    def draw_cases(self, cases: Mapping[str, Mapping[str, Case]], job: Job) -> Figure:
        """Draw all cases."""
        return draw_matrix(cases, job.settings["calibrators"], job.settings["notes"])
