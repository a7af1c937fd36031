"""Array layouts, of one array or two side by side (the paper's Fig. LAYOUTS)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calstudy.figures import TWO_ARRAYS, Drawing, StudyFigure
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.settings import Layout as LayoutSettings
from calstudy.plotting import style
from calstudy.run.task import Job

NUMBERED_ANTENNAS = 64
"""Largest number of antennas that are drawn with their numbers."""


@dataclass(frozen=True)
class LayoutPanel:
    """One array: antenna numbers, (Nants,), and positions east, north and optionally up, (Nants, 3) or (Nants, 2), m.

    Antennas in `highlight` have another colour.
    """

    title: str
    numbers: np.ndarray
    enu: np.ndarray
    highlight: tuple[int, ...] = ()


def draw_layouts(panels: Sequence[LayoutPanel]) -> style.Figure:
    """Draw one or two arrays, east to the right and north up, in equal scales."""
    width, height = (style.ONE_COLUMN, 3.4) if len(panels) == 1 else (style.TWO_COLUMNS, 3.8)
    figure = style.new_figure(width, height)
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        _draw_array(axes, panel)
    return figure


def _draw_array(axes: style.Axes, panel: LayoutPanel) -> None:
    from scipy.spatial.distance import pdist

    numbers, east_north = panel.numbers, panel.enu[:, :2]
    limits, extent = _square_limits(east_north)
    axes_points = 72 * 2.7
    spacing = pdist(east_north).min() if len(numbers) > 1 else extent
    marker = float(np.clip(0.95 * spacing * axes_points / extent, 2.0, 13.0))
    special = np.isin(numbers, panel.highlight)
    for chosen, face in ((~special, "white"), (special, style.ORANGE)):
        axes.plot(*east_north[chosen].T, "o", markersize=marker, markerfacecolor=face, markeredgecolor=style.BLUE)
    if len(numbers) <= NUMBERED_ANTENNAS:
        size = float(np.clip(0.62 * marker, 5.0, 6.5))
        for number, position in zip(numbers, east_north, strict=True):
            axes.annotate(str(number), position, ha="center", va="center_baseline", fontsize=size)
    axes.set(xlim=limits[0], ylim=limits[1], aspect="equal", title=panel.title)
    axes.set(xlabel="east (m)", ylabel="north (m)")
    axes.locator_params(nbins=6)


def _square_limits(east_north: np.ndarray) -> tuple[np.ndarray, float]:
    """Return limits (2, 2) of a square around all antennas, and its side, in metres."""
    low, high = east_north.min(axis=0), east_north.max(axis=0)
    side = max(float((high - low).max()) * 1.14, 1.0)
    centre = (low + high) / 2
    return np.column_stack([centre - side / 2, centre + side / 2]), side


def layout_panel(layout: LayoutSettings, title: str | None = None) -> LayoutPanel:
    """Return a layout as a panel, under its own name unless another title is given."""
    made = make_layout(layout)
    return LayoutPanel(title=title or made.name, numbers=made.numbers, enu=made.enu)


class Layout(StudyFigure):
    """The antennas of the array."""

    kind: str = "layout"

    caption = "The array."
    shows_sky = False
    reads: ClassVar = {}
    sections = ("instrument.layout",)

    def draw(self, job: Job) -> Drawing:
        """Draw the array."""
        panel = layout_panel(job.settings["layout"])
        return Drawing(draw_layouts([panel]), panel)


class Layouts(StudyFigure):
    """The arrays of the members that play the roles `minimally_redundant` and `redundant`."""

    kind: str = "layouts"

    of = ("collection",)
    caption = "The two arrays."
    titles = TWO_ARRAYS
    shows_sky = False
    reads: ClassVar = {}

    def draw(self, job: Job) -> Drawing:
        """Draw the arrays from left to right."""
        panels = [layout_panel(job.settings["layouts"][role], title) for role, title in self.titles.items()]
        return Drawing(draw_layouts(panels), panels)
