"""The EoR that a calibration leaves: transfer functions per wavenumber, and per baseline length and delay."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS
from calstudy.figures import Drawing, StudyFigure
from calstudy.plotting import style
from calstudy.plotting.axes import cells, delay_axis, draw_horizon, label_axes
from calstudy.products import expected_loss, signal_loss
from calstudy.products.graph import Graph, required
from calstudy.results.reader import Tables
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import (
    ERROR_OF_ERROR,
    Drawn,
    half,
    own_error,
    power_over_samples,
    spread_of_scale,
    typical_error,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from calstudy.power.transfer import ExpectedBins, TransferFunction, TransferMap


TRANSFER = r"$T = P^{D}/P^{S}$"
SCALE_FREE = "outside, free of the flux scale {:.3f}"
MAP_COLOURS = "cividis"
EMPTY = "0.8"


@dataclass(frozen=True)
class SignalLoss:
    """The transfer functions of one calibration: per |k| outside and inside the wedge, and per length and delay.

    For measured data also what is `expected` of the fit, None if not known.
    """

    outside: TransferFunction
    inside: TransferFunction
    map: TransferMap
    expected: ExpectedBins | None = None

    @property
    def last_k(self) -> float:
        """The end of the last bin with modes, at most 1.5 h/Mpc."""
        filled = np.isfinite(self.outside.transfer) | np.isfinite(self.inside.transfer)
        return min(float(self.outside.bin_edges[1:][filled].max(initial=0.1)), 1.5)


@style.journal_style()
def draw_signal_loss(loss: SignalLoss, buffer: float = 100e-9) -> Figure:
    """Draw T per |k| outside and inside the wedge on the left, per (|b|, tau) on the right.

    Bars are 95 % (1.96 sigma); a point without an error (one baseline in its bin) has none. The dashed line is the
    horizon plus `buffer`, s. Raise ValueError if no bin has a transfer function.
    """
    if not any(np.isfinite(part.transfer).any() for part in (loss.outside, loss.inside)):
        raise ValueError("no bin of |k| has a transfer function, expected at least one with modes in it")
    figure, axes = draw_loss(loss, f"{{}} wedge + {1e9 * buffer:.0f} ns", buffer)
    axes.plot(
        loss.outside.k,
        loss.outside.scale_free_transfer,
        color=style.BLUE,
        linewidth=0.7,
        zorder=1,
        label=SCALE_FREE.format(loss.outside.flux_scale),
    )
    axes.set_ylim(_limits(loss))
    handles, labels = axes.get_legend_handles_labels()
    # The points, which matter most, come first in the legend; the line would by default.
    axes.legend(handles[1:] + handles[:1], labels[1:] + labels[:1], loc="center right")
    return figure


def draw_loss(loss: SignalLoss, label: str, buffer: float) -> tuple[Figure, Axes]:
    """Draw a figure of T per |k| on the left and per (|b|, tau) on the right, and return it with the axes on the left.

    `label` has a place for "outside" or "inside"; `buffer` is as for `draw_signal_loss`.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 3.0)
    left, right = figure.subplots(1, 2, width_ratios=(1.2, 1.0))
    left.axhline(1.0, color=style.GREY, linewidth=0.7, zorder=0)
    draw_transfer(left, loss.outside, label.format("outside"), "o", style.BLUE)
    draw_transfer(left, loss.inside, label.format("inside"), "s", style.ORANGE)
    left.set(xlabel=style.WAVENUMBER, ylabel=TRANSFER, xlim=(0, loss.last_k))
    _draw_map(figure, right, loss.map, buffer)
    return figure, left


def draw_transfer(axes: Axes, part: TransferFunction, label: str, marker: str, colour: str) -> None:
    """Draw one transfer function as points with 95 % bars at the centres of its bins, except empty ones."""
    known = np.isfinite(part.transfer)
    axes.errorbar(
        part.k[known],
        part.transfer[known],
        yerr=SIGMAS_95 * np.nan_to_num(part.transfer_error[known]),
        fmt=marker,
        color=colour,
        markersize=2.6,
        ecolor=(colour, 0.55),
        elinewidth=0.7,
        label=label,
    )


def _limits(loss: SignalLoss) -> tuple[float, float]:
    values = np.concatenate([loss.outside.transfer, loss.inside.transfer])
    return min(-0.03, 1.1 * float(np.nanmin(values))), max(1.1, 1.05 * float(np.nanmax(values)))


def _draw_map(figure: Figure, axes: Axes, transfer: TransferMap, buffer: float) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    norm = Normalize(0.0, 1.0)
    x, y, values = cells(transfer, transfer.transfer)
    axes.set_facecolor(EMPTY)
    axes.pcolormesh(x, y, np.ma.masked_invalid(values), norm=norm, cmap=MAP_COLOURS, rasterized=True)
    draw_horizon(axes, transfer, buffer, colour="white")
    label_axes(axes, transfer)
    axes.set_ylabel(style.K_PARALLEL)
    delay_axis(axes, transfer)
    bar = figure.colorbar(ScalarMappable(norm, MAP_COLOURS), ax=axes, extend="max", pad=0.02, aspect=25)
    bar.set_label(TRANSFER)


class SignalLossFigure(StudyFigure):
    """The transfer function of the calibration, measured by injection."""

    kind: str = "signal-loss"

    caption = (
        "What the calibration leaves of the EoR: T = P^D / P^S of the part D of the residual that the EoR makes, per k "
        "and per baseline length and delay."
    )
    variants = SIGNAL_LOSS_VARIANTS
    needs_signal_loss = True
    needs_calibration = True
    sections = ("power.wedge_buffer",)
    tolerances = (
        (r"map\..*", Drawn(typical_error, "its error bar, at least the median of its baseline length", largest=12.0)),
        (r".*\.(transfer|coherence|scale_free_transfer|retained)", Drawn(own_error, "its error bar", largest=12.0)),
        (r".*_error", ERROR_OF_ERROR),
        (r".*\.flux_scale", Drawn(spread_of_scale, "the flux scale of other noise")),
        (r".*\.signal", Drawn(power_over_samples, "sample variance", largest=12.0)),
    )

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the transfer functions."""
        return {"transfer": required(signal_loss.transfer(graph))}

    def draw(self, job: Job) -> Drawing:
        """Draw T per k and per (|b|, tau)."""
        tables = Tables((job.inputs["transfer"],))
        outside, inside = (tables.transfer(region) for region in signal_loss.REGIONS)
        loss = SignalLoss(outside, inside, tables.transfer_map())
        figure = draw_signal_loss(loss, buffer=job.settings["wedge_buffer"])
        return Drawing(figure, loss)


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
def draw_expected_loss(loss: ExpectedLoss, buffer: float = 100e-9) -> Figure:
    """Draw T outside the wedge per |k| on the left, and against the delay for some baseline lengths on the right.

    Lines are expected, points measured, with 95 % bars; on the right points are free of the flux scale. The wedge ends
    at the horizon plus `buffer`, s.
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
    left.set(
        xlabel=style.WAVENUMBER,
        ylabel=TRANSFER,
        xlim=(0, np.clip(measured.bin_edges[1:][filled].max(initial=0), 0.1, 1.5)),
    )
    left.set_title(f"outside wedge + {1e9 * buffer:.0f} ns")
    left.legend(loc="lower right")
    _draw_lengths(right, loss)
    left.set_ylim(-0.03, max(1.15, left.get_ylim()[1]))
    return figure


def _draw_lengths(axes: Axes, loss: ExpectedLoss) -> None:
    """Draw the mean over some neighbouring bins of baseline length: short, middle and long."""
    axes.axhline(1.0, color=style.GREY, linewidth=0.7, zorder=0)
    count = len(loss.map.bin_edges)
    width = max(count // 8, 1)
    scale = loss.measured.flux_scale**2
    for place, colour in zip((0.15, 0.45, 0.75), (style.BLUE, style.GREEN, style.RED), strict=True):
        first = min(round(place * count), count - width)
        rows = slice(first, first + width)
        low, high = loss.map.bin_edges[first, 0], loss.map.bin_edges[first + width - 1, 1]
        inside = (loss.expected.length_edges[:, 0] >= low) & (loss.expected.length_edges[:, 1] <= high)
        axes.errorbar(
            1e9 * loss.map.delay,
            scale * np.mean(loss.map.transfer[rows], axis=0),
            scale * SIGMAS_95 * np.sqrt(np.sum(loss.map.transfer_error[rows] ** 2, axis=0)) / width,
            fmt="o",
            color=colour,
            markersize=2.2,
            ecolor=(colour, 0.5),
            elinewidth=0.6,
        )
        label = rf"$|\mathbf{{b}}| = {low:g}$–${high:g}$ m"
        axes.plot(1e9 * loss.expected.delay, loss.expected.by_length[inside].mean(axis=0), color=colour, label=label)
    axes.set(xlabel=style.DELAY, xlim=(0, 1e9 * min(MAX_DELAY, loss.map.delay[-1])))
    axes.set_title("points injected, free of the flux scale; lines expected")
    axes.legend(loc="lower right")


class ExpectedLossFigure(StudyFigure):
    """The transfer function that the fit predicts, against the one measured by injection."""

    version: ClassVar[int] = 2

    kind: str = "expected-loss"

    caption = "Signal loss expected from the fit alone, against what injection measures."
    variants = SIGNAL_LOSS_VARIANTS
    needs_signal_loss = True
    needs_least_squares = True
    needs_calibration = True
    sections = ("power.wedge_buffer",)
    tolerances = (
        (r"map\..*", Drawn(typical_error, "its error bar, at least the median of its baseline length", largest=12.0)),
        (r".*\.flux_scale", Drawn(spread_of_scale, "the flux scale of other noise")),
        (r".*\.signal", Drawn(power_over_samples, "sample variance", largest=12.0)),
        (r"expected\..*", Drawn(half, "follows from fitted gains; half of it")),
    )

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return expectation and measurement."""
        return {
            "expected": expected_loss.expected_loss(graph),
            "transfer": required(signal_loss.transfer(graph)),
        }

    def draw(self, job: Job) -> Drawing:
        """Draw expected and measured T side by side."""
        tables = Tables((job.inputs["transfer"], job.inputs["expected"]))
        found = ExpectedLoss(tables.expected_transfer, tables.transfer("outside-wedge"), tables.transfer_map())
        figure = draw_expected_loss(found, buffer=job.settings["wedge_buffer"])
        return Drawing(figure, found)
