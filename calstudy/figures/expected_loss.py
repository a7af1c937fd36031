"""The EoR that a fit is expected to leave, from its own tangent space, against the measurement by injection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS
from calstudy.figures import Drawing, StudyFigure
from calstudy.figures.signal_loss import SIGMAS_95, TRANSFER, draw_transfer
from calstudy.plotting import style
from calstudy.products import expected_loss, signal_loss
from calstudy.products.graph import Graph, required
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, half, power_over_samples, spread_of_scale, typical_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from calstudy.power.expected import ExpectedBins
    from calstudy.power.transfer import TransferFunction, TransferMap

MAX_DELAY = 1.5e-6


@dataclass(frozen=True)
class ExpectedLoss:
    """Expected and measured transfer functions of one calibration.

    `expected` is from the tangent space of one integration's fit; `measured` (outside the wedge per |k|) and `map` (per
    baseline length and delay) are from data with the EoR and without.
    """

    expected: ExpectedBins
    measured: TransferFunction
    map: TransferMap


@style.journal_style()
def draw_expected_loss(loss: ExpectedLoss, buffer: float = 100e-9, stand_ins: Sequence[str] = ()) -> Figure:
    """Draw T outside the wedge per |k| on the left, and against the delay for some baseline lengths on the right.

    Lines are expected, points measured, with 95 % bars. The wedge ends at the horizon plus `buffer`, s.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 2.9)
    left, right = figure.subplots(1, 2, sharey=True)
    expected, measured = loss.expected, loss.measured
    left.axhline(1.0, color=style.GREY, linewidth=0.7, zorder=0)
    draw_transfer(left, measured, "injected EoR", "o", style.BLUE)
    left.plot(expected.k, expected.outside, color=style.ORANGE, label="expected at the solution")
    left.plot(
        measured.k,
        measured.scale_free_transfer,
        color=style.BLUE,
        linestyle=":",
        label=f"injected, free of the flux scale {measured.flux_scale:.3f}",
    )
    filled = np.isfinite(measured.transfer)
    left.set(xlabel=style.WAVENUMBER, ylabel=TRANSFER, xlim=(0, min(measured.bin_edges[1:][filled].max(), 1.5)))
    left.set_title(f"outside wedge + {1e9 * buffer:.0f} ns")
    left.legend(loc="lower right")
    _draw_lengths(right, loss)
    left.set_ylim(-0.03, 1.15)
    style.note_stand_ins(figure, stand_ins)
    return figure


def _draw_lengths(axes: Axes, loss: ExpectedLoss) -> None:
    """Draw the mean over some neighbouring bins of baseline length: short, middle and long."""
    axes.axhline(1.0, color=style.GREY, linewidth=0.7, zorder=0)
    count = len(loss.map.bin_edges)
    width = max(count // 8, 1)
    for place, colour in zip((0.15, 0.45, 0.75), (style.BLUE, style.GREEN, style.RED), strict=True):
        first = min(round(place * count), count - width)
        rows = slice(first, first + width)
        low, high = loss.map.bin_edges[first, 0], loss.map.bin_edges[first + width - 1, 1]
        inside = (loss.expected.length_edges[:, 0] >= low) & (loss.expected.length_edges[:, 1] <= high)
        axes.errorbar(
            1e9 * loss.map.delay,
            np.mean(loss.map.transfer[rows], axis=0),
            SIGMAS_95 * np.sqrt(np.sum(loss.map.transfer_error[rows] ** 2, axis=0)) / width,
            fmt="o",
            color=colour,
            markersize=2.2,
            ecolor=(colour, 0.5),
            elinewidth=0.6,
        )
        label = rf"$|\mathbf{{b}}| = {low:g}$–${high:g}$ m"
        axes.plot(1e9 * loss.expected.delay, loss.expected.by_length[inside].mean(axis=0), color=colour, label=label)
    axes.set(xlabel=style.DELAY, xlim=(0, 1e9 * min(MAX_DELAY, loss.map.delay[-1])))
    axes.set_title("points injected, lines expected")
    axes.legend(loc="lower right")


class ExpectedLossFigure(StudyFigure):
    """The transfer function that the fit predicts, against the one measured by injection."""

    caption = "Signal loss expected from the fit alone, against what injection measures."
    variants = SIGNAL_LOSS_VARIANTS
    needs_signal_loss = True
    needs_least_squares = True
    needs_calibration = True
    tolerances = (
        (r"map\..*", Drawn(typical_error, "its error bar, at least the median of its baseline length", largest=12.0)),
        (r".*\.flux_scale", Drawn(spread_of_scale, "the flux scale of other noise")),
        (r".*\.signal", Drawn(power_over_samples, "sample variance", largest=12.0)),
        (r"expected\..*", Drawn(half, "follows from fitted gains; half of it")),
    )

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return expectation and measurement."""
        return {
            "expected": required(expected_loss.expected_loss(graph)),
            "transfer": required(signal_loss.transfer(graph)),
        }

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the buffer of the wedge."""
        return {"wedge_buffer": graph.experiment.power.wedge_buffer}

    def draw(self, job: Job) -> Drawing:
        """Draw expected and measured T side by side."""
        from calstudy.results.reader import Tables

        tables = Tables((job.inputs["transfer"], job.inputs["expected"]))
        found = ExpectedLoss(tables.expected_transfer, tables.transfer("outside-wedge"), tables.transfer_map())
        figure = draw_expected_loss(found, buffer=job.settings["wedge_buffer"], stand_ins=job.settings["notes"])
        return Drawing(figure, found)
