"""Delay transforms of the reflection gains (the paper's Fig. DELAYTRANSFORMGAINS)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.figures import Drawing, StudyFigure
from calstudy.plotting import style
from calstudy.plotting.domains import TwoDomains, in_two_domains
from calstudy.plotting.panels import delay_panel
from calstudy.products import corruption
from calstudy.products.graph import Graph
from calstudy.run.task import Job, Task

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@style.journal_style()
def draw_reflections(gains: TwoDomains, max_delay: float = 4e-6, stand_ins: Sequence[str] = ()) -> Figure:
    """Draw the amplitude of the transform of every antenna's gain, and their median, in one column.

    Gains are (Nants, Nfreqs), see `calstudy.plotting.domains.in_two_domains`. Delays from -max_delay / 4 to max_delay
    (s) are shown: Eq. REFGAIN has its peaks at positive delays.
    """
    amplitude = np.abs(gains.transform)
    figure = style.new_figure(style.ONE_COLUMN, 2.7)
    axes = figure.subplots()
    nanoseconds = gains.delay * 1e9
    lines = axes.plot(nanoseconds, amplitude.T, color=style.CYAN, linewidth=0.4, alpha=0.7)
    lines[0].set_label("each antenna")
    axes.plot(nanoseconds, np.median(amplitude, axis=0), color=style.BLACK, label="median")
    delay_panel(axes, gains.delay, r"$|\widetilde{g}(\tau)|$")
    shown = (gains.delay >= -max_delay / 4) & (gains.delay <= max_delay)
    # The nulls between the taper's sidelobes would take half of the axis.
    axes.set_ylim(0.3 * np.quantile(amplitude[:, shown], 0.02), 3 * amplitude.max())
    axes.set_xlim(*nanoseconds[shown][[0, -1]])
    axes.legend(loc="upper right")
    style.note_stand_ins(figure, stand_ins)
    return figure


class Reflections(StudyFigure):
    """The true gains against delay, in one integration."""

    caption = "Delay transform of the true gains."
    shows_sky = False

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the true gains."""
        return {"gains": corruption.gains(graph)}

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the shown integration."""
        return {"integration": graph.experiment.outputs.inspect.integration}

    def draw(self, job: Job) -> Drawing:
        """Draw the delay transforms of the true gains."""
        from calstudy.products.selection import read_gains

        gains = read_gains(job.inputs["gains"])
        shown = in_two_domains(gains.frequency, gains.at(job.settings["integration"], gains.numbers))
        return Drawing(draw_reflections(shown, stand_ins=job.settings["notes"]), shown)
