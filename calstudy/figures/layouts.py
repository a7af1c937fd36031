"""The array layouts of two members of a collection side by side (the paper's Fig. LAYOUTS)."""

from __future__ import annotations

from collections.abc import Mapping

from calstudy.figures import TWO_ARRAYS, Drawing, StudyFigure
from calstudy.figures.layout import draw_layouts, layout_panel
from calstudy.products.graph import Graph
from calstudy.run.task import Job, Task


class Layouts(StudyFigure):
    """The arrays of the members that play the roles `minimally_redundant` and `redundant`."""

    of = ("collection",)
    caption = "The two arrays."
    titles = TWO_ARRAYS
    shows_sky = False

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return nothing: the settings are sufficient."""
        del graph
        return {}

    def draw(self, job: Job) -> Drawing:
        """Draw the arrays from left to right."""
        panels = [layout_panel(job.settings["layouts"][role], title) for role, title in self.titles.items()]
        return Drawing(draw_layouts(panels, stand_ins=job.settings["notes"]), panels)
