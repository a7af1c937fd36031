"""Spherical power spectra with 95 % bars, of one array or two (the paper's Figs. SPHERICAL*)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field, PlainSerializer

from calstudy.base.constants import SIGMAS_95
from calstudy.figures import TWO_ARRAYS, Drawing, StudyFigure
from calstudy.plotting import style
from calstudy.power.cosmology import redshift
from calstudy.power.limits import WITHIN, Limits, limits_near, published_limits, read_limits
from calstudy.results.reader import Tables
from calstudy.run.task import Job
from calstudy.verdicts.tolerances import SPHERICAL_RULES

if TYPE_CHECKING:
    from matplotlib.lines import Line2D

    from calstudy.experiment.model import Experiment
    from calstudy.power.realizations import PooledRegion
    from calstudy.power.spectra import SphericalSpectrum
    from calstudy.products.graph import Graph


@dataclass(frozen=True)
class SphericalColumn:
    """The spherical spectra of one column: one array, one choice of Fourier modes.

    `eor` is P^S with the sample variance as its error (the grey band), `uncorrupted` P^{S+F+N} with perfect gains,
    `uncalibrated` P^V with gain errors, `residual` P^R, `residual_without_eor` P^R of a simulation of foregrounds and
    noise only, and `noise` P^N.
    """

    title: str
    eor: SphericalSpectrum
    uncorrupted: SphericalSpectrum | None = None
    uncalibrated: SphericalSpectrum | None = None
    residual: SphericalSpectrum | None = None
    residual_without_eor: SphericalSpectrum | None = None
    noise: SphericalSpectrum | None = None

    def series(self, names: Sequence[str]) -> dict[str, SphericalSpectrum]:
        """Return the spectra of these names that there are."""
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}


class Marking(NamedTuple):
    """The look of one series; `shift`, in widths of a bin, moves it sideways to uncover points behind it."""

    label: str
    marker: str
    colour: str
    size: float
    shift: float = 0.0

    @property
    def handle(self) -> Line2D:
        """Its entry of a legend, a little larger than in the figure."""
        return style.entry(linestyle="none", marker=self.marker, color=self.colour, markersize=self.size + 0.8)


MARKINGS = {
    "uncorrupted": Marking(r"$P^{S+F+N}$", "o", style.BLACK, 2.8),
    "uncalibrated": Marking(r"$P^{V}$", "D", style.RED, 2.5),
    "noise": Marking(r"$P^{N}$", "o", style.MAGENTA, 2.6, -0.15),
    "residual_without_eor": Marking(r"$P^{R}$, no EoR", "s", style.CYAN, 2.4, 0.15),
    "residual": Marking(r"$P^{R}$", "s", style.ORANGE, 2.8),
}
"""Series in the order of drawing, the later over the earlier."""
LEGEND_ORDER = ("uncorrupted", "uncalibrated", "residual", "residual_without_eor", "noise")
ZOOMED = ("residual", "residual_without_eor", "noise")
ZOOM_K = 1.0
"""Series of the lower row, and where it ends, h/Mpc."""
PUBLISHED = "published"
LIMIT_MARKERS = ("v", "1", "$\\downarrow$", "P", "X", "*")


def draw_spherical(
    columns: Sequence[SphericalColumn], limits: Sequence[Limits] = (), z: float = math.nan
) -> style.Figure:
    """Draw spherical power spectra: full range above, signal and residuals enlarged below.

    Markers are at |P|, open where P is negative; bars are 95 % (1.96 σ); the grey band is P^S ± 1.96 σ. There are one
    or two columns, from left to right: all modes and wedge excised (Fig. SPHERICAL), or wedge excised alone (Fig.
    SPHERICAL_LOW_SNR). Power is in mK² h⁻³ Mpc³. Published limits are drawn above only; `z` is the redshift of the
    spectra, which is shown beside theirs. Raise ValueError for a spectrum without any power, or a power without an
    error bar.
    """
    for column in columns:
        _check(column)
    width = style.ONE_COLUMN if len(columns) == 1 else style.TWO_COLUMNS
    figure = style.new_figure(width, 5.6)
    figure.set_layout_engine("constrained", hspace=0.02, wspace=0.02)
    grid = figure.subplots(2, len(columns), sharex="row", sharey="row", squeeze=False)
    for top, bottom, column in zip(*grid, columns, strict=True):
        _draw_column(top, column, tuple(MARKINGS))
        _draw_column(bottom, column, ZOOMED)
        top.set_title(column.title)
        bottom.set_xlabel(style.WAVENUMBER)
    first, last = _k_limits(columns)
    ends = last, min(last, ZOOM_K)
    for row, ylim, end in zip(grid, (_full_limits(columns), _zoom_limits(columns)), ends, strict=True):
        row[0].set(xscale="log", yscale="log", ylim=ylim, xlim=(first, end))
        row[0].set_ylabel(rf"$|P(k)|$ ({style.POWER_UNIT})")
        style.label_one_two_five(row[0].xaxis)
    entries = legend_entries(MARKINGS[name] for name in LEGEND_ORDER if _present(columns, (name,)))
    for marker, found in zip(cycle(LIMIT_MARKERS), limits, strict=False):
        label = f"{found.name}, $z = {found.redshift:g}$"
        look = {"color": style.GREY, "marker": marker, "markersize": 3.5, "linewidth": 0.6, "zorder": 1.5}
        for axes in grid[0]:
            (entries[label],) = axes.plot(found.k, found.power, linestyle=":", label=label, **look)
    if limits:
        # Their names are long.
        title = rf"spectra: $z = {z:.2f}$; limits: $P = 2\pi^2 \Delta^2 / k^3$"
        add_legend(figure, entries, 5 if len(columns) == 2 else 2, title=title, title_fontsize=7.0)
    else:
        add_legend(figure, entries, 7 if len(columns) == 2 else 3)
    return figure


def _check(column: SphericalColumn) -> None:
    for name, spectrum in column.series(("eor", *MARKINGS)).items():
        finite = np.isfinite(spectrum.power.real)
        if not finite.any():
            raise ValueError(f"column '{column.title}': no power of '{name}' is finite")
        if not np.isfinite(spectrum.error[finite]).all():
            raise ValueError(f"column '{column.title}': '{name}' has power without an error bar")


def _draw_column(axes: style.Axes, column: SphericalColumn, names: Sequence[str]) -> None:
    draw_band(axes, column.eor)
    for name, spectrum in column.series(names).items():
        draw_points(axes, spectrum, MARKINGS[name], name, 2 + list(MARKINGS).index(name))


def draw_band(axes: style.Axes, eor: SphericalSpectrum) -> None:
    """Draw P^S with its sample variance, the grey band."""
    finite = np.isfinite(eor.power.real)
    power, half = eor.power.real[finite], SIGMAS_95 * eor.error[finite]
    axes.fill_between(eor.k[finite], power - half, power + half, color=style.BAND, linewidth=0, zorder=0, label="eor")
    axes.plot(eor.k[finite], power, color=style.GREY, linewidth=0.7, zorder=1)


def draw_points(axes: style.Axes, spectrum: SphericalSpectrum, marking: Marking, name: str, zorder: float) -> None:
    """Draw |P| with 95 % bars on a logarithmic axis, open where P is negative; `name` labels the artists."""
    power = spectrum.power.real
    k = shifted(spectrum, marking.shift)
    for negative in (False, True):
        chosen = np.isfinite(power) & ((power < 0) == negative)
        look = {"fmt": marking.marker, "color": marking.colour, "markersize": marking.size, "zorder": zorder}
        look |= {"markerfacecolor": "white" if negative else marking.colour, "ecolor": (marking.colour, 0.55)}
        label = f"{name}, {'negative' if negative else 'positive'}"
        style.error_bars(axes, k[chosen], np.abs(power[chosen]), spectrum.error[chosen], label=label, **look)


def _present(columns: Sequence[SphericalColumn], names: Sequence[str]) -> list[SphericalSpectrum]:
    return [spectrum for column in columns for spectrum in column.series(names).values()]


def magnitudes(spectra: Sequence[SphericalSpectrum]) -> np.ndarray:
    """Return |P| of all bins of some spectra where it is known and not zero."""
    values = np.abs(np.concatenate([spectrum.power.real for spectrum in spectra]))
    return values[np.isfinite(values) & (values > 0)]


def _full_limits(columns: Sequence[SphericalColumn]) -> tuple[float, float]:
    """Return limits that hold all but the faintest few points, which are noise about zero."""
    values = magnitudes(_present(columns, ("eor", *MARKINGS)))
    return 0.5 * float(np.quantile(values, 0.02)), 4 * float(values.max())


def _zoom_limits(columns: Sequence[SphericalColumn]) -> tuple[float, float]:
    """Return limits from below the noise to above the EoR and the residuals."""
    low = min(np.median(magnitudes([spectrum])) for spectrum in _present(columns, ("eor", *ZOOMED)))
    bands = [column.eor.power.real + SIGMAS_95 * column.eor.error for column in columns]
    residuals = [magnitudes([item]).max() for item in _present(columns, ("residual",))]
    return 0.1 * float(low), 2 * float(max(*(np.nanmax(band) for band in bands), *residuals, low))


def shifted(spectrum: SphericalSpectrum | PooledRegion, shift: float) -> np.ndarray:
    """Return the centres of bins, moved sideways by a part of their widths."""
    return spectrum.k + shift * np.diff(spectrum.bin_edges)


def _k_limits(columns: Sequence[SphericalColumn]) -> tuple[float, float]:
    """Return limits that hold all drawn points, including shifted ones."""
    reach = max(abs(marking.shift) for marking in MARKINGS.values())
    spectra = [(item, np.isfinite(item.power.real)) for item in _present(columns, ("eor", *MARKINGS))]
    first = min(shifted(item, -reach)[finite].min() for item, finite in spectra if finite.any())
    last = max(shifted(item, reach)[finite].max() for item, finite in spectra if finite.any())
    return 0.85 * float(first), 1.1 * float(last)


def legend_entries(markings: Iterable[Marking], more: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return entries of a legend by label: series, the grey band, more of them, and open markers."""
    from matplotlib.patches import Patch

    band = Patch(color=style.BAND), style.entry(color=style.GREY, linewidth=0.7)
    series = {marking.label: marking.handle for marking in markings}
    negative = style.entry(linestyle="none", **style.OPEN_MARKER)
    return {**series, r"$P^{S}$, 95% sample variance": band, **(more or {}), r"open: $P < 0$": negative}


def add_legend(figure: style.Figure, entries: Mapping[str, Any], ncols: int, **title: Any) -> None:
    """Add a legend above all axes, with entries by label."""
    spacing = {"columnspacing": 1.0, "handletextpad": 0.3}
    figure.legend(list(entries.values()), list(entries), loc="outside upper center", ncols=ncols, **spacing, **title)


LimitsTable = Annotated[
    Path,
    BeforeValidator(lambda value: published_limits() if value == PUBLISHED else value),
    PlainSerializer(lambda path: PUBLISHED if path == published_limits() else str(path), str, when_used="json"),
]
"""A table of limits by its path, or by a word the one that comes with calstudy."""


def read_column(folder: Path, title: str, modes: str) -> SphericalColumn:
    """Read the spherical spectra of all series of a product of stage `spectra`, for "all-modes" or "outside-wedge"."""
    tables = Tables((folder,))
    series = {name: tables.spherical(name, modes) for name in tables.variants if name in ("eor", *MARKINGS)}
    return SphericalColumn(title=title, **series)


def redshift_of(experiment: Experiment) -> float:
    """Return the redshift of the middle of the band, as power spectra have it."""
    return redshift(sum(experiment.instrument.channels.band) / 2)


class Spherical(StudyFigure):
    """Spherical power spectra over all modes, and outside the wedge."""

    kind: str = "spherical"
    limits: LimitsTable | None = Field(
        None,
        description="Upper limits to draw, the closest within 0.5 in redshift of each name: `published`, a table that "
        "comes with calstudy, or a CSV of name, reference, z, k in h/Mpc, and delta2, the limit of Δ² in mK².",
    )

    caption = "Spherical power spectra with 95 % bars; open where negative."
    shown: ClassVar = {"all_modes": "all-modes", "excised": "outside-wedge"}
    variants = ("eor",)
    sections = ("power.wedge_buffer",)
    tolerances = SPHERICAL_RULES

    def refusal(self, experiment: Experiment) -> str | None:
        """Return why the figure cannot be drawn, such as that no limit is near the redshift."""
        z = redshift_of(experiment)
        if self.limits is not None and not self.limits_at(z):
            return f"has limits, but none within {WITHIN:g} of the redshift of the data, {z:.2f}"
        return super().refusal(experiment)

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the edge of the wedge and, where there are limits, the redshift."""
        found = super().settings(graph)
        return found if self.limits is None else {**found, "redshift": redshift_of(graph.experiment)}

    def limits_at(self, z: float) -> list[Limits]:
        """Return the limits near a redshift."""
        return [] if self.limits is None else limits_near(read_limits(self.limits), z)

    def captioned(self) -> str:
        """Return the caption with the sources of the limits."""
        if self.limits is None:
            return self.caption
        sources = dict.fromkeys(f"{limits.name} ({limits.reference})" for limits in read_limits(self.limits))
        dotted = "Dotted: upper limits near this redshift, if there are some, of a table from"
        return f"{self.caption} {dotted} {'; '.join(sources)}."

    def draw(self, job: Job) -> Drawing:
        """Draw a column for each choice of modes."""
        outside = f"outside wedge + {1e9 * job.settings['wedge_buffer']:.0f} ns"
        titles = {"all-modes": "all modes", "outside-wedge": outside}
        folder, z = job.inputs["spectra"], job.settings.get("redshift", math.nan)
        columns = {name: read_column(folder, titles[modes], modes) for name, modes in self.shown.items()}
        limits = self.limits_at(z)
        figure = draw_spherical(list(columns.values()), limits, z)
        return Drawing(figure, {**columns, "limits": dict(enumerate(limits))})


class SphericalExcised(Spherical):
    """Spherical power spectra outside the wedge."""

    kind: str = "spherical-excised"

    caption = "Spherical power spectra outside the wedge with 95 % bars; open where negative."
    shown: ClassVar = {"excised": "outside-wedge"}


class SphericalComparison(StudyFigure):
    """Spherical power spectra outside the wedge of the members in the roles `minimally_redundant` and `redundant`."""

    kind: str = "spherical-comparison"

    of = ("collection",)
    titles = TWO_ARRAYS
    caption = "Spherical power spectra outside the wedge, of both arrays; below, enlarged."
    tolerances = SPHERICAL_RULES

    def draw(self, job: Job) -> Drawing:
        """Draw a column for each array."""
        columns = {
            role: read_column(job.inputs[f"spectra:{role}"], title, "outside-wedge")
            for role, title in self.titles.items()
        }
        return Drawing(draw_spherical(list(columns.values())), columns)
