"""The EoR that a calibration leaves: transfer functions per wavenumber, and per baseline length and delay."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calstudy.figures import Drawing, StudyFigure
from calstudy.plotting import style
from calstudy.plotting.axes import delay_axis, draw_cells, draw_horizon, label_axes
from calstudy.products import expected_loss, signal_loss
from calstudy.results.reader import Tables
from calstudy.run.task import Job
from calstudy.verdicts.tolerances import (
    ERROR_OF_ERROR,
    Drawn,
    Rules,
    half,
    own_error,
    power_over_samples,
    spread_of_scale,
    typical_error,
)

if TYPE_CHECKING:
    from calstudy.power.transfer import ExpectedBins, TransferFunction, TransferMap


TRANSFER = r"$T = P^{D}/P^{S}$"


@dataclass(frozen=True)
class SignalLoss:
    """The transfer functions of one calibration, per |k| and per baseline length and delay, and the `expected` one."""

    outside: TransferFunction
    inside: TransferFunction
    map: TransferMap
    expected: ExpectedBins | None = None


def _last_k(*parts: TransferFunction) -> float:
    """Return the end of the last bin with modes, at least 0.1 and at most 1.5 h/Mpc."""
    filled = np.any([np.isfinite(part.transfer) for part in parts], axis=0)
    return float(np.clip(parts[0].bin_edges[1:][filled].max(initial=0), 0.1, 1.5))


def draw_signal_loss(loss: SignalLoss, buffer: float = 100e-9) -> style.Figure:
    """Draw T per |k| outside and inside the wedge with 95 % bars on the left, per (|b|, tau) on the right.

    The dashed line is the horizon plus `buffer`, s. Raises ValueError if no bin has a transfer function.
    """
    if not any(np.isfinite(part.transfer).any() for part in (loss.outside, loss.inside)):
        raise ValueError("no bin of |k| has a transfer function, expected at least one with modes in it")
    figure, axes = draw_loss(loss, f"{{}} wedge + {1e9 * buffer:.0f} ns", buffer)
    label = f"outside, free of the flux scale {loss.outside.flux_scale:.3f}"
    look: dict[str, Any] = {"color": style.BLUE, "linewidth": 0.7, "zorder": 1}
    axes.plot(loss.outside.k, loss.outside.scale_free_transfer, label=label, **look)
    values = np.concatenate([loss.outside.transfer, loss.inside.transfer])
    axes.set_ylim(min(-0.03, 1.1 * float(np.nanmin(values))), max(1.1, 1.05 * float(np.nanmax(values))))
    handles, labels = axes.get_legend_handles_labels()
    # The points, which matter most, come first in the legend; the line would by default.
    axes.legend(handles[1:] + handles[:1], labels[1:] + labels[:1], loc="center right")
    return figure


def draw_loss(loss: SignalLoss, label: str, buffer: float) -> tuple[style.Figure, style.Axes]:
    """Draw T as in `draw_signal_loss`; return figure and left axes. `label` has a place for "outside" or "inside"."""
    figure = style.new_figure(style.TWO_COLUMNS, 3.0)
    left, right = figure.subplots(1, 2, width_ratios=(1.2, 1.0))
    left.axhline(1.0, color=style.GREY, linewidth=0.7, zorder=0)
    draw_transfer(left, loss.outside, label.format("outside"), "o", style.BLUE)
    draw_transfer(left, loss.inside, label.format("inside"), "s", style.ORANGE)
    left.set(xlabel=style.WAVENUMBER, ylabel=TRANSFER, xlim=(0, _last_k(loss.outside, loss.inside)))
    _draw_map(figure, right, loss.map, buffer)
    return figure, left


def draw_transfer(axes: style.Axes, part: TransferFunction, label: str, marker: str, colour: str) -> None:
    """Draw one transfer function as points with 95 % bars at the centres of its bins, except empty ones."""
    known = np.isfinite(part.transfer)
    look = {"color": colour, "markersize": 2.6, "ecolor": (colour, 0.55), "label": label}
    style.error_bars(axes, part.k[known], part.transfer[known], part.transfer_error[known], fmt=marker, **look)


def _draw_map(figure: style.Figure, axes: style.Axes, transfer: TransferMap, buffer: float) -> None:
    mesh = draw_cells(axes, transfer, transfer.transfer, vmin=0.0, vmax=1.0, cmap="cividis")
    draw_horizon(axes, transfer, buffer, colour="white")
    label_axes(axes, transfer)
    axes.set_ylabel(style.K_PARALLEL)
    delay_axis(axes, transfer)
    figure.colorbar(mesh, ax=axes, extend="max", pad=0.02, aspect=25, label=TRANSFER)


INJECTED_RULES: Rules = (
    (r"map\..*", Drawn(typical_error, "its error bar, at least the median of its baseline length", largest=12.0)),
    (r".*\.flux_scale", Drawn(spread_of_scale, "the flux scale of other noise")),
    (r".*\.signal", Drawn(power_over_samples, "sample variance", largest=12.0)),
)


class SignalLossFigure(StudyFigure):
    """The transfer function of the calibration, measured by injection."""

    kind: str = "signal-loss"

    caption = (
        "What the calibration leaves of the EoR: T = P^D / P^S of the part D of the residual that the EoR makes, per k "
        "and per baseline length and delay."
    )
    needs_signal_loss = True
    needs_calibration = True
    reads: ClassVar = {"transfer": signal_loss.transfer}
    sections = ("power.wedge_buffer",)
    tolerances = (
        *INJECTED_RULES,
        (r".*\.(transfer|coherence|scale_free_transfer|retained)", Drawn(own_error, "its error bar", largest=12.0)),
        (r".*_error", ERROR_OF_ERROR),
    )

    def draw(self, job: Job) -> Drawing:
        """Draw T per k and per (|b|, tau)."""
        tables = Tables((job.inputs["transfer"],))
        outside, inside = (tables.transfer(region) for region in signal_loss.REGIONS)
        loss = SignalLoss(outside, inside, tables.transfer_map())
        figure = draw_signal_loss(loss, buffer=job.settings["wedge_buffer"])
        return Drawing(figure, loss)


MAX_DELAY = 1.5e-6


def draw_expected_loss(
    expected: ExpectedBins, measured: TransferFunction, by_length: TransferMap, buffer: float = 100e-9
) -> style.Figure:
    """Draw T outside the wedge per |k| on the left, and against the delay for some baseline lengths on the right.

    Lines are expected of the tangent space of one integration's fit, points measured, with 95 % bars; on the right
    points are free of the flux scale. The wedge ends at the horizon plus `buffer`, s.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 2.9)
    left, right = figure.subplots(1, 2, sharey=True)
    left.axhline(1.0, color=style.GREY, linewidth=0.7, zorder=0)
    draw_transfer(left, measured, "injected EoR", "o", style.BLUE)
    left.plot(expected.k, expected.outside, color=style.ORANGE, label="expected at the solution")
    label = f"injected, free of the flux scale {measured.flux_scale:.3f}"
    left.plot(measured.k, measured.scale_free_transfer, color=style.BLUE, linestyle=":", label=label)
    left.set(xlabel=style.WAVENUMBER, ylabel=TRANSFER, xlim=(0, _last_k(measured)))
    left.set_title(f"outside wedge + {1e9 * buffer:.0f} ns")
    left.legend(loc="lower right")
    _draw_lengths(right, expected, by_length, measured.flux_scale**2)
    left.set_ylim(-0.03, max(1.15, left.get_ylim()[1]))
    return figure


def _draw_lengths(axes: style.Axes, expected: ExpectedBins, measured: TransferMap, scale: float) -> None:
    """Draw the mean over some neighbouring bins of baseline length: short, middle and long."""
    axes.axhline(1.0, color=style.GREY, linewidth=0.7, zorder=0)
    count = len(measured.bin_edges)
    width = max(count // 8, 1)
    for place, colour in zip((0.15, 0.45, 0.75), (style.BLUE, style.GREEN, style.RED), strict=True):
        first = min(round(place * count), count - width)
        rows = slice(first, first + width)
        low, high = measured.bin_edges[first, 0], measured.bin_edges[first + width - 1, 1]
        inside = (expected.length_edges[:, 0] >= low) & (expected.length_edges[:, 1] <= high)
        transfer = scale * np.mean(measured.transfer[rows], axis=0)
        error = scale * np.sqrt(np.sum(measured.transfer_error[rows] ** 2, axis=0)) / width
        look = {"color": colour, "markersize": 2.2, "ecolor": (colour, 0.5), "elinewidth": 0.6}
        style.error_bars(axes, 1e9 * measured.delay, transfer, error, fmt="o", **look)
        label = rf"$|\mathbf{{b}}| = {low:g}$–${high:g}$ m"
        axes.plot(1e9 * expected.delay, expected.by_length[inside].mean(axis=0), color=colour, label=label)
    axes.set(xlabel=style.DELAY, xlim=(0, 1e9 * min(MAX_DELAY, measured.delay[-1])))
    axes.set_title("points injected, free of the flux scale; lines expected")
    axes.legend(loc="lower right")


class ExpectedLossFigure(StudyFigure):
    """The transfer function that the fit predicts, against the one measured by injection."""

    version: ClassVar[int] = 2

    kind: str = "expected-loss"

    caption = "Signal loss expected from the fit alone, against what injection measures."
    needs_signal_loss = True
    needs_least_squares = True
    needs_calibration = True
    reads: ClassVar = {"expected": expected_loss.expected_loss, "transfer": signal_loss.transfer}
    sections = ("power.wedge_buffer",)
    tolerances = (*INJECTED_RULES, (r"expected\..*", Drawn(half, "follows from fitted gains; half of it")))

    def draw(self, job: Job) -> Drawing:
        """Draw expected and measured T side by side."""
        tables = Tables((job.inputs["transfer"], job.inputs["expected"]))
        found = tables.expected_transfer, tables.transfer("outside-wedge"), tables.transfer_map()
        figure = draw_expected_loss(*found, buffer=job.settings["wedge_buffer"])
        return Drawing(figure, dict(zip(("expected", "measured", "map"), found, strict=True)))
