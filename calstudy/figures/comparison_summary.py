"""Bias and T of calibrators in bands of k: a matrix of worlds, and tolerances against the severity of faults."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.table import number
from calstudy.figures import CasesFigure
from calstudy.figures.comparison import CROSS, cross_entries, draw_in_band, is_unsettled, look, shown_bias
from calstudy.plotting import style
from calstudy.power.score import HEADLINE_BAND
from calstudy.products.comparison import Case
from calstudy.products.tolerances import Fault, faults
from calstudy.run.task import Job
from calstudy.verdicts.standing import LIMIT, is_measured

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable


LIMITS, COLOURS = (1e-2, 1e2), "YlOrRd"
"""Limits of the bias, and the scale of colours between them."""
DARK = 10.0
"""Bias above which the text is white."""
ROW_HEIGHT, HEADING_HEIGHT = 0.3, 0.45
LABELS_WIDTH = 72
"""Number of characters that fit below the matrix."""
FAINT = (1, 1, 1, 0.45)
"""Colour of the hatching, over which text can be read on any cell."""
LARGE_ERROR = 0.1
"""Largest standard deviation of T that is written with two decimals alone; a larger one would make it look exact."""
ROOM_FOR_ERROR = 8
"""Largest number of columns in whose cells T fits with its error; with more, it has one decimal."""
MAX_COLUMNS = 11
"""Largest number of worlds side by side; more are one below the other, and calibrators are the columns."""


def draw_matrix(cases: Mapping[str, Mapping[str, Case]], calibrators: Sequence[str]) -> style.Figure:
    """Draw a matrix for each band of k: worlds from left to right, or from top to bottom where they are many.

    The colour is the bias, or for one within two standard deviations of zero the 95 % upper limit, and the cell is
    hatched. A star marks a case of which most solves did not converge; one without scores is left white.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    columns, rows = list(cases), list(calibrators)
    cells = [[found.get(name) for found in cases.values()] for name in rows]
    if turned := len(rows) < len(columns) and len(columns) > MAX_COLUMNS:
        columns, rows, cells = rows, columns, [list(row) for row in zip(*cells, strict=True)]
    edges = next(case for found in cases.values() for case in found.values()).bands.bin_edges
    n_bands = edges.size - 1
    # Bands are side by side where worlds are the rows, and few calibrators the columns.
    across = n_bands if turned and n_bands * len(columns) <= MAX_COLUMNS else 1
    height = n_bands // across * (HEADING_HEIGHT + ROW_HEIGHT * len(rows)) + 0.4
    width = style.TWO_COLUMNS if across * len(columns) > 2 else style.ONE_COLUMN + 1
    figure = style.new_figure(width, height)
    panels = figure.subplots(n_bands // across, across, squeeze=False, sharex=True, sharey=True)
    shades = ScalarMappable(LogNorm(*LIMITS), COLOURS)
    for band, axes in enumerate(panels.flat):
        _draw_band(axes, cells, band, shades, across * len(columns))
        axes.set_yticks(range(len(rows)), rows)
        axes.set_title(style.band_name(*edges[band : band + 2]), loc="left")
    for axes in panels[-1]:
        _name_columns(axes, columns, LABELS_WIDTH // (across * len(columns)))
    bar = figure.colorbar(shades, ax=panels, extend="both", aspect=40, pad=0.01)
    star = "; *: most solves did not converge" if any(_stars(case) for row in cells for case in row) else ""
    bar.set_label(r"bias $s^2\,|P^{R_0}| / P^S$; hatched: upper limit" + star)
    return figure


def _stars(case: Case | None) -> str:
    """Return a star if most solves of a case did not converge."""
    return "*" if case is not None and is_unsettled(case) else ""


def _name_columns(axes: style.Axes, labels: Sequence[str], width: int) -> None:
    """Write the labels of the columns, in lines of so many characters or, if words are longer, slanted."""
    if max(len(word) for label in labels for word in label.split()) <= width:
        axes.set_xticks(range(len(labels)), [textwrap.fill(label, width) for label in labels])
    else:
        axes.set_xticks(range(len(labels)), labels, rotation=30, ha="right", rotation_mode="anchor")


def _draw_band(
    axes: style.Axes, cells: Sequence[Sequence[Case | None]], band: int, shades: ScalarMappable, n_columns: int
) -> None:
    from matplotlib.patches import Rectangle

    colours = np.full((len(cells), len(cells[0]), 4), 1.0)
    centred: dict[str, Any] = {"ha": "center", "va": "center", "size": style.SMALL_SIZE}
    for (row, column), case in np.ndenumerate(np.array(cells, dtype=object)):
        if case is None:
            axes.text(column, row, "no scores", color=style.GREY, **centred)
            continue
        shown, limited = shown_bias(case, band)
        if np.isfinite(shown):
            colours[row, column] = shades.to_rgba(np.asarray(shown))
        if limited:
            axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, hatch="////", ec=FAINT, lw=0))
        bias = f"bias < {_digits(shown)}" if limited else f"bias {_digits(case.bands.bias[band])}"
        transfer = _transfer(case.bands.transfer[band], case.bands.transfer_error[band], n_columns)
        colour = "white" if shown > DARK else style.BLACK
        axes.text(column, row, f"{bias}{_stars(case)}\n{transfer}", color=colour, linespacing=1.1, **centred)
    axes.imshow(colours, aspect="auto")
    axes.tick_params(length=0)


def _transfer(value: float, error: float, n_columns: int) -> str:
    if not is_measured(value, error):
        return "no $T$"
    if not (np.isfinite(error) and error > LARGE_ERROR):
        return f"$T$ = {value:.2f}"
    return f"$T$ = {number(value, error) if n_columns <= ROOM_FOR_ERROR else f'{value:.1f}'}"


def _digits(value: float) -> str:
    if not np.isfinite(value):
        return "–"
    if abs(value) >= 1e4:
        return f"{value:.0e}".replace("e+0", "e")
    return f"{value:.0f}" if abs(value) >= 99.5 else f"{value:.2g}"


class ComparisonMatrix(CasesFigure):
    """A matrix of calibrators and worlds for each band of k: colour and number are the bias, T is written below it."""

    version: ClassVar[int] = 6

    kind: str = "comparison-matrix"
    caption = (
        "Bias of every calibrator in every world, in units of the EoR (< and hatched: 95 % upper limit), and the part "
        "T of the EoR that is left, if it was measured. Where most solves did not converge, a star says so."
    )

    def draw_cases(self, cases: Mapping[str, Mapping[str, Case]], job: Job) -> style.Figure:
        """Draw all cases."""
        return draw_matrix(cases, job.settings["calibrators"])


FAULT_HEIGHT = 1.7
LINEAR = 0.01
"""The axis of the bias is linear up to this, and logarithmic beyond."""
ZERO = 0.3
"""Where severity zero is drawn, relative to the lowest other one."""


def draw_tolerances(
    found: Sequence[Fault],
    cases: Mapping[str, Mapping[str, Case]],
    calibrators: Sequence[str],
    eor_level: float | None = None,
) -> style.Figure:
    """Draw bias (left) and T (right) in the band of the headline against the severity of each fault, with 95 % bars.

    The dashed line is the bias that is tolerated; crosses are over cases of which most solves did not converge. The
    level of the EoR, dB of amplitude over the foregrounds, is None if cases differ in it, or it is not known.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 0.6 + FAULT_HEIGHT * len(found))
    grid = figure.subplots(len(found), 2, squeeze=False)
    for (left, right), fault in zip(grid, found, strict=True):
        for place, calibrator in enumerate(calibrators):
            scored = [cases[world].get(calibrator) for world in fault.worlds]
            _draw_points(left, fault, scored, "bias", place)
            _draw_points(right, fault, scored, "transfer", place)
        left.set_yscale("symlog", linthresh=LINEAR)
        left.axhline(LIMIT, color=style.GREY, linewidth=0.7, linestyle="--", zorder=0)
        right.axhline(1, color=style.GREY, linewidth=0.7, zorder=0)
        left.set_ylabel(r"bias $s^2 P^{R_0} / P^S$")
        right.set_ylabel(r"$T$")
        for axes in (left, right):
            axes.set_xscale("log")
            axes.set_xlabel(f"{fault.name} ({fault.unit})" if fault.unit else fault.name)
            positions = _positions(fault)
            axes.set_xticks(positions, [f"{severity:g}" for severity in fault.severities])
            axes.set_xticks([], minor=True)
    level = "" if eor_level is None else rf", EoR at ${eor_level:g}$ dB of the foregrounds"
    grid[0, 0].set_title(style.band_name(*HEADLINE_BAND) + level, loc="left")
    drawn = {name for found in cases.values() for name in found}
    looks = [{"label": name, **look(place)} for place, name in enumerate(calibrators) if name in drawn]
    handles = [style.entry(linewidth=0.7, **its) for its in looks] + cross_entries(cases)
    figure.legend(handles=handles, loc="outside upper center", ncols=min(len(handles), 5))
    return figure


def _positions(fault: Fault) -> np.ndarray:
    severities = np.array(fault.severities)
    return np.where(severities > 0, severities, ZERO * severities[severities > 0].min())


def _draw_points(axes: style.Axes, fault: Fault, cases: Sequence[Case | None], name: str, place: int) -> None:
    found = [case for case in cases if case is not None]
    if not found:
        return
    band = int(np.argmin(np.abs(found[0].bands.bin_edges[:-1] - HEADLINE_BAND[0])))
    positions = _positions(fault)[[case is not None for case in cases]]
    values = draw_in_band(axes, positions, found, name, band, look(place))
    lost = [is_unsettled(case) for case in found]
    axes.plot(positions[lost], values[lost], **CROSS)


class ComparisonTolerances(CasesFigure):
    """Bias and T against the severity of each fault: of worlds with labels such as ``positions: 2 cm``."""

    version: ClassVar[int] = 5

    kind: str = "comparison-tolerances"
    caption = (
        "Bias (left) and transfer function (right) against the severity of faults, with 95 % bars. The bias is in "
        "units of the EoR, whose level is written above."
    )
    sections = ("corruption.eor_level",)

    def draw_cases(self, cases: Mapping[str, Mapping[str, Case]], job: Job) -> style.Figure:
        """Draw a row for each fault; raises InputError if the worlds name none."""
        found = faults(job.settings["worlds"])
        if not found:
            raise InputError(
                f"figure {self.label!r}: no world has a label with a fault and a number, such as 'positions: 2 cm'"
            )
        return draw_tolerances(found, cases, job.settings["calibrators"], job.settings.get("eor_level"))
