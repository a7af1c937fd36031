"""Spherical power spectra of the two arrays side by side (the paper's Fig. SPHERICAL_REDUNDANT)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from calstudy.figures import TWO_ARRAYS, Drawing, StudyFigure
from calstudy.figures.spherical import SphericalColumn, draw_spherical, read_column
from calstudy.run.task import Job
from calstudy.verdicts.tolerances import SPHERICAL_RULES

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_spherical_comparison(
    minimally_redundant: SphericalColumn,
    redundant: SphericalColumn,
    zoom_k: float = 1.0,
    stand_ins: Sequence[str] = (),
) -> Figure:
    """Draw both arrays as `draw_spherical` does, the minimally redundant one left and the redundant one right.

    The columns should average the same Fourier modes: those outside the wedge and its buffer. Their titles are replaced
    by the names of the arrays.
    """
    columns = (
        replace(minimally_redundant, title="Minimally redundant"),
        replace(redundant, title="Redundant"),
    )
    return draw_spherical(columns, zoom_k, stand_ins)


class SphericalComparison(StudyFigure):
    """Spherical power spectra outside the wedge of the members in the roles `minimally_redundant` and `redundant`."""

    of = ("collection",)
    titles = TWO_ARRAYS
    caption = "Spherical power spectra outside the wedge, of both arrays; below, enlarged."
    tolerances = SPHERICAL_RULES

    def draw(self, job: Job) -> Drawing:
        """Draw a column for each array."""
        columns = {
            role: read_column(job.inputs[f"spectra:{role}"], title, "outside-wedge")
            for role, title in self.titles.items()
        }
        figure = draw_spherical_comparison(
            columns["minimally_redundant"], columns["redundant"], stand_ins=job.settings["notes"]
        )
        return Drawing(figure, columns)
