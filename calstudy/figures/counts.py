"""Differential source counts of the sky that is simulated, against published ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from calstudy.checks.counts import SourceCounts
from calstudy.figures import style
from calstudy.sky.counts import differential_counts

TOLERANCE = 0.05


@style.journal_style()
def draw_counts(counts: SourceCounts, stand_ins: Sequence[str] = ()) -> Figure:
    """Draw Euclidean-normalized counts above, and their ratio to Franzen et al. (2019) with a band of 5 % below."""
    figure = style.new_figure(style.ONE_COLUMN, 3.6)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    curve = np.geomspace(counts.edges[0], counts.edges[-1], 200)
    scale = counts.flux**2.5
    error = counts.error * counts.expected / (counts.area * np.diff(counts.edges))
    upper.plot(curve, curve**2.5 * differential_counts(curve), color=style.BLACK, label="Franzen et al. (2019)")
    upper.errorbar(
        counts.flux, scale * counts.density, scale * error, fmt="o", color=style.BLUE, label="sources of this sky"
    )
    upper.set(xscale="log", yscale="log", ylabel=r"$S^{5/2}\,dN/dS$ (Jy$^{3/2}$ sr$^{-1}$)")
    upper.legend(loc="lower right")
    lower.axhspan(1 - TOLERANCE, 1 + TOLERANCE, color=style.BAND, linewidth=0)
    lower.axhline(1, color=style.BLACK, linewidth=0.7)
    lower.errorbar(counts.flux, counts.ratio, counts.error, fmt="o", color=style.BLUE)
    largest = max(2 * TOLERANCE, 1.1 * float(np.abs(counts.ratio - 1).max() + counts.error.max()))
    lower.set(xlabel="flux density at 200 MHz (Jy)", ylabel="ratio", ylim=(1 - largest, 1 + largest))
    style.note_stand_ins(figure, stand_ins)
    return figure
