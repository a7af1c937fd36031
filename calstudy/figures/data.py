"""Uncalibrated data against the fitted gains times foregrounds (the paper's Fig. CALIBRATED_RESID)."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from calstudy.figures import style
from calstudy.figures.comparison import VisibilityComparison, draw_comparison


@style.journal_style()
def draw_data(comparison: VisibilityComparison, stand_ins: Sequence[str] = ()) -> Figure:
    """Draw data V (the reference) and the model visibility ĝ_a ĝ_b* F̂, with the thermal noise of the data."""
    return draw_comparison(comparison, (r"data $V$", r"model $\hat{g}_a\hat{g}_b^*\widehat{F}$"), stand_ins)
