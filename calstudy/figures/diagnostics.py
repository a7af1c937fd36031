"""Diagnostics of a calibration of measured data: data, model and residual in delay, gains, convergence, and chi^2."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.gains import find_gain_errors
from calstudy.base.visibilities import antenna_pairs, baseline_vectors, flag_cube, rows_of, to_cube
from calstudy.calibrate.basis import ChannelGrid, channel_grid
from calstudy.figures import Drawing, StudyFigure
from calstudy.plotting import style
from calstudy.plotting.axes import TAPER, mark_horizon
from calstudy.power.delay import horizon_delay, make_taper
from calstudy.products.calibration import read_result
from calstudy.products.files import DATA, GAINS, read_visibilities
from calstudy.products.gain_errors import observed_gain_errors
from calstudy.products.observed import calibrated, observed
from calstudy.run.task import Job, Task

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.calibrate.records import CalibrationResult
    from calstudy.products.graph import MeasuredGraph

COLOURS = {"data": style.BLACK, "model": style.BLUE, "residual": style.ORANGE}
MAX_NAMES = 20
LINEAR_RANGE = 5.0
SHORT_AXIS = 100.0
LABELLED_DIGITS = (2, 3, 5)
MAX_ANTENNAS = 8
"""Largest number of antennas whose gains are drawn."""


@dataclass(frozen=True)
class Diagnostics:
    """The arrays of the figure, for one polarization.

    Attributes
    ----------
    delay : s, ascending, (Ndelays,)
    lengths : baseline lengths in m, ascending, (Nbls,)
    data, model, residual
        Delay transform after a Blackman-Harris taper, rms over integrations, (Nbls, Ndelays); flagged samples are zero.
    frequency : Hz, (Nfreqs,)
    antennas : names of the antennas that are drawn, (Nshown,)
    gains : complex, of the middle integration, NaN where flagged, (Nshown, Nfreqs)
    errors : of |g| and, in rad, of the phase, by noise; NaN where they are not known, (2, Nshown, Nfreqs)
    losses : loss after each step over the first loss of its own solve, one array for each solve
    converged : true for each solve that converged, (Nsolves,)
    chi2_antennas : names of all calibrated antennas, (Nants,)
    chi2_by_antenna, chi2_by_channel, chi2_by_integration : as in `calstudy.realdata.quality.Quality`
    """

    polarization: str
    unit: str
    delay: np.ndarray
    lengths: np.ndarray
    data: np.ndarray
    model: np.ndarray
    residual: np.ndarray
    frequency: np.ndarray
    antennas: np.ndarray
    gains: np.ndarray
    errors: np.ndarray
    losses: tuple[np.ndarray, ...]
    converged: np.ndarray
    chi2_antennas: np.ndarray
    chi2_by_antenna: np.ndarray
    chi2_by_channel: np.ndarray
    chi2_by_integration: np.ndarray


def _delay_rms(cube: np.ndarray, grid: ChannelGrid) -> np.ndarray:
    """Return the rms over integrations of the tapered delay transform, (Nbls, n_channels of the grid).

    `cube` holds visibilities, zero where flagged, (Ntimes, Nbls, Nfreqs). A tone at a delay of the transform keeps its
    amplitude.
    """
    taper = make_taper(TAPER, grid.n_channels)
    # One integration after the other, for the memory.
    power: Any = sum(np.abs(np.fft.ifft(grid.filled(integration) * taper, axis=-1)) ** 2 for integration in cube)
    return np.fft.fftshift(np.sqrt(power / len(cube)), axes=-1) * grid.n_channels / taper.sum()


def draw_diagnostics(found: Diagnostics) -> style.Figure:
    """Draw four rows: delay spectra by baseline length, their mean and convergence, the gains, and chi^2.

    The dashed lines are the horizon |b|/c; images are decibel of amplitude relative to the peak of the data. Flagged
    samples count as zero, which spreads over all delays. Bands are the errors of gains by noise.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 8.4)
    grid = figure.subplot_mosaic([list("dddmmmrrr"), list("pppppllll"), list("aaaaaffff"), list("xxxyyyzzz")])
    _draw_images(figure, [grid[key] for key in "dmr"], found)
    _draw_profile(grid["p"], found)
    _draw_convergence(grid["l"], found)
    for axes, values, errors, label in (
        (grid["a"], np.abs(found.gains), found.errors[0], r"$|g|$"),
        (grid["f"], np.angle(found.gains), found.errors[1], r"arg $g$ (rad)"),
    ):
        for name, row, error in zip(found.antennas, values, errors, strict=True):
            (line,) = axes.plot(found.frequency / 1e6, row, linewidth=0.7, label=str(name))
            band = row - error, row + error
            axes.fill_between(found.frequency / 1e6, *band, color=line.get_color(), alpha=0.25, linewidth=0)
        axes.set(xlabel=style.FREQUENCY, ylabel=label)
        axes.margins(x=0)
    _make_logarithmic(grid["a"], np.abs(found.gains))
    _draw_chi2([grid[key] for key in "xyz"], found)
    for axes in grid.values():
        _label_between_powers(axes)
    # Above the axes: gains of measured data have peaks anywhere.
    grid["a"].legend(ncols=4, fontsize=style.SMALL_SIZE - 1, loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.2)
    return figure


def _draw_images(figure: style.Figure, panels: list[style.Axes], found: Diagnostics) -> None:
    from matplotlib.ticker import MaxNLocator

    peak = max(found.data.max(), np.finfo(float).tiny)
    edges = np.linspace(found.delay[0], found.delay[-1], found.delay.size) * 1e9
    rows = np.arange(found.lengths.size)
    look: dict[str, Any] = {"vmin": -80, "vmax": 0, "shading": "nearest", "cmap": "inferno", "rasterized": True}
    for axes, title in zip(panels, COLOURS, strict=True):
        level = 20 * np.log10(np.maximum(getattr(found, title) / peak, 1e-9))
        mesh = axes.pcolormesh(edges, rows, level, **look)
        for sign in (-1, 1):
            horizon = sign * horizon_delay(found.lengths) * 1e9
            axes.plot(horizon, rows, color="white", linestyle="--", linewidth=0.7)
        axes.set(title=f"{title}, {found.polarization}", xlabel=style.DELAY, xlim=(edges[0], edges[-1]))
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    panels[0].set_ylabel("baseline, by length")
    figure.colorbar(mesh, ax=panels, label="dB of the peak", pad=0.01, aspect=15)


def _draw_profile(axes: style.Axes, found: Diagnostics) -> None:
    for label, colour in COLOURS.items():
        mean = np.sqrt(np.mean(getattr(found, label) ** 2, axis=0))
        axes.plot(found.delay * 1e9, np.where(mean > 0, mean, np.nan), color=colour, label=label)
    mark_horizon(axes, horizon_delay(float(found.lengths.max())), style.GREY, zorder=2)
    visible = found.data.max() > 0
    axes.set(xlabel=style.DELAY, ylabel=f"rms over baselines ({found.unit})", yscale="log" if visible else "linear")
    axes.margins(x=0)
    axes.legend(loc="best")


def _make_logarithmic(axes: style.Axes, values: np.ndarray) -> None:
    """Make the vertical axis logarithmic if values differ by more than a factor of `LINEAR_RANGE`."""
    positive = values[np.isfinite(values) & (values > 0)]
    if positive.size and positive.max() > LINEAR_RANGE * positive.min():
        axes.set_yscale("log")


def _label_between_powers(axes: style.Axes) -> None:
    """Label 0.2, 0.3 and 0.5 of a logarithmic vertical axis that is shorter than two decades.

    The default labels, such as 6 × 10⁻¹, are so wide that a constrained layout finds no room for the axes.
    """
    from matplotlib.ticker import FuncFormatter, NullFormatter

    if axes.get_yscale() != "log":
        return
    low, high = axes.get_ylim()
    short = high < SHORT_AXIS * low
    axes.yaxis.set_minor_formatter(FuncFormatter(_label_one_digit) if short else NullFormatter())


def _label_one_digit(value: float, _: float) -> str:
    digit = round(value / 10 ** np.floor(np.log10(value)))
    return f"{value:g}" if digit in LABELLED_DIGITS else ""


def _draw_chi2(panels: list[style.Axes], found: Diagnostics) -> None:
    from matplotlib.ticker import MaxNLocator

    antennas = np.arange(found.chi2_antennas.size)
    integrations = np.arange(found.chi2_by_integration.size)
    for axes, places, values, label in (
        (panels[0], antennas, found.chi2_by_antenna, "antenna"),
        (panels[1], found.frequency / 1e6, found.chi2_by_channel, style.FREQUENCY),
        (panels[2], integrations, found.chi2_by_integration, "integration"),
    ):
        axes.plot(places, values, color=style.BLUE, linewidth=0.7, marker=".", markersize=2)
        axes.set(xlabel=label, ylabel=r"mean $\chi^2$")
        _make_logarithmic(axes, values)
    shown = _spread(antennas.size, MAX_NAMES)
    panels[0].set_xticks(shown, found.chi2_antennas[shown], rotation=90, fontsize=style.SMALL_SIZE - 1)
    # A single integration would have an axis of fractions.
    panels[2].xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    panels[2].set_xlim(-0.5, len(integrations) - 0.5)


def _draw_convergence(axes: style.Axes, found: Diagnostics) -> None:
    from matplotlib.ticker import MaxNLocator

    for losses, converged in zip(found.losses, found.converged, strict=True):
        positive = np.where(losses > 0, losses, np.nan)
        axes.plot(positive, color=style.BLUE if converged else style.RED, linewidth=0.7, marker=".", markersize=2)
    good, count = int(np.sum(found.converged)), len(found.converged)
    axes.set(xlabel="step", ylabel="loss / first loss")
    _make_logarithmic(axes, np.concatenate(found.losses or (np.empty(0),)))
    axes.set_title(f"{good} of {count} solves converged (blue)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _spread(count: int, most: int) -> np.ndarray:
    """Return places spread over a list, at most so many."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))


def diagnose(data: UVData, result: CalibrationResult, errors: np.ndarray | None) -> Diagnostics:
    """Collect the arrays of the figure for the first polarization of data and their calibration.

    `errors` are of |g| and of the phase of the gains, (2, Nants, Nfreqs, Ntimes, Npols).
    """
    from calstudy.realdata.quality import assess

    model = result.model
    rows = rows_of(data, antenna_pairs(model))
    lengths = np.linalg.norm(baseline_vectors(model), axis=1)
    order = np.argsort(lengths, kind="stable")
    grid = channel_grid(np.asarray(model.freq_array, float))
    flags = flag_cube(result.residual)[..., 0]
    measured = np.where(flags, 0, to_cube(data)[..., 0][:, rows])
    cubes = {"data": measured, "model": to_cube(model)[..., 0], "residual": to_cube(result.residual)[..., 0]}
    spectra = {name: _delay_rms(np.where(flags, 0, cube)[:, order], grid) for name, cube in cubes.items()}
    antennas, gains, shown_errors = _shown_gains(result, errors)
    number = int(model.polarization_array[0])
    records = [one for one in result.solutions if one.polarization == number and one.loss_history.size]
    quality = assess(data, result, 0)
    return Diagnostics(
        polarization=quality.polarization,
        unit=model.vis_units,
        delay=np.fft.fftshift(np.fft.fftfreq(grid.n_channels, grid.width)),
        lengths=lengths[order],
        **spectra,
        frequency=np.asarray(model.freq_array, float),
        antennas=antennas,
        gains=gains,
        errors=shown_errors,
        losses=tuple(record.loss_history / record.loss_history[0] for record in records),
        chi2_antennas=quality.antennas,
        chi2_by_antenna=quality.chi2_by_antenna,
        chi2_by_channel=quality.chi2_by_channel,
        chi2_by_integration=quality.chi2_by_integration,
        converged=np.array([record.status == "converged" for record in records]),
    )


def _shown_gains(result: CalibrationResult, errors: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return names of antennas with solutions, spread over the array, their gains, NaN where flagged, and errors."""
    gains = result.gains
    flags = gains.flag_array[..., 0]
    used = np.flatnonzero(~flags.all(axis=(1, 2)))
    used = used[_spread(used.size, MAX_ANTENNAS)]
    values = np.where(flags[used], np.nan, gains.gain_array[used, :, :, 0])
    times = np.flatnonzero(~flags.all(axis=(0, 1)))
    middle = times[times.size // 2] if times.size else 0
    names = dict(zip(gains.telescope.antenna_numbers.tolist(), gains.telescope.antenna_names, strict=True))
    found = np.full((2, *values.shape[:2]), np.nan) if errors is None else errors[:, used][..., middle, 0]
    return np.array([str(names[int(number)]) for number in gains.ant_array[used]]), values[:, :, middle], found


class DiagnosticsFigure(StudyFigure):
    """Diagnostics of a calibration of measured data, of the even half or of all data."""

    # Gains are drawn with their errors since 2, polarizations named as in the file since 3, and chi^2 has no
    # autocorrelations since 4.
    version: ClassVar[int] = 4
    kind: str = "diagnostics"

    gain_errors: bool | Annotated[int, Field(ge=2)] = Field(
        True,
        description="Draw the errors of gains, and compute them if they are not yet; a number: by so many realizations "
        "of the noise where a fit has none of its own.",
    )

    of = ("observed",)
    caption = (
        "The calibration of the measured data, of the first polarization: data, model and residual by baseline length "
        "and delay, convergence of the solves, gains with errors, and chi^2 of antennas, channels and integrations."
    )

    def inputs(self, graph: MeasuredGraph) -> Mapping[str, Task]:
        """Return the data and the calibration of the first part."""
        part = next(iter(graph.parts.facts))
        errors = {"errors": observed_gain_errors(graph, part, self.gain_errors)} if self.gain_errors else {}
        return {"data": observed(graph, part), "calibration": calibrated(graph, part), **errors}

    def draw(self, job: Job) -> Drawing:
        """Draw the diagnostics of the first polarization."""
        data = read_visibilities(job.inputs["data"] / DATA)
        known = find_gain_errors(job.inputs["errors"] / GAINS) if self.gain_errors else None
        errors = None if known is None else np.stack([known.amplitude, known.phase])
        found = diagnose(data, read_result(job.inputs["calibration"]), errors)
        return Drawing(draw_diagnostics(found), found)
