"""The spectrum of the residual without its loss: of a run with its window functions, or of realizations of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.base.table import Table
from calstudy.experiment.model import Experiment
from calstudy.figures import Drawing, StudyFigure
from calstudy.plotting import style
from calstudy.power.tables import load_spectrum
from calstudy.power.windows import UnbiasedSpectrum
from calstudy.products.comparison import case_name
from calstudy.products.unbiased import UNBIASED, unbiased, why_not
from calstudy.run.task import Job
from calstudy.verdicts.tolerances import Drawn, Rules

CSV = "unbiased.csv"
WITHIN = (1.0, SIGMAS_95)
"""Numbers of errors within which the spectra are counted."""
ROUTES = {
    "measured": ("as measured", "o", style.GREY),
    "by_flat": ("divided by T of a flat spectrum", "s", style.ORANGE),
    "unbiased": (r"$W^{-1}$", "D", style.BLUE),
}


@dataclass(frozen=True)
class Recovered:
    """Means over realizations of spectra over the power of their signals, by the `ROUTES`, (Nk,), in bins of k, h/Mpc.

    NaN in bins without a result. Errors are by the scatter of the difference from the power of the same realization's
    signal, so that they are free of its sample variance; of a single realization, its own. `within`, (2,), are the
    fractions of bins and realizations in which W^-1 P^R is within 1 and 1.96 errors of the mean power of the signals.
    """

    k: np.ndarray
    measured: np.ndarray
    by_flat: np.ndarray
    unbiased: np.ndarray
    measured_error: np.ndarray
    by_flat_error: np.ndarray
    unbiased_error: np.ndarray
    within: np.ndarray
    realizations: int


def recovered(found: Sequence[UnbiasedSpectrum]) -> Recovered:
    """Average the spectra of realizations that differ in seeds alone."""
    truth = np.mean([one.signal for one in found], axis=0)
    pulls = np.array([(one.power - truth) / one.error for one in found])
    known = np.isfinite(pulls)
    routes = np.array([[one.measured, one.measured / one.flat_transfer, one.power] for one in found]) / truth
    if len(found) == 1:
        [one] = found
        errors = np.array([one.measured_error, one.measured_error / one.flat_transfer, one.error]) / truth
    else:
        own = np.array([one.signal for one in found]) / truth
        errors = (routes - own[:, None]).std(axis=0, ddof=1) / np.sqrt(len(found))
    columns = np.where(known.all(axis=0), [*routes.mean(axis=0), *errors], np.nan)
    within = np.array([np.mean(np.abs(pulls[known]) < limit) for limit in WITHIN])
    names = [*ROUTES, *(f"{name}_error" for name in ROUTES)]
    by_name = dict(zip(names, columns, strict=True))
    return Recovered(found[0].k, **by_name, within=within, realizations=len(found))


def draw_unbiased(found: UnbiasedSpectrum) -> style.Figure:
    """Draw P^S, P^R and W^-1 P^R with 95 % bars, and beside them the window functions, each over its sum.

    Open symbols are the absolute values of negative power.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 3.0)
    left, right = figure.subplots(1, 2, width_ratios=(1.2, 1.0))
    shift = 0.1 * np.diff(found.bin_edges)
    left.step(found.bin_edges, np.append(found.signal, found.signal[-1]), where="post", color=style.BAND, linewidth=3)
    drawn = (("measured", found.measured, found.measured_error, -1), ("unbiased", found.power, found.error, 1))
    for name, power, error, side in drawn:
        label, marker, colour = ROUTES[name]
        k = found.k + side * shift
        style.error_bars(left, k, np.abs(power), error, fmt=marker, color=colour, label=f"$P^R$, {label}")
        left.plot(k[power < 0], -power[power < 0], marker, color=colour, markerfacecolor="white")
    left.plot([], [], color=style.BAND, linewidth=3, label="$P^S$")
    left.set(ylabel=rf"$P$ ({style.POWER_UNIT}), 95 % bars", yscale="log")
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper left", ncols=3)
    known = np.isfinite(found.power)
    for window, total in zip(found.window[known], found.flat_transfer[known], strict=True):
        right.plot(found.k, window / total, linewidth=0.8)
    right.set(ylabel="window function")
    for axes in (left, right):
        axes.set(xlabel=style.WAVENUMBER, xlim=(0, found.bin_edges[-1]))
    return figure


def draw_recovered(groups: Mapping[str, Mapping[str, Recovered]]) -> style.Figure:
    """Draw the means over realizations, over the power of the signals, with bars of 1.96 standard errors.

    A row for each kind of signal, and a column for each calibrator, by their names.
    """
    columns = max(map(len, groups.values()))
    figure = style.new_figure(style.TWO_COLUMNS, 0.6 + 1.7 * len(groups))
    grid = figure.subplots(len(groups), columns, sharex=True, sharey="row", squeeze=False)
    for row, (world, calibrators) in zip(grid, groups.items(), strict=True):
        for axes, (name, found) in zip(row, calibrators.items(), strict=False):
            _draw_routes(axes, found)
            axes.set_title(f"{name}, {world}")
        row[0].set_ylabel(r"$P\,/\,P^{S}$, $\pm 1.96\,\sigma$")
    for axes in grid[-1]:
        axes.set_xlabel(style.WAVENUMBER)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(ROUTES))
    return figure


def _draw_routes(axes: style.Axes, found: Recovered) -> None:
    axes.axhline(1, color=style.GREY, linewidth=0.7, zorder=0)
    width = np.diff(found.k).min() if found.k.size > 1 else 0.0
    for place, (name, (label, marker, colour)) in enumerate(ROUTES.items()):
        k, (mean, error) = (
            found.k + 0.15 * (place - 1) * width,
            (getattr(found, key) for key in (name, f"{name}_error")),
        )
        style.error_bars(axes, k, mean, error, fmt=marker, color=colour, label=f"$P^R$, {label}")


def _error(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """Return the error of what is drawn beside it."""
    stem, _, last = name.rpartition(".")
    own = {"power": "error", "window": "error", "signal": "error"}.get(last, f"{last}_error")
    return arrays[f"{stem}.{own}" if stem else own]


def _counting_error(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """Return the error of a fraction of bins with a result, in all realizations, as if they were independent."""
    stem = name.removesuffix("within")
    count = int(arrays[f"{stem}realizations"]) * np.isfinite(arrays[f"{stem}unbiased"]).sum()
    # Not zero for none and all.
    part = (count * arrays[name] + 1) / (count + 2)
    return np.sqrt(part * (1 - part) / count)


class UnbiasedFigure(StudyFigure):
    """The spectrum of the residual without its loss, for a signal of any slope.

    Of a comparison whose worlds are realizations: those whose names agree up to a comma are averaged.
    """

    kind: str = "unbiased"
    of = ("experiment", "comparison")
    reads: ClassVar = {"": unbiased}
    caption = (
        "Power spectrum of the residual outside the wedge as measured, and deconvolved with the window functions of "
        "the calibration, beside the EoR, with 95 % bars; open symbols: negative."
    )
    needs_signal_loss = True
    needs_calibration = True
    needs_least_squares = True
    tolerances: ClassVar[Rules] = (
        (r"(.*\.)?(measured|by_flat|unbiased|power|signal)", Drawn(_error, "its error")),
        (r"(.*\.)?within", Drawn(_counting_error, "the error of a count of bins and realizations", 1)),
        (r"(.*\.)?.*error", Drawn(lambda arrays, name: np.abs(arrays[name]), "an error by few realizations", 1)),
    )

    def refusal(self, experiment: Experiment) -> str | None:
        """Return why the figure cannot be drawn of an experiment, to follow its name, or None."""
        if reason := super().refusal(experiment):
            return reason
        lacking = why_not(experiment)
        return f"needs {lacking}" if lacking else None

    def draw(self, job: Job) -> Drawing:
        """Draw one spectrum, or the means over the realizations of every calibrator and kind of signal."""
        if "worlds" not in job.settings:
            found = load_spectrum(next(iter(job.inputs.values())) / UNBIASED, UnbiasedSpectrum)
            return Drawing(draw_unbiased(found), found)
        groups = {
            world: {name: recovered(spectra) for name, spectra in found.items()}
            for world, found in _realizations(job).items()
        }
        _table(groups).write_csv(job.output / CSV)
        return Drawing(draw_recovered(groups), groups)


def _realizations(job: Job) -> dict[str, dict[str, list[UnbiasedSpectrum]]]:
    """Return the spectra by kind of signal and calibrator."""
    groups: dict[str, dict[str, list[UnbiasedSpectrum]]] = {}
    for row, world in enumerate(job.settings["worlds"]):
        for column, calibrator in enumerate(job.settings["calibrators"]):
            if (name := case_name(row, column)) in job.inputs:
                found = groups.setdefault(world.partition(",")[0], {}).setdefault(calibrator, [])
                found.append(load_spectrum(job.inputs[name] / UNBIASED, UnbiasedSpectrum))
    return groups


def _table(groups: Mapping[str, Mapping[str, Recovered]]) -> Table:
    rows: list[tuple[Any, ...]] = [
        (world, name, found.realizations, *found.within)
        for world, calibrators in groups.items()
        for name, found in calibrators.items()
    ]
    return Table(("signal", "calibrator", "realizations", "within 1 error", "within 1.96 errors"), rows)
