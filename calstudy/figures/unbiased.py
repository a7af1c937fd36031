"""The spectrum of the residual without its loss: of a run with its window functions, or of realizations of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.base.table import Table
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS, Experiment
from calstudy.figures import Drawing, StudyFigure
from calstudy.plotting import style
from calstudy.power.tables import load_spectrum
from calstudy.power.windows import UnbiasedSpectrum
from calstudy.products.comparison import case_name
from calstudy.products.graph import Graph
from calstudy.products.unbiased import UNBIASED, unbiased, why_not
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, Rules

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    """Spectra of realizations over the mean power of their signals, in bins of k, by three routes.

    Attributes
    ----------
    k : centres, h/Mpc, (Nk,)
    measured, by_flat, unbiased
        Means over realizations, (Nk,), of P^R, P^R over T of a flat spectrum, and W^-1 P^R; NaN in bins without a
        result.
    measured_error, by_flat_error, unbiased_error
        Their standard errors, (Nk,): by the scatter over realizations of the difference from the power of the signal of
        the same realization, so that they are free of its sample variance; of a single realization, its own errors.
    within
        Fraction of the bins and realizations in which W^-1 P^R is within 1 and 1.96 of its errors of the mean power of
        the signals, (2,)
    realizations : their number
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
    routes = {
        "measured": np.array([one.measured / truth for one in found]),
        "by_flat": np.array([one.measured / one.flat_transfer / truth for one in found]),
        "unbiased": np.array([one.power / truth for one in found]),
    }
    pulls = np.array([(one.power - truth) / one.error for one in found])
    known = np.isfinite(pulls)
    means = {name: values.mean(axis=0) for name, values in routes.items()}
    own = np.array([one.signal / truth for one in found])
    if len(found) == 1:
        [one] = found
        each = one.measured_error, one.measured_error / one.flat_transfer, one.error
        errors = {f"{name}_error": error / truth for name, error in zip(routes, each, strict=True)}
    else:
        scatter = {name: (values - own).std(axis=0, ddof=1) for name, values in routes.items()}
        errors = {f"{name}_error": values / np.sqrt(len(found)) for name, values in scatter.items()}
    for values in (*means.values(), *errors.values()):
        values[~known.all(axis=0)] = np.nan
    within = np.array([np.mean(np.abs(pulls[known]) < limit) for limit in WITHIN])
    return Recovered(found[0].k, **means, **errors, within=within, realizations=len(found))


@style.journal_style()
def draw_unbiased(found: UnbiasedSpectrum) -> Figure:
    """Draw P^S, P^R and W^-1 P^R with 95 % bars, and beside them the window functions, each over its sum.

    Open symbols are the absolute values of negative power.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 3.0)
    left, right = figure.subplots(1, 2, width_ratios=(1.2, 1.0))
    shift = 0.1 * np.diff(found.bin_edges)
    left.step(found.bin_edges, np.append(found.signal, found.signal[-1]), where="post", color=style.BAND, linewidth=3)
    for place, (name, power, error) in enumerate(
        (("measured", found.measured, found.measured_error), ("unbiased", found.power, found.error))
    ):
        label, marker, colour = ROUTES[name]
        bars = {"fmt": marker, "color": colour, "elinewidth": 0.7, "label": f"$P^R$, {label}"}
        k = found.k + (2 * place - 1) * shift
        left.errorbar(k, np.abs(power), yerr=SIGMAS_95 * error, **bars)
        left.plot(k[power < 0], -power[power < 0], marker, color=colour, markerfacecolor="white")
    left.plot([], [], color=style.BAND, linewidth=3, label="$P^S$")
    left.set(
        xlabel=style.WAVENUMBER,
        ylabel=rf"$P$ ({style.POWER_UNIT}), 95 % bars",
        yscale="log",
        xlim=(0, found.bin_edges[-1]),
    )
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper left", ncols=3)
    known = np.isfinite(found.power)
    for window, total in zip(found.window[known], found.flat_transfer[known], strict=True):
        right.plot(found.k, window / total, linewidth=0.8)
    right.set(xlabel=style.WAVENUMBER, ylabel="window function", xlim=(0, found.bin_edges[-1]))
    return figure


@style.journal_style()
def draw_recovered(groups: Mapping[str, Mapping[str, Recovered]]) -> Figure:
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


def _draw_routes(axes: Axes, found: Recovered) -> None:
    axes.axhline(1, color=style.GREY, linewidth=0.7, zorder=0)
    width = np.diff(found.k).min() if found.k.size > 1 else 0.0
    for place, (name, (label, marker, colour)) in enumerate(ROUTES.items()):
        error = SIGMAS_95 * getattr(found, f"{name}_error")
        k = found.k + 0.15 * (place - 1) * width
        axes.errorbar(
            k, getattr(found, name), yerr=error, fmt=marker, color=colour, elinewidth=0.7, label=f"$P^R$, {label}"
        )


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
    caption = (
        "Power spectrum of the residual outside the wedge as measured, and deconvolved with the window functions of "
        "the calibration, beside the EoR, with 95 % bars; open symbols: negative."
    )
    variants = SIGNAL_LOSS_VARIANTS
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
        return None if lacking is None else f"needs {lacking}"

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the spectrum of a run or a case."""
        return {"": unbiased(graph)}

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
