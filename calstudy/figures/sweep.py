"""Signal loss against the varied fields: one panel per block of a sweep."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from calstudy.experiment.files import short_names
from calstudy.figures import Drawing, StudyFigure
from calstudy.figures.signal_loss import TRANSFER
from calstudy.plotting import style
from calstudy.power.transfer import TransferFunction, pool
from calstudy.products import signal_loss
from calstudy.results.reader import Tables
from calstudy.run.task import Job

SKIES = "sky.eor.seed"
"""The field whose values are further samples of the same EoR, to be pooled."""
COLUMNS = 2
PANEL_HEIGHT = 1.9
LABEL_WIDTH = 15
"""Number of characters of a value in one line below its points."""


@dataclass(frozen=True)
class SweepPanel:
    """T outside the wedge for the values of a varied field; `note` names other changes, and may be empty."""

    field: str
    note: str
    values: list[str]
    transfers: list[TransferFunction]


def draw_sweep(panels: Sequence[SweepPanel]) -> style.Figure:
    """Draw T outside the wedge in bands of k, with 95 % bars, against the values of every varied field.

    Dashes are T free of the flux scale, which is written above each value (see `calstudy.power.transfer`). There are at
    most five bands of k, the same in all panels.
    """
    edges = panels[0].transfers[0].bin_edges
    columns = min(COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    width = style.ONE_COLUMN if columns == 1 else style.TWO_COLUMNS
    figure = style.new_figure(width, 0.5 + PANEL_HEIGHT * rows)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    drawn = np.concatenate([item.transfer for panel in panels for item in panel.transfers])
    # Leave room for the flux scale above the points.
    limits = 1.1 * float(np.nanmin(drawn, initial=0.0)), max(1.2, 1.15 * float(np.nanmax(drawn, initial=0.0)))
    for axes, panel in zip(grid.flat, panels, strict=False):
        _draw_panel(axes, panel)
        axes.set_ylim(limits)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    for axes in grid[:, 0]:
        axes.set_ylabel(TRANSFER)
    labels = [rf"$k = {low:g}$–${high:g}$" for low, high in itertools.pairwise(edges)]
    labels[-1] += r" $h\,\mathrm{Mpc}^{-1}$"
    labels.append("free of the flux scale $s$")
    scale_free = style.entry(color=style.GREY, marker="_", markersize=7, linestyle=":", linewidth=0.6)
    handles: list[Any] = [*grid.flat[0].containers, scale_free]
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels) if columns > 1 else 2)
    return figure


def _draw_panel(axes: style.Axes, panel: SweepPanel) -> None:
    bands = panel.transfers[0].k.size
    positions = np.arange(len(panel.values))
    for band, (marker, colour) in enumerate(style.SERIES[:bands]):
        columns = ("transfer", "transfer_error", "scale_free_transfer")
        values, errors, scale_free = np.array(
            [[getattr(item, name)[band] for item in panel.transfers] for name in columns]
        )
        known = np.isfinite(values)
        at = positions + 0.1 * (band - (bands - 1) / 2)
        style.error_bars(axes, at[known], values[known], errors[known], fmt=marker, color=colour)
        axes.plot(at, scale_free, "_", color=colour, markersize=7, linestyle=":", linewidth=0.6)
    above: dict[str, Any] = {"xytext": (0, -2), "xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
    look: dict[str, Any] = {"ha": "center", "va": "top", "fontsize": style.SMALL_SIZE, "color": style.GREY}
    for position, item in zip(positions, panel.transfers, strict=True):
        axes.annotate(f"$s$ = {item.flux_scale:.3f}", (position, 1), **above, **look)
    axes.axhline(1.0, color=style.GREY, linewidth=0.7, zorder=0)
    axes.set_xlim(-0.5, len(panel.values) - 0.5)
    axes.set_xticks(positions, [textwrap.fill(text, LABEL_WIDTH) for text in panel.values], fontsize=style.SMALL_SIZE)
    axes.tick_params(axis="x", length=0)
    axes.set_xlabel(panel.field)
    axes.set_title(panel.note)


class Sweep(StudyFigure):
    """The signal loss of all points of a sweep."""

    kind: str = "sweep"

    of = ("sweep",)
    caption = "Signal loss outside the wedge against what was varied, in bands of k, with 95 % bars."
    reads: ClassVar = {"": signal_loss.transfer}

    def draw(self, job: Job) -> Drawing:
        """Draw T against the varied fields."""
        panels = [_panel(block, job.inputs) for block in job.settings["blocks"]]
        return Drawing(draw_sweep(panels), {"panels": panels})


def _panel(block: Sequence[Mapping[str, Any]], folders: Mapping[str, Path]) -> Any:
    """Return one block as a panel: a category per combination of values, with its EoR skies pooled."""
    fields = list(block[0]["changes"])
    varied = [field for field in fields if len({point["changes"][field] for point in block}) > 1] or fields[:1]
    shown = [field for field in varied if field != SKIES] or varied
    groups: dict[tuple[str, ...], list[TransferFunction]] = {}
    for point in block:
        category = tuple(point["changes"][field] for field in shown)
        tables = Tables((folders[point["label"]],))
        groups.setdefault(category, []).append(tables.transfer_in_bands("outside-wedge"))
    names = short_names(fields)
    fixed = [f"{names[field]} {block[0]['changes'][field]}" for field in fields if field not in varied]
    skies = max(len(found) for found in groups.values())
    return SweepPanel(
        field=", ".join(shown),
        note=", ".join(fixed + ([f"{skies} EoR skies"] if skies > 1 else [])),
        values=[", ".join(category) for category in groups],
        transfers=[pool(found) for found in groups.values()],
    )
