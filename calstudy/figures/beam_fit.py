"""The tabulated beam's smooth fit against its table, and other interpolations against the fit."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from calstudy.checks.beam import BeamFit
from calstudy.figures import style

INTERPOLATION_COLOURS = {
    "chebyshev": style.BLUE,
    "cubic": style.GREEN,
    "linear": style.ORANGE,
    "nearest": style.RED,
}
"""One colour for each interpolation in every figure."""


@style.journal_style()
def draw_beam_fit(fit: BeamFit, stand_ins: Sequence[str] = ()) -> Figure:
    """Draw differences of Jones components, relative to the zenith, against frequency."""
    figure = style.new_figure(style.ONE_COLUMN, 2.9)
    axes = figure.subplots()
    blue = INTERPOLATION_COLOURS["chebyshev"]
    axes.plot(fit.tabulated / 1e6, fit.fit_max, "^", color=blue, markerfacecolor="white", label="fit − table, largest")
    axes.plot(fit.tabulated / 1e6, fit.fit_rms, "o", color=blue, label="fit − table, rms")
    for name, rms in fit.others.items():
        axes.plot(fit.channels / 1e6, rms, color=INTERPOLATION_COLOURS[name], linewidth=0.8, label=f"{name} − fit, rms")
    axes.set(yscale="log", xlabel=style.FREQUENCY, ylabel=r"$|\Delta J|\,/\,|J_\mathrm{zenith}|$")
    axes.margins(x=0.01)
    figure.legend(loc="outside upper center", ncols=2)
    style.note_stand_ins(figure, stand_ins)
    return figure
