"""Bias of calibrators in variants, such as their weights, and in variants of worlds, such as the kind of gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from calstudy.figures import CasesFigure
from calstudy.plotting import style
from calstudy.products.comparison import Case
from calstudy.products.tolerances import SIGMAS, upper_limit
from calstudy.run.task import Job

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BANDS = 2
"""Number of drawn bands of k, from the lowest: next to the wedge, and beyond."""
COLOURS = (style.ORANGE, style.BLUE, style.GREEN, style.MAGENTA, style.RED)
MARKERS = ("o", "s", "^", "D", "v")
ROW_HEIGHT, HEADING_HEIGHT = 0.21, 0.45
SPREAD = 0.7
"""Part of a row over which its symbols are spread."""
LOWEST = 1e-2


def variants(labels: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return labels by the text before their last comma, and by the text after it; both in order."""
    found: dict[str, dict[str, str]] = {}
    for label in labels:
        name, comma, variant = label.rpartition(",")
        found.setdefault(name.strip() if comma else label, {})[variant.strip() if comma else ""] = label
    return found


def _names(groups: Mapping[str, Mapping[str, str]]) -> list[str]:
    return list(dict.fromkeys(variant for group in groups.values() for variant in group))


@style.journal_style()
def draw_variants(
    cases: Mapping[str, Mapping[str, Case]], calibrators: Sequence[str], stand_ins: Sequence[str] = ()
) -> Figure:
    """Draw a panel for each kind of world and band of k: calibrators from top to bottom, the bias from left to right.

    Colours are variants of calibrators, symbols those of worlds: the text after the last comma of a label names the
    variant. Open symbols are 95 % upper limits of a bias that is within two standard deviations of zero; crosses are
    cases of which most solves stalled or failed. `cases` are by world and calibrator.
    """
    from matplotlib.lines import Line2D

    worlds, rows = variants(list(cases)), variants(calibrators)
    shown = {
        world: [name for name, labels in rows.items() if _drawn(labels, [cases[label] for label in kinds.values()])]
        for world, kinds in worlds.items()
    }
    heights = [HEADING_HEIGHT + ROW_HEIGHT * len(names) for names in shown.values()]
    figure = style.new_figure(style.TWO_COLUMNS, 0.8 + sum(heights))
    grid = figure.subplots(len(worlds), BANDS, squeeze=False, sharex="col", height_ratios=heights)
    edges = next(case for found in cases.values() for case in found.values()).bands.bin_edges
    colours = dict(zip(_names(rows), COLOURS, strict=False))
    markers = dict(zip(_names(worlds), MARKERS, strict=False))
    for panels, (world, kinds) in zip(grid, worlds.items(), strict=True):
        for band, axes in enumerate(panels):
            _draw_panel(axes, {kind: cases[label] for kind, label in kinds.items()}, rows, shown[world], band)
            axes.set_title(world if band == 0 else "", loc="left")
            axes.set_yticks(range(len(shown[world])), shown[world] if band == 0 else [])
    for band, axes in enumerate(grid[-1]):
        low, high = edges[band : band + 2]
        axes.set_xlabel(rf"bias $s^2\,|P^{{R_0}}| / P^S$, $k = {low:g}$–${high:g}$ $h\,\mathrm{{Mpc}}^{{-1}}$")
    handles = [Line2D([], [], color=colour, marker="o", linestyle="", label=name) for name, colour in colours.items()]
    handles += [
        Line2D([], [], color=style.GREY, marker=marker, linestyle="", label=name) for name, marker in markers.items()
    ]
    handles += [
        Line2D([], [], color=style.GREY, marker="o", markerfacecolor="white", linestyle="", label="95 % upper limit"),
        Line2D([], [], color=style.GREY, marker="x", linestyle="", label="stalled"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    style.note_stand_ins(figure, stand_ins)
    return figure


def _drawn(labels: Mapping[str, str], worlds: Sequence[Mapping[str, Case]]) -> bool:
    return any(label in world for label in labels.values() for world in worlds)


def _stalled(case: Case) -> bool:
    """Return True if most solves of a case stalled or failed."""
    counts = case.summary["by_status"]
    return 2 * (counts.get("stalled", 0) + counts.get("failed", 0)) > sum(counts.values())


def _draw_panel(
    axes: Axes,
    kinds: Mapping[str, Mapping[str, Case]],
    rows: Mapping[str, Mapping[str, str]],
    shown: Sequence[str],
    band: int,
) -> None:
    colours, count = dict(zip(_names(rows), COLOURS, strict=False)), len(_names(rows)) * len(kinds)
    for row, name in enumerate(shown):
        for place, (variant, label) in enumerate(rows[name].items()):
            for number, (marker, cases) in enumerate(zip(MARKERS, kinds.values(), strict=False)):
                if label not in cases:
                    continue
                bands = cases[label].bands
                bias, error = float(bands.bias[band]), float(bands.bias_error[band])
                limited = bool(np.isfinite(error)) and abs(bias) < SIGMAS * error
                axes.plot(
                    upper_limit(bias, error) if limited else abs(bias),
                    row + SPREAD * ((place * len(kinds) + number + 0.5) / count - 0.5),
                    marker="x" if _stalled(cases[label]) else marker,
                    linestyle="",
                    color=colours[variant],
                    markerfacecolor="white" if limited else colours[variant],
                )
    axes.set_xscale("log")
    axes.set_xlim(left=LOWEST)
    axes.set_ylim(len(shown) - 0.5, -0.5)
    axes.axvline(1, color=style.GREY, linewidth=0.7, linestyle="--", zorder=0)
    for edge in np.arange(len(shown) - 1) + 0.5:
        axes.axhline(edge, color=style.BAND, linewidth=0.4, zorder=0)
    axes.tick_params(axis="y", length=0)


class ComparisonVariants(CasesFigure):
    """Bias of calibrators in variants and in variants of worlds: of labels such as ``sky-based, autos``."""

    version: ClassVar[int] = 2
    caption = (
        "Bias of every calibrator, by its variants (colours) and those of the worlds (symbols), next to the wedge and "
        "beyond. The dashed line is the EoR; open symbols are 95 % upper limits, crosses "
        "cases of which most solves stalled."
    )

    def draw_cases(self, cases: Mapping[str, Mapping[str, Case]], job: Job) -> Figure:
        """Draw all cases."""
        return draw_variants(cases, job.settings["calibrators"], job.settings["notes"])
