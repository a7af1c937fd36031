"""Cylindrical power spectra of five data sets (the paper's Fig. WEDGE)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.figures import Drawing, StudyFigure
from calstudy.plotting import style
from calstudy.plotting.axes import delay_axis, draw_cells, draw_horizon, label_axes, name_horizon
from calstudy.results.reader import Tables
from calstudy.run.task import Job
from calstudy.verdicts.tolerances import Drawn, cylindrical_error

if TYPE_CHECKING:
    from matplotlib.colors import LinearSegmentedColormap, LogNorm

    from calstudy.power.spectra import CylindricalSpectrum

# Yellow against blue: signs are distinct for every kind of colour vision, and both scales darken with |P|.
POSITIVE = ("#fffbe0", "#fbd65c", "#ee8a1e", "#c23a2b", "#76134f", "#1d0b2e")
NEGATIVE = ("#e3f1fb", "#7fbfe8", "#2b7bbd", "#0b3a75")

TITLES = {
    "uncorrupted": r"$P^{S+N+F}$",
    "uncalibrated": r"$P^{V}$",
    "residual": r"$P^{R}$",
    "eor": r"$P^{S}$",
    "noise": r"$P^{N}$",
}
"""Perfect gains, gain errors, the calibrated residual, the EoR alone, and noise alone."""


def draw_wedge(
    spectra: Mapping[str, CylindricalSpectrum], titles: Mapping[str, str] = TITLES, buffer: float = 100e-9
) -> style.Figure:
    """Draw the real parts of cylindrical power spectra, mK² h⁻³ Mpc³, on one scale of colours, negative values in blue.

    The dashed line is `buffer` (s) above the horizon.
    """
    from matplotlib.colors import LogNorm

    floor, highest, lowest = _colour_limits(spectra.values())
    norms = (LogNorm(floor, highest), LogNorm(floor, lowest))
    figure = style.new_figure(style.TWO_COLUMNS, 3.5)
    figure.set_layout_engine("constrained", wspace=0.02, w_pad=0.02)
    grid = figure.subplots(1, len(spectra), sharey=True)
    for axes, (name, spectrum) in zip(grid, spectra.items(), strict=True):
        for sign, norm, colours in zip((1, -1), norms, (POSITIVE, NEGATIVE), strict=True):
            power = sign * spectrum.power.real
            # Powers below the scale, exact zeros included, are not missing: they have the lowest colour.
            shown = np.where(power >= 0 if sign > 0 else power > 0, np.maximum(power, floor), np.nan)
            draw_cells(axes, spectrum, shown, norm=norm, cmap=colour_map(colours))
        draw_horizon(axes, spectrum, buffer)
        label_axes(axes, spectrum)
        axes.set_title(titles[name], pad=4)
    grid[0].set_ylabel(style.K_PARALLEL)
    delay_axis(grid[-1], spectrum)
    name_horizon(grid[0])
    _colour_bars(figure, grid, norms)
    return figure


def colour_map(colours: Sequence[str]) -> LinearSegmentedColormap:
    """Return the scale from the first to the last of some colours: `POSITIVE` or `NEGATIVE` for power."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("power", list(colours))


def _colour_limits(spectra: Iterable[CylindricalSpectrum]) -> tuple[float, float, float]:
    """Return the tenth percentile of |P| in the faintest panel, the largest P and the largest -P, in whole decades."""
    panels = [spectrum.power.real[np.isfinite(spectrum.power.real)] for spectrum in spectra]
    faintest = min((np.quantile(np.abs(panel[panel != 0]), 0.1) for panel in panels if panel.any()), default=1.0)
    floor = 10.0 ** np.floor(np.log10(faintest))
    tops = [max(np.max(sign * panel, initial=10 * floor) for panel in panels) for sign in (1, -1)]
    highest, lowest = (10.0 ** np.ceil(np.log10(top)) for top in tops)
    return floor, highest, lowest


def _colour_bars(figure: style.Figure, grid: np.ndarray, norms: tuple[LogNorm, LogNorm]) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.ticker import LogLocator

    columns = max(len(grid) - 2, 1)
    settings: dict[str, Any] = {"location": "bottom", "aspect": 30, "pad": 0.03, "fraction": 0.05}
    labels = (r"$P > 0$", r"$-P$ where $P < 0$")
    sides = zip(norms, (POSITIVE, NEGATIVE), (grid[:columns], grid[columns:]), labels, strict=True)
    for norm, colours, shared, label in sides:
        bar = figure.colorbar(ScalarMappable(norm, colour_map(colours)), ax=list(shared), **settings)
        bar.ax.xaxis.set_major_locator(LogLocator(numticks=8))
        bar.ax.xaxis.set_minor_locator(LogLocator(numticks=99))
        bar.ax.tick_params(which="both", direction="out")
        bar.set_label(f"{label} ({style.POWER_UNIT})", labelpad=2)


class Wedge(StudyFigure):
    """Cylindrical power spectra of five variants of the data."""

    kind: str = "wedge"

    caption = "Cylindrical power spectra; negative values in blue."
    variants = ("uncorrupted", "uncalibrated", "residual", "eor", "noise")
    needs_calibration = True
    sections = ("power.wedge_buffer",)
    tolerances = (
        (
            r".*\.power",
            # The power of few modes has an exponential distribution, with a longer tail than a Gaussian's.
            Drawn(cylindrical_error, "noise + sample variance, and noise x foregrounds", largest=12.0),
        ),
    )

    def draw(self, job: Job) -> Drawing:
        """Draw a panel for each variant."""
        tables = Tables((job.inputs["spectra"],))
        spectra = {name: tables.wedge(name) for name in self.variants}
        return Drawing(draw_wedge(spectra, buffer=job.settings["wedge_buffer"]), spectra)
