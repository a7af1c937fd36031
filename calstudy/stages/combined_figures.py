"""Stage `combined-figure`: pictures that show several experiments of a collection."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure
from pydantic import TypeAdapter

from calstudy.figures.layouts import LayoutPanel, draw_layouts
from calstudy.figures.save import figure_arrays, save_figure
from calstudy.figures.spherical_comparison import draw_spherical_comparison
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.settings import Layout
from calstudy.stages.figures import spherical_column
from calstudy.stages.registry import Job

TITLES = {"minimally_redundant": "Minimally redundant", "redundant": "Redundant"}
"""What is compared, from left to right, and how it is headed."""


def _layouts(job: Job) -> tuple[Figure, Any]:
    panels = []
    for role in TITLES:
        layout = make_layout(TypeAdapter(Layout).validate_python(job.settings["layouts"][role]))
        panels.append(LayoutPanel(title=TITLES[role], numbers=layout.numbers, enu=layout.enu))
    return draw_layouts(panels, stand_ins=job.settings["notes"]), panels


def _spherical_comparison(job: Job) -> tuple[Figure, Any]:
    columns = {role: spherical_column(job.inputs[role], title, "outside-wedge") for role, title in TITLES.items()}
    return draw_spherical_comparison(**columns, stand_ins=job.settings["notes"]), columns


FIGURES = {"layouts": _layouts, "spherical-comparison": _spherical_comparison}


def draw(job: Job) -> Mapping[str, Any]:
    """Write one combined figure as png and pdf, and its arrays as npz."""
    name = job.settings["figure"]
    figure, shown = FIGURES[name](job)
    save_figure(figure, figure_arrays(shown), job.output, name)
    return {}
