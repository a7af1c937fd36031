"""RMS over time of delay-transformed visibilities (the paper's Figs. INSPECT_BLS and INSPECT_BLS_LOW_SNR)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calstudy.figures import style
from calstudy.figures.domains import horizon_delay
from calstudy.figures.panels import mark_horizon, name_baseline


@dataclass(frozen=True)
class BaselineSpectra:
    """RMS over integrations of one baseline's delay transforms, each (Ndelays,) real, Jy Hz.

    Attributes
    ----------
    antennas
        The two antenna numbers.
    baseline_length
        |b| in m.
    delay
        Ascending delays, (Ndelays,), s.
    data
        Uncalibrated visibilities V.
    model
        Fitted foregrounds times gains, ĝ_a ĝ_b* F̂.
    residual
        Calibrated residuals R.
    noise
        Thermal noise.
    uncorrupted
        Visibilities S+F+N without gain errors, if they are to be drawn.
    """

    antennas: tuple[int, int]
    baseline_length: float
    delay: np.ndarray
    data: np.ndarray
    model: np.ndarray
    residual: np.ndarray
    noise: np.ndarray
    uncorrupted: np.ndarray | None = None


LINES = {
    "uncorrupted": (r"$S+F+N$", {"color": style.BLACK, "linestyle": "-", "linewidth": 0.8}),
    "data": (r"uncalibrated $V$", {"color": style.GREY, "linestyle": "-", "linewidth": 1.6}),
    "model": (r"model $\hat{g}_a\hat{g}_b^*\widehat{F}$", {"color": style.MAGENTA, "linestyle": "-", "linewidth": 0.7}),
    "noise": (r"noise $N$", {"color": style.ORANGE, "linestyle": ":", "linewidth": 1.3}),
    "residual": (r"residual $R$", {"color": style.CYAN, "linestyle": "--", "linewidth": 1.1}),
}


@style.journal_style()
def draw_baselines(baselines: Sequence[BaselineSpectra], stand_ins: Sequence[str] = ()) -> Figure:
    """Draw one panel per baseline on common axes, with the edges of the wedge; one baseline fills one column.

    Raises
    ------
    ValueError
        If there is no baseline.
    """
    if not baselines:
        raise ValueError("a figure of baselines needs at least one baseline")
    n_columns = min(2, len(baselines))
    n_rows = -(-len(baselines) // n_columns)
    width = style.ONE_COLUMN if n_columns == 1 else style.TWO_COLUMNS
    figure = style.new_figure(width, 0.9 + 2.0 * n_rows if n_columns == 2 else 3.1)
    grid = figure.subplots(n_rows, n_columns, sharex=True, sharey=True, squeeze=False)
    for axes, spectra in zip(grid.flat, baselines, strict=False):
        _draw_baseline(axes, spectra)
    for axes in grid.flat[len(baselines) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel(r"RMS $|\widetilde{V}(\tau)|$ (Jy Hz)")
    for column, axes in enumerate(grid[-1]):
        lowest = axes if axes.get_visible() else grid[-2, column]
        lowest.set_xlabel(style.DELAY)
        lowest.tick_params(labelbottom=True)
    handles = grid[0, 0].get_lines()[: sum(getattr(baselines[0], name) is not None for name in LINES)]
    figure.legend(handles=handles, loc="outside upper center", ncols=3 if n_columns == 1 else 6)
    style.note_stand_ins(figure, stand_ins)
    return figure


def _draw_baseline(axes: Axes, spectra: BaselineSpectra) -> None:
    for name, (label, look) in LINES.items():
        values = getattr(spectra, name)
        if values is not None:
            axes.plot(spectra.delay * 1e9, values, label=label, **look)
    mark_horizon(axes, horizon_delay(spectra.baseline_length))
    name_baseline(axes, spectra.antennas, spectra.baseline_length)
    axes.set(yscale="log", xlim=(spectra.delay[0] * 1e9, spectra.delay[-1] * 1e9))
