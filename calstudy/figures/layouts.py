"""The array layouts of two members of a collection side by side (the paper's Fig. LAYOUTS)."""

from __future__ import annotations

from collections.abc import Mapping

from calstudy.figures import ComparisonFigure, Drawing
from calstudy.figures.layout import draw_layouts, layout_panel
from calstudy.products.graph import Graph
from calstudy.run.task import Job, Task


class Layouts(ComparisonFigure):
    """The arrays of the members that play the roles `minimally_redundant` and `redundant`."""

    caption = "The two arrays."
    shows_sky = False

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return nothing: the settings are sufficient."""
        del graph
        return {}

    def draw(self, job: Job) -> Drawing:
        """Draw the arrays from left to right."""
        panels = [layout_panel(job.settings["layouts"][role], title) for role, title in self.titles.items()]
        return Drawing(draw_layouts(panels, stand_ins=job.settings["notes"]), panels)
