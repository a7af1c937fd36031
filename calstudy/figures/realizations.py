"""Realizations of an experiment: transfer function, pulls and coverage per k, and covariance between bins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calstudy.experiment.model import Experiment
from calstudy.experiment.realizations import described
from calstudy.figures import Drawing, StudyFigure
from calstudy.figures.signal_loss import TRANSFER
from calstudy.plotting import style
from calstudy.products import realizations
from calstudy.products.graph import Graph
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Arrays, Drawn, Fixed, Measured

if TYPE_CHECKING:
    from calstudy.products.realization_results import RegionResults

OUTSIDE, INSIDE = "outside-wedge", "inside-wedge"
CORRELATION_COLOURS = "RdBu_r"
COVERED = 0.95
CORRECTED_PULL = r"mean of $(P^R/T - P^S)/\sigma$"
SERIES = {"eor": ("o", style.BLUE, r"$P^S$"), "input": ("s", style.ORANGE, "input")}


@style.journal_style()
def draw_realizations(results: Mapping[str, RegionResults], title: str = "", stand_ins: Sequence[str] = ()) -> Figure:
    """Draw what realizations have in common: T, pulls, coverage, and the correlation of T between bins.

    Parameters
    ----------
    results
        By region; outside and inside the wedge are shown.
    title
        What was drawn how often.
    stand_ins
        See `calstudy.plotting.style.note_stand_ins`.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 5.2)
    axes = figure.subplots(2, 2)
    _draw_transfer(axes[0, 0], results)
    _draw_correlation(figure, axes[0, 1], results[OUTSIDE])
    _draw_pulls(axes[1, 0], results[OUTSIDE])
    _draw_coverage(axes[1, 1], results[OUTSIDE])
    last = max(float(found.pooled.bin_edges[1:][_known(found)].max(initial=0.1)) for found in results.values())
    for panel in (axes[0, 0], axes[1, 0], axes[1, 1]):
        panel.set_xlim(0, last)
        panel.set_xlabel(style.WAVENUMBER)
    if title:
        figure.suptitle(title, fontsize=8.5)
    style.note_stand_ins(figure, stand_ins)
    return figure


def _known(results: RegionResults) -> np.ndarray:
    return np.isfinite(results.pooled.values["ratio"]).all(axis=0)


def _draw_transfer(axes: Axes, results: Mapping[str, RegionResults]) -> None:
    """Draw mean T with the scatter of one realization as bars, and the quoted error as a band."""
    for region, marker, colour in ((OUTSIDE, "o", style.BLUE), (INSIDE, "s", style.ORANGE)):
        pooled = results[region].pooled
        total = pooled.total["transfer"]
        known = np.isfinite(total.mean) & np.isfinite(total.scatter)
        k, mean, quoted = pooled.k[known], total.mean[known], total.quoted[known]
        axes.errorbar(
            k, mean, total.scatter[known], fmt=marker, color=colour, elinewidth=0.7, label=region.replace("-", " the ")
        )
        axes.fill_between(k, mean - quoted, mean + quoted, color=colour, alpha=0.25, linewidth=0)
    axes.axhline(1, color=style.GREY, linewidth=0.7, zorder=0)
    axes.set_ylabel(TRANSFER)
    axes.legend(loc="lower right", title="bars: scatter; bands: quoted error", title_fontsize=style.SMALL_SIZE)


def _draw_correlation(figure: Figure, axes: Axes, results: RegionResults) -> None:
    """Draw the correlation of T between bins outside the wedge."""
    pooled = results.pooled
    correlation = pooled.total["transfer"].correlation
    edges = pooled.bin_edges
    image = axes.pcolormesh(edges, edges, correlation, cmap=CORRELATION_COLOURS, vmin=-1, vmax=1, rasterized=True)
    axes.set_facecolor("0.9")
    known = np.flatnonzero(_known(results))
    if known.size:
        limits = edges[known[0]], edges[known[-1] + 1]
        axes.set(xlim=limits, ylim=limits)
    freedom = sum(len(places) - 1 for _, places in pooled.design.blocks)
    axes.set(aspect="equal", xlabel=style.WAVENUMBER, ylabel=style.WAVENUMBER)
    axes.set_title(rf"correlation of $T$; by chance $\pm{freedom**-0.5:.2f}$")
    figure.colorbar(image, ax=axes, shrink=0.9)


def _draw_pulls(axes: Axes, results: RegionResults) -> None:
    """Draw the mean and the scatter of the pulls of P^R, and the mean of those of P^R / T."""
    pooled = results.pooled
    for shift, (kind, (marker, colour, label)) in zip((-0.15, 0.15), SERIES.items(), strict=True):
        total = pooled.total[f"pull_{kind}"]
        k = pooled.k + shift * np.diff(pooled.bin_edges)
        axes.errorbar(
            k, total.mean, total.scatter, fmt=marker, color=colour, elinewidth=0.7,
            label=rf"$(P^R - $ {label}$)/\sigma$",
        )  # fmt: skip
    if results.corrected is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            pulls = (results.corrected.power - results.eor) / results.corrected.error
        axes.plot(pooled.k, pulls.mean(axis=0), "x", color=style.GREEN, label=r"$(P^R/T - P^S)/\sigma$, mean", zorder=3)
    axes.axhspan(-1, 1, color=style.BAND, alpha=0.5, linewidth=0, zorder=0)
    axes.set_ylabel("pull, outside the wedge")
    _legend_above(axes, 3)


def _draw_coverage(axes: Axes, results: RegionResults) -> None:
    """Draw the part of the realizations whose 95 % bars cover, per bin; filled: of P^R / T."""
    pooled = results.pooled
    for shift, (kind, (marker, colour, label)) in zip((-0.15, 0.15), SERIES.items(), strict=True):
        k = pooled.k + shift * np.diff(pooled.bin_edges)
        for prefix, filled, name in (("", "none", "P^R"), ("corrected_", colour, "P^R/T")):
            inside = results.covered.get(prefix + kind, np.full((1, pooled.k.size), np.nan))
            known = np.isfinite(inside).all(axis=0)
            axes.plot(
                k[known], inside[:, known].mean(axis=0), marker, color=colour, markerfacecolor=filled,
                label=rf"${name}$, {label}",
            )  # fmt: skip
    axes.axhline(COVERED, color=style.GREY, linewidth=0.7, zorder=0)
    axes.set(ylim=(-0.04, 1.04), ylabel="part of 95 % bars that cover")
    _legend_above(axes, 4)


def _legend_above(axes: Axes, columns: int) -> None:
    """Add the legend of a panel that is full of points."""
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=columns, columnspacing=1.0, handletextpad=0.3)


def _quoted(arrays: Arrays, name: str) -> np.ndarray:
    """Return the quoted errors of the values of a quantity."""
    return arrays[name.replace(".values.", ".quoted.")]


class Realizations(StudyFigure):
    """What realizations of an experiment have in common: T, pulls, coverage, and the correlation between bins."""

    caption = (
        "Transfer function over realizations, with the scatter of one realization as bars and the quoted error as "
        "bands; its correlation between bins; pulls, mean and scatter; part of the 95 % bars that cover P^S and the "
        "input. Outside the wedge where nothing else is said."
    )
    needs_signal_loss = True
    tolerances = (
        (r".*\.values\..*", Drawn(_quoted, "its quoted error")),
        (r".*\.(k|bin_edges|input)", Fixed("follows from the settings and the level of the EoR")),
        (".*", Measured("follows from the values of the realizations")),
    )

    def refusal(self, experiment: Experiment) -> str:
        """Refuse: a single experiment has nothing to pool."""
        return "pools the realizations of an experiment, and cannot be drawn of a single one"

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return what is measured on every realization."""
        return realizations.inputs(graph)

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return which realization has which draws."""
        return realizations.settings(graph)

    def draw(self, job: Job) -> Drawing:
        """Pool all realizations, and draw them."""
        from calstudy.products.realization_results import read_results

        results = read_results(job.settings, job.inputs)
        blocks = job.settings["blocks"]
        title = "; ".join(described(block["draw"], len(block["members"])) for block in blocks)
        return Drawing(draw_realizations(results, title, job.settings["notes"]), _arrays(results))


def _arrays(results: Mapping[str, RegionResults]) -> dict[str, Any]:
    """Return all pooled arrays, and the values of every realization, by region."""
    shown: dict[str, Any] = {}
    for region, found in results.items():
        pooled = found.pooled
        shown[region] = {
            "k": pooled.k,
            "bin_edges": pooled.bin_edges,
            "values": dict(pooled.values),
            "quoted": dict(pooled.quoted),
            "blocks": {name: list(blocks) for name, blocks in pooled.blocks.items()},
            "total": dict(pooled.total),
            "covered": dict(found.covered),
            "corrected": found.corrected,
            "eor": found.eor,
            "input": found.put_in,
        }
    return shown
