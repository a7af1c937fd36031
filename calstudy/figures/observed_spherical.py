"""Spherical power spectra of measured data, as given, calibrated, and of the residual, with errors by the noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from calstudy.figures import Drawing, StudyFigure
from calstudy.figures.spherical import SIGMAS_95, Marking, draw_points
from calstudy.plotting import style
from calstudy.products.files import spectrum_file
from calstudy.products.observed_results import observed_spectra
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, half

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from calstudy.power.spectra import SphericalSpectrum
    from calstudy.products.graph import MeasuredGraph

MARKINGS = {
    "data": Marking("data as given", "D", style.RED, 2.5, -0.15),
    "calibrated": Marking("calibrated", "o", style.BLACK, 2.8),
    "residual": Marking("residual", "s", style.ORANGE, 2.8, 0.15),
}
COLUMNS = {"all-modes": "all modes", "outside-wedge": "outside wedge + {:.0f} ns"}


@style.journal_style()
def draw_observed(
    columns: Mapping[str, Mapping[str, SphericalSpectrum]], buffer: float, stand_ins: Sequence[str] = ()
) -> Figure:
    """Draw |P| of measured data over all modes and outside the wedge, open where negative.

    Bars are 95 % by the noise; the grey line is one standard deviation of the noise of the residual. The columns
    "all-modes" and "outside-wedge" have the series of `MARKINGS`, in mK² h⁻³ Mpc³; the wedge ends at the horizon plus
    `buffer`, s.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 3.4)
    grid = figure.subplots(1, len(columns), sharex=True, sharey=True, squeeze=False)[0]
    for axes, (modes, series) in zip(grid, columns.items(), strict=True):
        for place, (name, marking) in enumerate(MARKINGS.items()):
            draw_points(axes, series[name], marking, name, 2 + place)
        _draw_noise(axes, series["residual"])
        axes.set_title(COLUMNS[modes].format(1e9 * buffer))
        axes.set(xlabel=style.WAVENUMBER, xscale="log", yscale="log", ylim=_limits(columns))
        style.label_one_two_five(axes.xaxis)
    grid[0].set_ylabel(rf"$|P(k)|$ ({style.POWER_UNIT})")
    handles = [
        axes.plot([], [], linestyle="none", marker=mark.marker, color=mark.colour, label=mark.label)[0]
        for mark in MARKINGS.values()
    ]
    handles.append(axes.plot([], [], color=style.GREY, label=r"noise of the residual, 1 $\sigma$")[0])
    open_marker = {"marker": "o", "markerfacecolor": "white", "color": style.GREY, "markersize": 4}
    handles.append(axes.plot([], [], linestyle="none", label=r"open: $P < 0$", **open_marker)[0])
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    style.note_stand_ins(figure, stand_ins)
    return figure


def _draw_noise(axes: Axes, residual: SphericalSpectrum) -> None:
    known = np.isfinite(residual.noise_error)
    axes.plot(residual.k[known], residual.noise_error[known], color=style.GREY, linewidth=0.9, zorder=1)


def _limits(columns: Mapping[str, Mapping[str, SphericalSpectrum]]) -> tuple[float, float]:
    """Return limits that hold all powers, but the faintest few points, which are noise about zero."""
    spectra = [spectrum for series in columns.values() for spectrum in series.values()]
    values = np.abs(np.concatenate([spectrum.power.real for spectrum in spectra]))
    values = values[np.isfinite(values) & (values > 0)]
    errors = np.concatenate([series["residual"].noise_error for series in columns.values()])
    return 0.3 * float(min(np.quantile(values, 0.03), np.nanmin(errors) * SIGMAS_95)), 4 * float(values.max())


class ObservedSpherical(StudyFigure):
    """Spherical power spectra of measured data."""

    of = ("observed",)
    caption = (
        "Spherical power spectra of the measured data, even x odd, with 95 % bars of the noise alone; open where "
        "negative."
    )
    tolerances = ((r".*\.(power|noise_error)", Drawn(half, "follows from fitted gains; half of it")),)

    def inputs(self, graph: MeasuredGraph) -> Mapping[str, Task]:
        """Return the averaged spectra."""
        return {"spectra": observed_spectra(graph)}

    def draw(self, job: Job) -> Drawing:
        """Draw a column for each choice of modes."""
        from calstudy.power.spectra import SphericalSpectrum
        from calstudy.power.tables import load_spectrum

        folder = job.inputs["spectra"]
        columns = {
            modes: {name: load_spectrum(folder / spectrum_file(name, modes), SphericalSpectrum) for name in MARKINGS}
            for modes in COLUMNS
        }
        figure = draw_observed(columns, job.settings["wedge_buffer"], job.settings["notes"])
        return Drawing(figure, {modes.replace("-", "_"): series for modes, series in columns.items()})
