"""One visibility and a model of it, in frequency and delay: the common part of the model and data figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from calstudy.plotting import style
from calstudy.plotting.domains import TwoDomains, in_two_domains
from calstudy.plotting.panels import delay_panel, frequency_and_delay, mark_horizon, name_baseline
from calstudy.power.delay import horizon_delay

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class VisibilityComparison:
    """One baseline at one integration, with spectra (Nfreqs,) in Jy; `baseline_length` is |b| in m.

    The residual is reference - model, and the noise is the thermal noise in the data.
    """

    antennas: tuple[int, int]
    baseline_length: float
    reference: TwoDomains
    model: TwoDomains
    residual: TwoDomains
    noise: TwoDomains


class Visibilities(NamedTuple):
    """Spectra of one baseline at one integration, (Nfreqs,) complex, Jy."""

    reference: np.ndarray
    model: np.ndarray
    noise: np.ndarray


def compare_visibilities(
    antennas: tuple[int, int], baseline_length: float, frequency: np.ndarray, visibilities: Visibilities
) -> VisibilityComparison:
    """Compare visibilities on channels `frequency` (Nfreqs,) Hz; the length |b| is in m."""
    reference, model, noise = visibilities
    spectra = (in_two_domains(frequency, values) for values in (reference, model, reference - model, noise))
    return VisibilityComparison(antennas, baseline_length, *spectra)


def draw_comparison(comparison: VisibilityComparison, labels: tuple[str, str], stand_ins: Sequence[str] = ()) -> Figure:
    """Draw real parts against frequency (left) and amplitudes of transforms against delay (right).

    The reference is solid, the model dashed, the residual dotted, the noise dash-dotted. Vertical lines are the edges
    of the wedge. `labels` are the names of reference and model in the legend.
    """
    figure, (values, residuals), delays = frequency_and_delay()
    looks: tuple[tuple[Axes, TwoDomains, str, dict[str, Any]], ...] = (
        (values, comparison.reference, labels[0], {"color": style.BLACK, "linestyle": "-", "linewidth": 0.8}),
        (values, comparison.model, labels[1], {"color": style.ORANGE, "linestyle": "--", "linewidth": 0.9}),
        (residuals, comparison.noise, "thermal noise", {"color": style.MAGENTA, "linestyle": "-.", "linewidth": 0.8}),
        (residuals, comparison.residual, "residual", {"color": style.BLUE, "linestyle": ":", "linewidth": 1.1}),
    )
    for axes, spectrum, label, look in looks:
        axes.plot(spectrum.frequency / 1e6, spectrum.real, label=label, **look)
        delays.plot(spectrum.delay * 1e9, np.abs(spectrum.transform), label=label, **look)
    mark_horizon(delays, horizon_delay(comparison.baseline_length))
    values.set_ylabel(r"Re $V$ (Jy)")
    residuals.set_ylabel(r"Re residual (Jy)")
    delay_panel(delays, comparison.reference.delay, r"$|\widetilde{V}(\tau)|$ (Jy)")
    name_baseline(delays, comparison.antennas, comparison.baseline_length)
    figure.legend(handles=delays.get_lines()[:4], loc="outside upper center", ncols=4)
    style.note_stand_ins(figure, stand_ins)
    return figure
