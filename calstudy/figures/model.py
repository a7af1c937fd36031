"""The fitted foreground model against the true foregrounds of one baseline (the paper's Fig. MODEL_RESID)."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from calstudy.figures import style
from calstudy.figures.comparison import VisibilityComparison, draw_comparison


@style.journal_style()
def draw_model(comparison: VisibilityComparison, stand_ins: Sequence[str] = ()) -> Figure:
    """Draw true foregrounds F (the reference) and their fitted model F̂, both without gains."""
    return draw_comparison(comparison, (r"true foregrounds $F$", r"fitted model $\widehat{F}$"), stand_ins)
