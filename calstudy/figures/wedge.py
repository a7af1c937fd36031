"""Cylindrical power spectra of five data sets (the paper's Fig. WEDGE)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.figures import Drawing, StudyFigure
from calstudy.plotting import style
from calstudy.plotting.axes import cells, delay_axis, draw_horizon, label_axes
from calstudy.results.reader import Tables
from calstudy.run.task import Job
from calstudy.verdicts.tolerances import Drawn, cylindrical_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import LinearSegmentedColormap, LogNorm
    from matplotlib.figure import Figure

    from calstudy.power.spectra import CylindricalSpectrum

# Yellow against blue: signs are distinct for every kind of colour vision, and both scales darken with |P|.
POSITIVE = ("#fffbe0", "#fbd65c", "#ee8a1e", "#c23a2b", "#76134f", "#1d0b2e")
NEGATIVE = ("#e3f1fb", "#7fbfe8", "#2b7bbd", "#0b3a75")
EMPTY = "0.8"


TITLES = {
    "uncorrupted": r"$P^{S+N+F}$",
    "uncalibrated": r"$P^{V}$",
    "residual": r"$P^{R}$",
    "eor": r"$P^{S}$",
    "noise": r"$P^{N}$",
}
"""Perfect gains, gain errors, the calibrated residual, the EoR alone, and noise alone."""


@style.journal_style()
def draw_wedge(
    spectra: Mapping[str, CylindricalSpectrum], titles: Mapping[str, str] = TITLES, buffer: float = 100e-9
) -> Figure:
    """Draw the real parts of cylindrical power spectra, by name, on one scale of colours, negative values in blue.

    Spectra have strictly increasing baseline lengths and delays >= 0, power in mK² h⁻³ Mpc³. The dashed line is
    `buffer` (s) above the horizon.
    """
    from matplotlib.colors import LogNorm

    floor, highest, lowest = _colour_limits(spectra.values())
    norms = (LogNorm(floor, highest), LogNorm(floor, lowest))
    figure = style.new_figure(style.TWO_COLUMNS, 3.5)
    figure.set_layout_engine("constrained", wspace=0.02, w_pad=0.02)
    grid = figure.subplots(1, len(spectra), sharey=True)
    for axes, (name, spectrum) in zip(grid, spectra.items(), strict=True):
        _draw_power(axes, spectrum, floor, norms)
        draw_horizon(axes, spectrum, buffer)
        label_axes(axes, spectrum)
        axes.set_title(titles[name], pad=4)
    grid[0].set_ylabel(style.K_PARALLEL)
    delay_axis(grid[-1], spectrum)
    grid[0].legend(loc="upper right", frameon=True, framealpha=0.9, edgecolor="none", fontsize=style.NOTE_SIZE)
    _colour_bars(figure, grid, norms)
    return figure


def colour_map(colours: Sequence[str]) -> LinearSegmentedColormap:
    """Return the scale from the first to the last of some colours: `POSITIVE` or `NEGATIVE` for power."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("power", list(colours))


def _colour_limits(spectra: Iterable[CylindricalSpectrum]) -> tuple[float, float, float]:
    """Return the smallest |P| with its own colour, the largest P and the largest -P, in whole decades.

    The smallest is the tenth percentile of |P| in the faintest panel.
    """
    panels = [spectrum.power.real[np.isfinite(spectrum.power.real)] for spectrum in spectra]
    faintest = min((np.quantile(np.abs(panel[panel != 0]), 0.1) for panel in panels if panel.any()), default=1.0)
    floor = 10.0 ** np.floor(np.log10(faintest))
    tops = [max(np.max(sign * panel, initial=10 * floor) for panel in panels) for sign in (1, -1)]
    highest, lowest = (10.0 ** np.ceil(np.log10(top)) for top in tops)
    return floor, highest, lowest


def _draw_power(axes: Axes, spectrum: CylindricalSpectrum, floor: float, norms: tuple[LogNorm, LogNorm]) -> None:
    x, y, power = cells(spectrum, spectrum.power.real)
    axes.set_facecolor(EMPTY)
    for sign, norm, colours in ((1, norms[0], POSITIVE), (-1, norms[1], NEGATIVE)):
        drawn = power >= 0 if sign > 0 else power < 0
        signed = np.ma.masked_where(~drawn, sign * power)
        # Powers below the scale, exact zeros included, are not missing: they have the lowest colour.
        axes.pcolormesh(x, y, np.ma.maximum(signed, floor), norm=norm, cmap=colour_map(colours), rasterized=True)


def _colour_bars(figure: Figure, grid: np.ndarray, norms: tuple[LogNorm, LogNorm]) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.ticker import LogLocator

    columns = max(len(grid) - 2, 1)
    settings: dict[str, Any] = {"location": "bottom", "aspect": 30, "pad": 0.03, "fraction": 0.05}
    for norm, colours, shared, label in (
        (norms[0], POSITIVE, grid[:columns], rf"$P > 0$ ({style.POWER_UNIT})"),
        (norms[1], NEGATIVE, grid[columns:], rf"$-P$ where $P < 0$ ({style.POWER_UNIT})"),
    ):
        bar = figure.colorbar(ScalarMappable(norm, colour_map(colours)), ax=list(shared), **settings)
        bar.ax.xaxis.set_major_locator(LogLocator(numticks=8))
        bar.ax.xaxis.set_minor_locator(LogLocator(numticks=99))
        bar.ax.tick_params(which="both", direction="out")
        bar.set_label(label, labelpad=2)


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
