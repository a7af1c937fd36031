"""From which gain errors and cable delays a solver finds the minimum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from calstudy.figures import style

COLOURS = "cividis"
LARGEST = 10.0
"""Misfits over the floor beyond this have the last colour."""


@dataclass(frozen=True)
class Basin:
    """How fits from unity ended, by what the true gains were.

    Attributes
    ----------
    gain_errors, delays
        Standard deviation per channel (Ne,), and largest cable delay in s (Nd,), ascending.
    misfit
        rms of V - g_a g_b* F over that of a fit that starts at the truth, (Ne, Nd).
    converged
        Whether the status said so, (Ne, Nd).
    arrived
        A fit with a misfit below this has found the minimum.
    """

    gain_errors: np.ndarray
    delays: np.ndarray
    misfit: np.ndarray
    converged: np.ndarray
    arrived: float


@style.journal_style()
def draw_basin(basin: Basin, stand_ins: Sequence[str] = ()) -> Figure:
    """Draw the misfit of each fit as colour and number, and what its status said as a symbol.

    Parameters
    ----------
    basin
        The fits.
    stand_ins
        See `calstudy.figures.style.note_stand_ins`.
    """
    figure = style.new_figure(style.ONE_COLUMN, 3.0)
    axes = figure.subplots()
    shown = np.clip(basin.misfit, 1.0, LARGEST)
    mesh = axes.pcolormesh(shown, norm=LogNorm(1.0, LARGEST), cmap=COLOURS, edgecolor="white", linewidth=0.5)
    for row, column in np.ndindex(basin.misfit.shape):
        misfit = basin.misfit[row, column]
        colour = "white" if misfit < LARGEST**0.5 else style.BLACK
        marker = "o" if basin.converged[row, column] else "x"
        axes.plot(column + 0.5, row + 0.62, marker, color=colour, markersize=4, fillstyle="none")
        axes.text(
            column + 0.5, row + 0.3, f"{misfit:.2f}", color=colour, fontsize=style.NOTE_SIZE, ha="center", va="center"
        )
    axes.set_xticks(np.arange(len(basin.delays)) + 0.5, [f"{1e9 * delay:.0f}" for delay in basin.delays])
    axes.set_yticks(np.arange(len(basin.gain_errors)) + 0.5, [f"{error:g}" for error in basin.gain_errors])
    axes.tick_params(length=0)
    axes.set(xlabel="largest cable delay (ns)", ylabel="gain error per channel")
    bar = figure.colorbar(mesh, ax=axes, extend="max", pad=0.02, aspect=25)
    bar.set_label("misfit over that of a fit from the truth")
    handles = [
        Line2D([], [], color=style.BLACK, marker=marker, linestyle="", markersize=4, fillstyle="none", label=label)
        for marker, label in (("o", "status: converged"), ("x", "status: not converged"))
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
    style.note_stand_ins(figure, stand_ins)
    return figure
