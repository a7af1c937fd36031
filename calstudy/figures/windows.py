"""The power spectrum without what the calibration did to it, and the windows of the calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.figures import Drawing, StudyFigure
from calstudy.figures.comparison import LARGEST_K, look
from calstudy.plotting import style
from calstudy.power.tables import load_spectrum
from calstudy.power.windows import UnbiasedSpectrum, Windows
from calstudy.products import windows
from calstudy.products.comparison import case_name
from calstudy.products.graph import Graph, required
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, Rules, half, own_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from calstudy.experiment.model import Experiment


ESTIMATED = r"$U P^R$"
DIVIDED = r"$P^R / T$ of a flat EoR"
RATIO = r"estimated $P$ over $P^S$"
SOLID: Mapping[str, Any] = {"fmt": "o", "color": style.BLUE}
HOLLOW: Mapping[str, Any] = {"fmt": "D", "color": style.ORANGE, "markerfacecolor": "white"}
SHOWN_K = 0.6
"""End of the axis of worlds, h/Mpc: T is the same at all k beyond."""


@style.journal_style()
def draw_windows(found: Windows, spectrum: UnbiasedSpectrum) -> Figure:
    """Draw the windows after calibration on the left, and the spectrum over that put in on the right."""
    figure = style.new_figure(style.TWO_COLUMNS, 2.9)
    left, right = figure.subplots(1, 2)
    rows = np.flatnonzero(found.estimated)
    for place, row in enumerate(rows):
        colour = look(place)["color"]
        left.plot(found.k, found.after[row], color=colour)
        left.plot(found.k, found.before[row], color=colour, linewidth=0.6, linestyle=":")
    left.set(xlabel=style.WAVENUMBER, ylabel="part of the bin's power", xlim=(0, LARGEST_K))
    left.set_title("windows, dotted without calibration")
    right.axhline(1, color=style.GREY, linewidth=0.7, zorder=0)
    ratio, error = spectrum.power / spectrum.signal, spectrum.error / spectrum.signal
    right.errorbar(found.k[rows], ratio[rows], SIGMAS_95 * error[rows], label=ESTIMATED, elinewidth=0.7, **SOLID)
    right.errorbar(found.k[rows], (spectrum.divided / spectrum.signal)[rows], label=DIVIDED, **HOLLOW)
    right.set(xlabel=style.WAVENUMBER, ylabel=RATIO, xlim=(0, LARGEST_K))
    right.legend()
    return figure


class WindowsFigure(StudyFigure):
    """The windows of the calibration, and the power spectrum that is estimated with them."""

    kind: str = "windows"

    caption = "Windows of the calibrated spectrum outside the wedge, and the estimated spectrum with 95 % bars."
    needs_signal_loss = True
    needs_least_squares = True
    needs_calibration = True

    def refusal(self, experiment: Experiment) -> str | None:
        """Return why the figure cannot be drawn of an experiment, or None."""
        return super().refusal(experiment) or windows.why_no_windows(experiment) or None

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the windows."""
        return {"windows": required(windows.windows(graph))}

    def draw(self, job: Job) -> Drawing:
        """Draw the windows and the spectrum."""
        found, spectrum = _read(job.inputs["windows"])
        shown = {"windows": found, "spectrum": spectrum}
        return Drawing(draw_windows(found, spectrum), shown)


def _read(folder: Path) -> tuple[Windows, UnbiasedSpectrum]:
    return load_spectrum(folder / windows.WINDOWS, Windows), load_spectrum(folder / windows.UNBIASED, UnbiasedSpectrum)


@dataclass(frozen=True)
class Coverage:
    """Estimates of the power spectrum over that put in, in worlds that differ by chance.

    Attributes
    ----------
    k
        h/Mpc, (Nk,); all others are of these bins, NaN where nothing is estimated.
    ratio, ratio_error
        Mean over the worlds of U P^R / P^S, and its standard deviation from their scatter.
    divided, divided_error
        The same for P^R over the T of a flat EoR.
    worlds
        In how many worlds a bin is estimated.
    within
        Part of the estimates within one and two of their standard deviations of P^S, over all bins and worlds, (2,).
    """

    k: np.ndarray
    ratio: np.ndarray
    ratio_error: np.ndarray
    divided: np.ndarray
    divided_error: np.ndarray
    worlds: np.ndarray
    within: np.ndarray


def coverage(spectra: Sequence[UnbiasedSpectrum]) -> Coverage:
    """Return the mean estimate of some worlds, in which the same bins are compared for both estimates."""
    power, error, signal, divided = (
        np.array([getattr(one, name) for one in spectra]) for name in ("power", "error", "signal", "divided")
    )
    pulls = np.abs((power - signal) / error)
    pulls = pulls[np.isfinite(pulls)]
    known = np.isfinite(power)
    worlds = known.sum(axis=0)

    def mean(estimate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # P is estimated, not its logarithm: the ratio of the means does not favour worlds with little power.
        enough = np.where(worlds > 1, worlds, np.nan)
        total = np.where(known, signal, 0).sum(axis=0) / enough
        found = np.where(known, estimate, 0).sum(axis=0) / enough / total
        scatter = np.where(known, estimate - found * signal, 0) ** 2
        return found, np.sqrt(scatter.sum(axis=0) / (enough - 1) / enough) / total

    with np.errstate(invalid="ignore"):
        ratio, ratio_error = mean(power)
        other, other_error = mean(divided)
    within = np.array([np.mean(pulls < limit) if pulls.size else np.nan for limit in (1, 2)])
    return Coverage(spectra[0].k, ratio, ratio_error, other, other_error, worlds, within)


@style.journal_style()
def draw_unbiased(found: Mapping[str, Mapping[str, Coverage]]) -> Figure:
    """Draw both estimates over the power put in, by calibrator (rows) and kind of world (columns), with 95 % bars."""
    kinds = list(dict.fromkeys(kind for row in found.values() for kind in row))
    figure = style.new_figure(style.TWO_COLUMNS, 0.7 + 1.7 * len(found))
    grid = figure.subplots(len(found), len(kinds), squeeze=False, sharex=True, sharey=True)
    for axes_of_row, (calibrator, row) in zip(grid, found.items(), strict=True):
        for axes, kind in zip(axes_of_row, kinds, strict=True):
            if kind not in row:
                axes.set_axis_off()
                continue
            _draw_coverage(axes, row[kind])
            axes.set_title(f"{calibrator}: {kind}", loc="left")
        axes_of_row[0].set_ylabel(RATIO)
    for axes in grid[-1]:
        axes.set_xlabel(style.WAVENUMBER)
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2)
    return figure


def _draw_coverage(axes: Axes, found: Coverage) -> None:
    axes.axhline(1, color=style.GREY, linewidth=0.7, zorder=0)
    shift = 0.1 * np.diff(found.k).min()
    for values, errors, offset, points in (
        (found.divided, found.divided_error, shift, HOLLOW),
        (found.ratio, found.ratio_error, -shift, SOLID),
    ):
        label = ESTIMATED if offset < 0 else DIVIDED
        axes.errorbar(found.k + offset, values, SIGMAS_95 * errors, elinewidth=0.7, markersize=3, label=label, **points)
    axes.set(xlim=(0, SHOWN_K), ylim=(0.5, 1.5))
    one, two = 100 * found.within
    text = f"within 1σ {one:.0f} %, 2σ {two:.0f} % of {found.worlds.sum()}"
    axes.annotate(text, (0.98, 0.04), xycoords="axes fraction", ha="right", fontsize=style.SMALL_SIZE)


def kind_of(world: str) -> str:
    """Return what a world has in common with those that differ by chance: its label without the part after a comma."""
    return world.rpartition(", ")[0] or world


class UnbiasedSpectra(StudyFigure):
    """Power spectra without what calibrators did to them, over those put in, of worlds that differ by chance."""

    kind: str = "unbiased-spectra"

    of = ("comparison",)
    caption = (
        "Estimated power over that put in, with the windows of the calibration and by dividing by the T of a flat EoR: "
        "means over worlds whose labels differ after a comma, with 95 % bars from their scatter, and the part of the "
        "estimates within one and two of their standard deviations."
    )
    tolerances: ClassVar[Rules] = (
        (r".*\.(ratio|divided)", Drawn(own_error, "its error", largest=12.0)),
        (r".*\.(worlds|within)", Drawn(half, "counts of draws of the noise; half of it")),
    )

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the windows of one case, if it has some."""
        task = windows.windows(graph)
        return {} if task is None else {"": task}

    def draw(self, job: Job) -> Drawing:
        """Draw all calibrators and kinds of worlds."""
        spectra: dict[str, dict[str, list[UnbiasedSpectrum]]] = {}
        for column, calibrator in enumerate(job.settings["calibrators"]):
            for row, world in enumerate(job.settings["worlds"]):
                folder: Any = job.inputs.get(case_name(row, column))
                if folder is not None:
                    spectra.setdefault(calibrator, {}).setdefault(kind_of(world), []).append(_read(folder)[1])
        found = {
            calibrator: {kind: coverage(several) for kind, several in kinds.items()}
            for calibrator, kinds in spectra.items()
        }
        return Drawing(draw_unbiased(found), found)
