"""Comparisons of calibrators in worlds: spectra of k, curves from one calibrator to the next, and variants."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle, product
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calstudy.figures import MOST, CasesFigure
from calstudy.plotting import style
from calstudy.products.comparison import Case
from calstudy.run.task import Job
from calstudy.verdicts.standing import SIGMAS, upper_limit

if TYPE_CHECKING:
    from matplotlib.lines import Line2D


LINEAR = {"recovered": 1.0, "bias": 0.1}
"""Upper end of the linear part of an axis; larger values make it logarithmic beyond."""
REFERENCE = {"recovered": 1.0, "bias": 0.0}
"""Position of the line: all of the EoR, no bias."""
SPECTRA = {"recovered": r"$P^R / P^S$", "bias": r"$s^2 P^{R_0} / P^S$"}
"""What is drawn, from left to right."""
DECADES = {"recovered": 1.5, "bias": 0.7}
"""Length of the linear part of a logarithmic axis, in decades."""
ROW_HEIGHT, LARGEST_K = 1.7, 1.0
CROSS: dict[str, Any] = {"color": style.BLACK, "marker": "x", "markersize": 7, "linestyle": "", "zorder": 3}
"""Marks cases of which most solves did not converge."""


def look(place: int) -> dict[str, Any]:
    """Return colour, marker and line of one of several calibrators or worlds."""
    again, place = divmod(place, len(style.SERIES))
    # A repeated colour has another marker.
    marker, _ = style.SERIES[(place + 3 * again) % len(style.SERIES)]
    return {"color": style.SERIES[place][1], "marker": marker, "linestyle": ("-", "--", ":")[again % 3]}


def is_unsettled(case: Case) -> bool:
    """Whether most solves of a case did not converge."""
    return case.converged < MOST


def cross_entries(cases: Mapping[str, Mapping[str, Case]]) -> list[Line2D]:
    """Return the entry of crosses for a legend, or none if no case has a cross."""
    crossed = any(is_unsettled(case) for found in cases.values() for case in found.values())
    return [style.entry(label="most solves did not converge", **CROSS)] if crossed else []


def draw_spectra(cases: Mapping[str, Mapping[str, Case]], calibrators: Sequence[str]) -> style.Figure:
    """Draw P^R / P^S on the left and s^2 P^R0 / P^S on the right against k, with 95 % bars, a row for each world."""
    figure = style.new_figure(style.TWO_COLUMNS, 0.6 + ROW_HEIGHT * len(cases))
    grid = figure.subplots(len(cases), 2, squeeze=False, sharex=True)
    for row, (world, found) in zip(grid, cases.items(), strict=True):
        for axes, (score, label) in zip(row, SPECTRA.items(), strict=True):
            for name, case in found.items():
                place = calibrators.index(name)
                shift = 0.15 * (place - (len(calibrators) - 1) / 2) / len(calibrators)
                _draw_points(axes, case, score, place, shift)
            _scale(axes, score, found.values())
            axes.axhline(REFERENCE[score], color=style.GREY, linewidth=0.7, zorder=0)
            axes.set_ylabel(label)
        row[0].set_title(world, loc="left")
    for axes in grid[-1]:
        axes.set_xlabel(style.WAVENUMBER)
    handles = [style.entry(linewidth=0.6, markersize=2.5, **look(place)) for place in range(len(calibrators))]
    figure.legend(handles, list(calibrators), loc="outside upper center", ncols=min(len(calibrators), 5))
    return figure


def _draw_points(axes: style.Axes, case: Case, name: str, place: int, shift: float) -> None:
    bins, used = case.bins, _used(case, name)
    k = (bins.k + shift * np.diff(bins.bin_edges))[used]
    values, errors = getattr(bins, name)[used], getattr(bins, f"{name}_error")[used]
    style.error_bars(axes, k, values, errors, elinewidth=0.5, linewidth=0.6, markersize=2.5, **look(place))


def _used(case: Case, name: str) -> np.ndarray:
    return np.isfinite(getattr(case.bins, name)) & (case.bins.k <= LARGEST_K)


def _scale(axes: style.Axes, name: str, cases: Iterable[Case]) -> None:
    """Make an axis logarithmic where its values are large, with limits just beyond them, zero and the reference.

    Bars may reach beyond the limits: the largest ones would make the other points too small to read.
    """
    values = np.array([value for case in cases for value in getattr(case.bins, name)[_used(case, name)]])
    if not values.size:
        return
    low, high = min(values.min(), 0.0), max(values.max(), REFERENCE[name])
    if max(-low, high) <= 2 * LINEAR[name]:
        return
    axes.set_yscale("symlog", linthresh=LINEAR[name], linscale=DECADES[name])
    transform = axes.yaxis.get_transform()
    bottom, top = transform.transform(np.array([low, high]))
    margin = 0.05 * (top - bottom)
    axes.set_ylim(*transform.inverted().transform(np.array([bottom - margin, top + margin])))


class ComparisonSpectra(CasesFigure):
    """P^R / P^S and s^2 P^R0 / P^S of every calibrator against k, a row for each world."""

    version: ClassVar[int] = 2

    kind: str = "comparison-spectra"
    caption = "Recovered power (left) and bias (right) outside the wedge in units of the EoR, with 95 % bars."
    scores = "bins"

    def draw_cases(self, cases: Mapping[str, Mapping[str, Case]], job: Job) -> style.Figure:
        """Draw all cases."""
        return draw_spectra(cases, job.settings["calibrators"])


LINEAR_BIAS = 0.01
"""Upper end of the linear part of the axis of the bias."""
LABEL_WIDTH = 10


def draw_curves(cases: Mapping[str, Mapping[str, Case]], calibrators: Sequence[str]) -> style.Figure:
    """Draw T above and the bias below for each band of k, calibrators from left to right, with 95 % bars."""
    worlds = list(cases)
    edges = next(case for found in cases.values() for case in found.values()).bands.bin_edges
    figure = style.new_figure(style.TWO_COLUMNS, 4.2)
    grid = figure.subplots(2, edges.size - 1, squeeze=False, sharex=True, sharey="row")
    for band, (upper, lower) in enumerate(grid.T):
        for place, found in enumerate(cases.values()):
            at = np.array([calibrators.index(name) for name in found])
            at = at + 0.3 * (place - (len(worlds) - 1) / 2) / len(worlds)
            for axes, name in ((upper, "transfer"), (lower, "bias")):
                draw_in_band(axes, at, list(found.values()), name, band, look(place))
        upper.set_title(style.band_name(*edges[band : band + 2]))
        upper.axhline(1, color=style.GREY, linewidth=0.7, zorder=0)
        lower.axhline(0, color=style.GREY, linewidth=0.7, zorder=0)
        lower.set_yscale("symlog", linthresh=LINEAR_BIAS)
        names = [textwrap.fill(name, LABEL_WIDTH, break_long_words=False) for name in calibrators]
        lower.set_xticks(range(len(calibrators)), names, fontsize=style.SMALL_SIZE, rotation=90)
    grid[0, 0].set_ylabel(r"$T$, free of the flux scale")
    grid[1, 0].set_ylabel(r"bias $s^2 P^{R_0} / P^S$")
    handles = [style.entry(linewidth=0.7, **look(place)) for place in range(len(worlds))]
    figure.legend(handles, worlds, loc="outside upper center", ncols=min(len(worlds), 5))
    return figure


def draw_in_band(
    axes: style.Axes, at: np.ndarray, cases: Sequence[Case], name: str, band: int, its: Mapping[str, Any]
) -> np.ndarray:
    """Draw a score of cases in a band of k with 95 % bars, and return its values."""
    columns = (name, f"{name}_error")
    values, errors = (np.array([getattr(case.bands, column)[band] for case in cases]) for column in columns)
    style.error_bars(axes, at, values, errors, elinewidth=0.6, linewidth=0.7, **its)
    return values


class ComparisonCurves(CasesFigure):
    """T and bias of calibrators that are values of one setting, in bands of k; a curve for each world."""

    version: ClassVar[int] = 2

    kind: str = "comparison-curves"
    caption = "Transfer function and bias outside the wedge from one calibrator to the next, with 95 % bars."

    def draw_cases(self, cases: Mapping[str, Mapping[str, Case]], job: Job) -> style.Figure:
        """Draw all cases."""
        return draw_curves(cases, job.settings["calibrators"])


BANDS = 2
"""Number of drawn bands of k, from the lowest: next to the wedge, and beyond."""
VARIANT_COLOURS = (style.ORANGE, style.BLUE, style.GREEN, style.MAGENTA, style.RED)
VARIANT_MARKERS = ("o", "s", "^", "D", "v")
VARIANT_HEIGHT, HEADING_HEIGHT = 0.21, 0.45
SPREAD = 0.7
"""Part of a row over which its symbols are spread."""
LOWEST = 1e-2
"""Lower end of the axis of a bias, unless a smaller one is drawn."""


def variants(labels: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return labels by the text before their last comma, and by the text after it; both in order."""
    found: dict[str, dict[str, str]] = {}
    for label in labels:
        name, comma, variant = label.rpartition(",")
        found.setdefault(name.strip() if comma else label, {})[variant.strip() if comma else ""] = label
    return found


def _names(groups: Mapping[str, Mapping[str, str]]) -> list[str]:
    return list(dict.fromkeys(variant for group in groups.values() for variant in group))


def draw_variants(cases: Mapping[str, Mapping[str, Case]], calibrators: Sequence[str]) -> style.Figure:
    """Draw a panel for each kind of world and band of k: calibrators from top to bottom, the bias from left to right.

    Colours are variants of calibrators, symbols those of worlds. Open symbols are 95 % upper limits of a bias that is
    within two standard deviations of zero; crosses mark cases of which most solves did not converge.
    """
    worlds, rows = variants(list(cases)), variants(calibrators)
    scored = {world: {name for label in kinds.values() for name in cases[label]} for world, kinds in worlds.items()}
    shown = {
        world: [name for name, labels in rows.items() if not names.isdisjoint(labels.values())]
        for world, names in scored.items()
    }
    heights = [HEADING_HEIGHT + VARIANT_HEIGHT * len(names) for names in shown.values()]
    figure = style.new_figure(style.TWO_COLUMNS, 0.8 + sum(heights))
    grid = figure.subplots(len(worlds), BANDS, squeeze=False, sharex="col", height_ratios=heights)
    edges = next(case for found in cases.values() for case in found.values()).bands.bin_edges
    colours = dict(zip(_names(rows), cycle(VARIANT_COLOURS), strict=False))
    markers = dict(zip(_names(worlds), cycle(VARIANT_MARKERS), strict=False))
    for panels, (world, kinds) in zip(grid, worlds.items(), strict=True):
        for band, axes in enumerate(panels):
            found = {kind: cases[label] for kind, label in kinds.items()}
            _draw_panel(axes, found, {name: rows[name] for name in shown[world]}, (colours, markers), band)
            axes.set_title(world if band == 0 else "", loc="left")
            axes.set_yticks(range(len(shown[world])), shown[world] if band == 0 else [])
    for band, axes in enumerate(grid[-1]):
        axes.set_xlabel(rf"bias $s^2\,|P^{{R_0}}| / P^S$, {style.band_name(*edges[band : band + 2])}")
    looks = [{"color": colour, "marker": "o", "label": name} for name, colour in colours.items()]
    looks += [{"color": style.GREY, "marker": marker, "label": name} for name, marker in markers.items()]
    looks += [{"color": style.GREY, "marker": "o", "markerfacecolor": "white", "label": "95 % upper limit"}]
    handles = [style.entry(linestyle="", **its) for its in looks] + cross_entries(cases)
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), columnspacing=1.0)
    return figure


def shown_bias(case: Case, band: int) -> tuple[float, bool]:
    """Return the size of the bias, or its upper limit and True if it is within two standard deviations of zero."""
    bias, error = float(case.bands.bias[band]), float(case.bands.bias_error[band])
    limited = bool(np.isfinite(error) and abs(bias) < SIGMAS * error)
    return upper_limit(bias, error) if limited else abs(bias), limited


def _draw_panel(
    axes: style.Axes,
    kinds: Mapping[str, Mapping[str, Case]],
    rows: Mapping[str, Mapping[str, str]],
    looks: tuple[Mapping[str, str], Mapping[str, str]],
    band: int,
) -> None:
    """Draw the variants of the calibrators of `rows`, with colours and markers by their names and those of worlds."""
    colours, markers = looks
    count = len(colours) * len(kinds)
    for row, labels in enumerate(rows.values()):
        for place, ((variant, label), (kind, cases)) in enumerate(product(labels.items(), kinds.items())):
            if label not in cases:
                continue
            shown, limited = shown_bias(cases[label], band)
            at = shown, row + SPREAD * ((place + 0.5) / count - 0.5)
            face = "white" if limited else colours[variant]
            axes.plot(*at, marker=markers[kind], linestyle="", color=colours[variant], markerfacecolor=face)
            if is_unsettled(cases[label]):
                # Below the symbols, so that open ones stay open.
                axes.plot(*at, **{**CROSS, "zorder": 1})
    axes.set_xscale("log")
    smallest = min((value for line in axes.lines for value in np.atleast_1d(line.get_xdata()) if value > 0), default=1)
    axes.set_xlim(left=min(LOWEST, smallest / 2))
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.axvline(1, color=style.GREY, linewidth=0.7, linestyle="--", zorder=0)
    for edge in np.arange(len(rows) - 1) + 0.5:
        axes.axhline(edge, color=style.BAND, linewidth=0.4, zorder=0)
    axes.tick_params(axis="y", length=0)


class ComparisonVariants(CasesFigure):
    """Bias of calibrators in variants and in variants of worlds: of labels such as ``sky-based, autos``."""

    version: ClassVar[int] = 6

    kind: str = "comparison-variants"
    caption = (
        "Bias of every calibrator, by its variants (colours) and those of the worlds (symbols), next to the wedge and "
        "beyond. The dashed line is the EoR; open symbols are 95 % upper limits, and crosses mark cases of which "
        "most solves did not converge."
    )

    def draw_cases(self, cases: Mapping[str, Mapping[str, Case]], job: Job) -> style.Figure:
        """Draw all cases."""
        return draw_variants(cases, job.settings["calibrators"])
