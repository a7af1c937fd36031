"""Spherical power spectra of the two arrays side by side (the paper's Fig. SPHERICAL_REDUNDANT)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from matplotlib.figure import Figure

from calstudy.figures.spherical import SphericalColumn, draw_spherical


def draw_spherical_comparison(
    minimally_redundant: SphericalColumn,
    redundant: SphericalColumn,
    zoom_k: float = 1.0,
    stand_ins: Sequence[str] = (),
) -> Figure:
    """Draw both arrays as `draw_spherical` does, the minimally redundant one left and the redundant one right.

    The columns should average the same Fourier modes: those outside the wedge and its buffer. Their titles are
    replaced by the names of the arrays.
    """
    columns = (
        replace(minimally_redundant, title="Minimally redundant"),
        replace(redundant, title="Redundant"),
    )
    return draw_spherical(columns, zoom_k, stand_ins)
