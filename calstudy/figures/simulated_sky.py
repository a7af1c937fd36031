"""Checks of the simulated sky.

One compares the differential source counts of the foregrounds with published ones. The other shows the components: the
wedge of F alone, P(k) of S alone over its input, and delay spectra of baselines.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from types import SimpleNamespace
from typing import TYPE_CHECKING, ClassVar, cast

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.base.errors import InputError
from calstudy.base.visibilities import antenna_pairs, baseline_vectors, to_cube
from calstudy.corrupt.levels import eor_factor, rms
from calstudy.experiment.model import Experiment
from calstudy.figures import Drawing, StudyFigure
from calstudy.figures.wedge import POSITIVE, colour_map
from calstudy.plotting import style
from calstudy.plotting.axes import MAX_DELAY, draw_cells, draw_horizon, horizon_lines, label_axes, name_horizon
from calstudy.power.binned import cylindrical_average, spherical_average, with_errors
from calstudy.power.cosmology import input_power
from calstudy.power.delay import delay_transform, delays, horizon_delay
from calstudy.power.interface import estimate_spectra
from calstudy.power.spectra import CylindricalSpectrum, DelaySpectra, SphericalSpectrum
from calstudy.products import simulation
from calstudy.products.files import VISIBILITIES, read_visibilities
from calstudy.run.task import Job
from calstudy.sky.counts import FREQUENCY, differential_counts

if TYPE_CHECKING:
    from pyradiosky import SkyModel
    from pyuvdata import UVData


BINS = 12
POINTS_PER_BIN = 50
AREA_NSIDE = 128
TOLERANCE = 0.05
FAINT, BRIGHT = 0.1, 4.0
"""Flux densities at 200 MHz, Jy, between which sources are counted."""


@dataclass(frozen=True)
class SourceCounts:
    """Counts at 200 MHz south of +30 degrees and more than 10 degrees from the Galactic plane, an `area` in sr.

    `edges` are flux densities in Jy, (Nbins + 1,); `expected` is the `number` of Franzen et al. (2019), (Nbins,).
    """

    edges: np.ndarray
    number: np.ndarray
    expected: np.ndarray
    area: float

    @property
    def ratio(self) -> np.ndarray:
        """Number over expected number, (Nbins,)."""
        return self.number / self.expected

    @property
    def error(self) -> np.ndarray:
        """Poisson error of `ratio`, (Nbins,)."""
        return np.sqrt(self.expected) / self.expected


def count_sources(sky: SkyModel) -> SourceCounts:
    """Count point sources in bins of equal logarithmic width; those with flat spectra at their flux density."""
    import healpy
    from astropy.coordinates import SkyCoord

    from calstudy.sky.foregrounds import in_complete_area
    from calstudy.sky.spectra import at_frequencies

    if sky.spectral_type == "full":
        raise InputError("source-counts: need fluxes at 200 MHz, and the sky has them by channel alone")
    if sky.spectral_type != "flat":
        sky = at_frequencies(sky, np.array([FREQUENCY]))
    flux = sky.stokes[0, 0].to_value("Jy")
    inside = in_complete_area(sky.skycoord)
    edges = np.geomspace(FAINT, BRIGHT, BINS + 1)
    fine = np.geomspace(FAINT, BRIGHT, BINS * POINTS_PER_BIN + 1)
    density = differential_counts(fine)
    steps = np.diff(fine) * (density[:-1] + density[1:]) / 2
    longitude, latitude = healpy.pix2ang(AREA_NSIDE, np.arange(healpy.nside2npix(AREA_NSIDE)), lonlat=True)
    pixels = SkyCoord(longitude, latitude, unit="deg", frame="icrs")
    area = float(4 * np.pi * in_complete_area(pixels).mean())
    number = np.histogram(flux[inside], edges)[0]
    return SourceCounts(edges, number, expected=area * steps.reshape(BINS, -1).sum(axis=1), area=area)


def draw_counts(counts: SourceCounts) -> style.Figure:
    """Draw Euclidean-normalized counts above, and their ratio to Franzen et al. (2019) with a band of 5 % below."""
    figure = style.new_figure(style.ONE_COLUMN, 3.6)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    curve = np.geomspace(counts.edges[0], counts.edges[-1], 200)
    flux = np.sqrt(counts.edges[:-1] * counts.edges[1:])
    scale = flux**2.5 / (counts.area * np.diff(counts.edges))
    upper.plot(curve, curve**2.5 * differential_counts(curve), color=style.BLACK, label="Franzen et al. (2019)")
    look = {"fmt": "o", "color": style.BLUE}
    error = scale * np.sqrt(counts.expected)
    upper.errorbar(flux, scale * counts.number, error, label="sources of this sky", **look)
    upper.set(xscale="log", yscale="log", ylabel=r"$S^{5/2}\,dN/dS$ (Jy$^{3/2}$ sr$^{-1}$)")
    upper.legend(loc="lower right")
    lower.axhspan(1 - TOLERANCE, 1 + TOLERANCE, color=style.BAND, linewidth=0)
    lower.axhline(1, color=style.BLACK, linewidth=0.7)
    lower.errorbar(flux, counts.ratio, counts.error, **look)
    largest = max(2 * TOLERANCE, 1.1 * float(np.abs(counts.ratio - 1).max() + counts.error.max()))
    lower.set(xlabel="flux density at 200 MHz (Jy)", ylabel="ratio", ylim=(1 - largest, 1 + largest))
    return figure


class SourceCountsFigure(StudyFigure):
    """The differential source counts of the foreground sky, over those of Franzen et al. (2019)."""

    kind: str = "source-counts"

    caption = "Differential source counts at 200 MHz, and their ratio to those of Franzen et al. (2019)."
    needs_foregrounds = True
    reads: ClassVar = {}
    sections = ("sky", "instrument")

    def draw(self, job: Job) -> Drawing:
        """Count the sources."""
        from calstudy.instrument.telescope import make_template
        from calstudy.sky.foregrounds import make_foregrounds

        frequencies = make_template(job.settings["instrument"]).freq_array
        counts = count_sources(make_foregrounds(job.settings["sky"].foregrounds, frequencies).sky)
        notes = {"largest_deviation": float(np.abs(counts.ratio - 1).max())}
        return Drawing(draw_counts(counts), counts, notes)


LENGTHS = (0.0, 0.5, 1.0)
"""The baselines that are shown, as quantiles of length: shortest, median, longest."""
WAVENUMBERS = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, np.inf)
"""Limits of the ranges of k, h/Mpc, for which the notes have a ratio."""


@dataclass(frozen=True)
class BaselineDelays:
    """Rms over integrations of one baseline's delay transforms, first polarization, Jy Hz; S at its level in the data.

    `delay` is ascending, in s, and `length` is |b| in m.
    """

    antennas: tuple[int, int]
    length: float
    delay: np.ndarray
    foregrounds: np.ndarray
    eor: np.ndarray


@dataclass(frozen=True)
class SimulatedComponents:
    """The simulated components: the `wedge` of F, and P(k) of S over all modes, `eor`, with its sample variance.

    `expected`, (Nk,), is the P(k) from which S was drawn, mK^2 h^-3 Mpc^3. `buffer` is the delay beyond the horizon at
    which the experiment's window starts, s.
    """

    wedge: CylindricalSpectrum
    eor: SphericalSpectrum
    expected: np.ndarray
    baselines: tuple[BaselineDelays, ...]
    buffer: float

    def ratio(self, low: float, high: float) -> tuple[float, float]:
        """Return measured over expected power, weighted by independent modes, and its error, for low < k <= high."""
        modes = self.eor.sample_modes
        chosen = (modes > 0) & (self.eor.k > low) & (self.eor.k <= high)
        weights = modes[chosen]
        if not weights.sum():
            return np.nan, np.nan
        ratios = self.eor.power.real[chosen] / self.expected[chosen]
        return float(np.average(ratios, weights=weights)), float(1 / np.sqrt(weights.sum()))


def measure_components(foregrounds: UVData, eor: UVData, experiment: Experiment) -> SimulatedComponents:
    """Measure the spectra that are drawn, of F and S as simulated, Jy, with the settings of the experiment."""
    settings = experiment.power
    factor = eor_factor(rms(to_cube(foregrounds)), rms(to_cube(eor)), experiment.corruption.eor_level)
    of_foregrounds, of_eor = (_delay_spectra(data, experiment) for data in (foregrounds, eor))
    spectrum = spherical_average(of_eor, settings, exclude_wedge=False)
    return SimulatedComponents(
        wedge=cylindrical_average(of_foregrounds, settings),
        eor=with_errors(spectrum, signal=spectrum),
        expected=input_power(experiment.sky.eor, spectrum.k, settings.cosmology, experiment.instrument.channels.band),
        baselines=_baselines(foregrounds, eor, factor, settings.taper),
        buffer=settings.wedge_buffer,
    )


def _delay_spectra(data: UVData, experiment: Experiment) -> DelaySpectra:
    from calstudy.instrument.beams import make_beam
    from calstudy.power.average import fringe_stop_and_average

    average = fringe_stop_and_average(data)
    beam = make_beam(experiment.instrument.beam, experiment.instrument.channels)
    return estimate_spectra(average, average, beam, experiment.power)


def _baselines(foregrounds: UVData, eor: UVData, factor: float, taper: str) -> tuple[BaselineDelays, ...]:
    lengths = np.linalg.norm(baseline_vectors(foregrounds), axis=1)
    chosen = np.argsort(lengths, kind="stable")[[round(part * (len(lengths) - 1)) for part in LENGTHS]]
    frequencies = foregrounds.freq_array
    delay = delays(len(frequencies), float(np.diff(frequencies).mean()))
    transforms = (delay_transform(to_cube(data)[:, chosen][..., 0], frequencies, taper) for data in (foregrounds, eor))
    of_foregrounds, of_eor = (np.sqrt(np.mean(np.abs(transform) ** 2, axis=0)) for transform in transforms)
    return tuple(
        BaselineDelays(tuple(antenna_pairs(foregrounds)[index].tolist()), float(lengths[index]), delay, *spectra)
        for index, *spectra in zip(chosen, of_foregrounds, factor * of_eor, strict=True)
    )


def draw_components(components: SimulatedComponents) -> style.Figure:
    """Draw the wedge of F and P(k) of S above, and delay spectra of a short, a median and a long baseline below."""
    figure = style.new_figure(style.TWO_COLUMNS, 5.2)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.25, 1)).ravel()
    wedge, spherical = above.subplots(1, 2)
    _draw_wedge(above, wedge, components)
    _draw_power(spherical, components)
    panels = below.subplots(1, len(components.baselines), sharey=True)
    for axes, baseline in zip(panels, components.baselines, strict=True):
        _draw_baseline(axes, baseline, components.buffer)
    panels[0].set_ylabel(r"rms $|\widetilde{V}(\tau)|$ (Jy Hz)")
    handles, labels = panels[0].get_legend_handles_labels()
    below.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure


def _draw_wedge(figure: style.Figure, axes: style.Axes, components: SimulatedComponents) -> None:
    from matplotlib.colors import LogNorm

    power = np.abs(components.wedge.power.real)
    shown = power[np.isfinite(power) & (power > 0)]
    lowest, highest = 10 ** np.floor(np.log10(np.quantile(shown, 0.01))), 10 ** np.ceil(np.log10(shown.max()))
    look = {"norm": LogNorm(lowest, highest), "cmap": colour_map(POSITIVE)}
    mesh = draw_cells(axes, components.wedge, np.maximum(power, lowest), **look)
    draw_horizon(axes, components.wedge, components.buffer)
    label_axes(axes, components.wedge)
    axes.set_ylabel(style.K_PARALLEL)
    name_horizon(axes)
    bar = figure.colorbar(mesh, ax=axes, pad=0.02)
    bar.set_label(rf"$|P^F|$ ({style.POWER_UNIT})")
    bar.ax.tick_params(which="both", direction="out")


def _draw_power(axes: style.Axes, components: SimulatedComponents) -> None:
    spectrum = components.eor
    finite = np.isfinite(spectrum.power.real)
    ratio = spectrum.power.real[finite] / components.expected[finite]
    half = SIGMAS_95 * spectrum.error[finite] / components.expected[finite]
    axes.axhline(1, color=style.BLACK, linewidth=0.9, zorder=3)
    axes.errorbar(spectrum.k[finite], ratio, half, fmt="o", color=style.BLUE, markersize=2.2, elinewidth=0.7)
    reach = 1.05 * float(np.max(np.abs(ratio - 1) + half))
    axes.set(xscale="log", xlabel=style.WAVENUMBER, ylabel=r"$P^S$ over its input", ylim=(1 - reach, 1 + reach))
    style.label_one_two_five(axes.xaxis)
    axes.set_title("bars: 95 % of the sample variance", fontsize=style.SMALL_SIZE)


def _draw_baseline(axes: style.Axes, baseline: BaselineDelays, buffer: float) -> None:
    nanoseconds = baseline.delay * 1e9
    axes.plot(nanoseconds, baseline.foregrounds, color=style.RED, linewidth=0.9, label="$F$")
    axes.plot(nanoseconds, baseline.eor, color=style.BLUE, linewidth=0.7, label="$S$, at the level on the data")
    horizon = float(horizon_delay(baseline.length))
    for extra, line, label in horizon_lines(buffer):
        for sign in (-1, 1):
            where = sign * (horizon + extra) * 1e9
            axes.axvline(where, color=style.BLACK, linestyle=line, linewidth=0.6, label=label if sign > 0 else None)
    span = min(MAX_DELAY, float(baseline.delay[-1])) * 1e9
    axes.set(yscale="log", xlabel=style.DELAY, xlim=(-span, span))
    first, second = baseline.antennas
    axes.set_title(rf"({first}, {second}), $|\mathbf{{b}}| = {baseline.length:.1f}$ m")


class SimulatedComponentsFigure(StudyFigure):
    """The simulated components alone: wedge of F, P(k) of S over its input, delay spectra of three baselines."""

    # Baselines of equal lengths share a bin of the wedge since 2.
    version: ClassVar[int] = 2

    kind: str = "simulated-components"

    caption = "Simulated components alone: wedge of F, P(k) of S over its input, and delay spectra of three baselines."
    needs_foregrounds = True
    reads: ClassVar = {"foregrounds": simulation.foregrounds, "eor": simulation.eor}
    sections = ("instrument", "sky", "corruption", "power")

    def draw(self, job: Job) -> Drawing:
        """Measure the spectra."""
        experiment = cast(Experiment, SimpleNamespace(**{name: job.settings[name] for name in self.sections}))
        foregrounds, eor = (read_visibilities(job.inputs[name] / VISIBILITIES) for name in ("foregrounds", "eor"))
        found = measure_components(foregrounds, eor, experiment)
        ratios = {f"{low:g} to {high:g}": found.ratio(low, high) for low, high in pairwise(WAVENUMBERS)}
        measured = {k: list(ratio) for k, ratio in ratios.items() if np.isfinite(ratio[0])}
        return Drawing(draw_components(found), found, {"eor_over_input": measured})
