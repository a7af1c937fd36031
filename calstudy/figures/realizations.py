"""Realizations of an experiment: transfer function, pulls and coverage per k, and covariance between bins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.units import Wavenumber
from calstudy.experiment.realizations import described
from calstudy.figures import TWO_ARRAYS, Drawing, StudyFigure, members_of
from calstudy.figures.signal_loss import TRANSFER
from calstudy.figures.spherical import shifted
from calstudy.plotting import style
from calstudy.power.realizations import Design, Pooled, PooledRegion, mean_over_bins, pool_region, together
from calstudy.power.tables import write_columns
from calstudy.products import realizations
from calstudy.products.graph import Graph
from calstudy.products.realizations import RegionResults, read_results
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Arrays, Drawn, Fixed, Measured

OUTSIDE, INSIDE = "outside-wedge", "inside-wedge"
CORRELATION_COLOURS = "RdBu_r"
LEVEL = 0.95
CORRECTED_PULL = r"$(P^R/T - P^S)/\sigma$, mean"
KINDS = {"eor": ("o", style.BLUE, r"P^S", -0.15), "input": ("s", style.ORANGE, r"\mathrm{input}", 0.15)}
"""Marker, colour and name of the powers with which P^R is compared, and the shift of points in widths of a bin."""
BLOCKS = (style.ORANGE, style.GREEN, style.MAGENTA)


def draw_realizations(
    results: Mapping[str, RegionResults],
    names: Sequence[str],
    max_k: float = 1.0,
) -> style.Figure:
    """Draw statistics of realizations by region, up to `max_k`, h/Mpc; `names` are the parts that each block draws."""
    figure = style.new_figure(style.TWO_COLUMNS, 4.9)
    ((transfer, errors, correlation), (pulls, covered, corrected)) = figure.subplots(2, 3)
    outside = results[OUTSIDE]
    _draw_transfer(transfer, results)
    _draw_errors(errors, outside, names)
    _draw_pulls(pulls, outside)
    _draw_coverage(covered, outside)
    _draw_corrected(corrected, outside)
    limits = (0.0, min(max_k, float(outside.pooled.bin_edges[-1])))
    for panel in (transfer, errors, pulls, covered, corrected):
        panel.set(xlim=limits, xlabel=style.WAVENUMBER)
    _draw_correlation(figure, correlation, outside, limits)
    return figure


def _draw_transfer(axes: style.Axes, results: Mapping[str, RegionResults]) -> None:
    """Draw mean T with the scatter of one realization as bars."""
    for region, marker, colour in ((OUTSIDE, "o", style.BLUE), (INSIDE, "s", style.ORANGE)):
        look = {"fmt": marker, "color": colour, "label": region.replace("-", " the ")}
        _draw_scatter(axes, results[region].pooled, "transfer", 0.0, look)
    axes.axhline(1, color=style.GREY, linewidth=0.7, zorder=0)
    axes.set_ylabel(TRANSFER)
    axes.legend(loc="center right", title="bars: scatter", title_fontsize=style.SMALL_SIZE)


def _draw_scatter(axes: style.Axes, pooled: PooledRegion, name: str, shift: float, look: Mapping[str, Any]) -> None:
    """Draw the mean of a quantity with the scatter of one realization as bars."""
    total = pooled.total[name]
    axes.errorbar(shifted(pooled, shift), total.mean, total.scatter, elinewidth=0.7, **look)


def _draw_errors(axes: style.Axes, results: RegionResults, names: Sequence[str]) -> None:
    """Draw the quoted error of T, and its scatter by the parts that are drawn."""
    pooled = results.pooled
    axes.plot(pooled.k, pooled.total["transfer"].quoted, color=style.BLACK, label="quoted error")
    for name, block, colour in zip(names, pooled.blocks["transfer"], BLOCKS, strict=False):
        axes.plot(pooled.k, block.scatter, ".", color=colour, label=f"scatter: {name}")
    if len(names) > 1:
        axes.plot(pooled.k, pooled.total["transfer"].scatter, "o", color=style.BLUE, label="scatter: all together")
    axes.set(yscale="log", ylabel=r"error of $T$")
    _legend_above(axes, 2)


def _draw_correlation(
    figure: style.Figure, axes: style.Axes, results: RegionResults, limits: tuple[float, float]
) -> None:
    """Draw the correlation of T between bins outside the wedge."""
    pooled = results.pooled
    correlation = pooled.total["transfer"].correlation
    edges = pooled.bin_edges
    image = axes.pcolormesh(edges, edges, correlation, cmap=CORRELATION_COLOURS, vmin=-1, vmax=1, rasterized=True)
    axes.set_facecolor("0.85")
    chance = _freedom(pooled) ** -0.5
    axes.set(aspect="equal", xlim=limits, ylim=limits, xlabel=style.WAVENUMBER, ylabel=style.WAVENUMBER)
    axes.set_title(rf"correlation of $T$ ($\pm{chance:.2f}$ by chance)", fontsize=style.SMALL_SIZE + 0.5)
    figure.colorbar(image, ax=axes, shrink=0.8)


def _freedom(pooled: PooledRegion) -> float:
    """Return the degrees of freedom of the covariance of T, a sum over blocks (Satterthwaite); median over bins."""
    variances = np.array([block.scatter**2 for block in pooled.blocks["transfer"]])
    each = np.array([[len(places) - 1] for _, places in pooled.design.blocks])
    freedom = np.sum(variances, axis=0) ** 2 / np.sum(variances**2 / each, axis=0)
    return float(np.median(freedom[np.isfinite(freedom)]))


def _draw_pulls(axes: style.Axes, results: RegionResults) -> None:
    """Draw the mean and the scatter of the pulls of P^R, and the mean of those of P^R / T."""
    pooled = results.pooled
    for kind, (marker, colour, name, shift) in KINDS.items():
        look = {"fmt": marker, "color": colour, "label": rf"$(P^R - {name})/\sigma$"}
        _draw_scatter(axes, pooled, f"pull_{kind}", shift, look)
    if results.corrected is not None:
        known = np.isfinite(results.corrected.power).all(axis=0)
        deviations = (results.corrected.power - results.eor)[:, known]
        mean = (deviations / results.corrected.error[:, known]).mean(axis=0)
        axes.plot(pooled.k[known], mean, "x", color=style.GREEN, label=CORRECTED_PULL, zorder=3)
    axes.axhspan(-1, 1, color=style.BAND, alpha=0.5, linewidth=0, zorder=0)
    # Linear over the expected range of pulls; where most of the EoR is lost they are far below.
    axes.set_yscale("symlog", linthresh=3)
    bottom = min(-3.0, axes.get_ylim()[0])
    top = max(3.0, axes.get_ylim()[1])
    decades = [sign * 10**power for sign in (-1, 1) for power in range(1, 9) if bottom <= sign * 10**power <= top]
    ticks = [*range(-3, 4), *decades]
    axes.set_yticks(ticks, [f"{tick}".replace("-", "−") for tick in ticks])
    axes.set(ylabel="pull: mean and scatter\n(linear to ±3)", ylim=(bottom, top))
    _legend_above(axes, 1)


def _draw_coverage(axes: style.Axes, results: RegionResults) -> None:
    """Draw the part of independent draws whose 95 % bars cover, per bin; filled: of P^R / T."""
    pooled = results.pooled
    for kind, (marker, colour, name, shift) in KINDS.items():
        k = shifted(pooled, shift)
        for prefix, filled, power in (("", "none", "P^R"), ("corrected_", colour, "P^R/T")):
            inside = results.trials(prefix + kind)
            if inside is None:
                continue
            known = np.isfinite(inside).all(axis=0)
            part, label = inside[:, known].mean(axis=0), rf"${power}$ of ${name}$"
            axes.plot(k[known], part, marker, color=colour, markerfacecolor=filled, label=label)
    axes.axhline(LEVEL, color=style.GREY, linewidth=0.7, zorder=0)
    axes.set(ylim=(-0.04, 1.04), ylabel="part of 95 % bars that cover")
    _legend_above(axes, 2)


def _draw_corrected(axes: style.Axes, results: RegionResults) -> None:
    """Draw P^R and P^R / T over the input: the mean, with 1.96 times its error by all that was drawn."""
    pooled = results.pooled
    powers = {"P^R": (pooled.values["ratio"] * results.eor, style.GREY, "o", -0.15)}
    if results.corrected is not None:
        powers["P^R/T"] = (results.corrected.power, style.BLUE, "s", 0.15)
    for name, (power, colour, marker, shift) in powers.items():
        found = [mean_over_bins(column[:, None], pooled.design) for column in (power / results.put_in).T]
        mean, error = np.transpose([(item.value, item.uncertainty) for item in found])
        k, label = shifted(pooled, shift), f"${name}$ over input"
        style.error_bars(axes, k, mean, error, fmt=marker, color=colour, label=label)
    axes.axhline(1, color=style.BLACK, linewidth=0.7, zorder=0)
    axes.set(ylabel=r"mean over the input, $\pm 1.96\,\sigma$", ylim=(0, max(1.35, axes.get_ylim()[1])))
    _legend_above(axes, 1)


def _legend_above(axes: style.Axes, columns: int) -> None:
    """Add the legend of a panel that is full of points."""
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=columns, columnspacing=0.8, handletextpad=0.2)


def _quoted(arrays: Arrays, name: str) -> np.ndarray:
    return arrays[name.replace(".values.", ".quoted.")]


class _OfRealizations(StudyFigure):
    """A figure of the measurements on every realization of an experiment, or of a member of a collection."""

    max_k: Wavenumber = Field(1.0, gt=0, description="Upper end of the axes of k; the arrays have all bins.")

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the measurements on every realization."""
        return realizations.inputs(graph)

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the draws of each realization."""
        return realizations.settings(graph)


class Realizations(_OfRealizations):
    """Statistics of the realizations of an experiment: T, pulls, coverage, and the correlation between bins."""

    version: ClassVar[int] = 2

    kind: str = "realizations"

    of = ("realizations",)
    caption = (
        "Realizations: transfer function T with the scatter of one realization; its quoted error and its scatter; the "
        "correlation of T between bins; pulls, mean and scatter; part of the 95 % bars that cover; P^R and P^R / T "
        "over the input. Outside the wedge where nothing else is said."
    )
    needs_signal_loss = True
    tolerances = (
        (r".*\.values\..*", Drawn(_quoted, "its quoted error")),
        (r".*\.(k|bin_edges|input)", Fixed("follows from the settings and the level of the EoR")),
        (".*", Measured("follows from the values of the realizations")),
    )

    def draw(self, job: Job) -> Drawing:
        """Pool all realizations, and draw them."""
        results = read_results(job.settings, job.inputs)
        blocks = job.settings["blocks"]
        names = [f"{described(block['draw'])} ({len(block['members'])})" for block in blocks]
        return Drawing(draw_realizations(results, names, self.max_k), _arrays(results))


def _arrays(results: Mapping[str, RegionResults]) -> dict[str, Any]:
    """Return all pooled arrays, and the values of every realization, by region."""
    shown: dict[str, Any] = {}
    for region, found in results.items():
        pooled = {name: value for name, value in vars(found.pooled).items() if name != "design"}
        own = {"covered": found.covered, "corrected": found.corrected, "eor": found.eor, "input": found.put_in}
        shown[region] = pooled | own
    return shown


CSV = "realizations-comparison.csv"


def draw_comparison(arrays: Mapping[str, PooledRegion], difference: Pooled, max_k: float = 1.0) -> style.Figure:
    """Draw T of two arrays, by title, with the scatter of one realization, and their difference with 95 % bars.

    `difference` is T of the first less that of the second. The axis of k ends at `max_k`, h/Mpc.
    """
    figure = style.new_figure(style.ONE_COLUMN, 4.2)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    sides = zip((-0.15, 0.15), style.SERIES[:2], arrays.items(), strict=True)
    for shift, (marker, colour), (title, pooled) in sides:
        _draw_scatter(upper, pooled, "transfer", shift, {"fmt": marker, "color": colour, "label": title})
    upper.axhline(1, color=style.GREY, linewidth=0.7, zorder=0)
    upper.set_ylabel(TRANSFER)
    upper.legend(loc="lower right", title="bars: scatter of one realization", title_fontsize=style.SMALL_SIZE)
    style.error_bars(lower, pooled.k, difference.mean, difference.error, fmt="o", color=style.BLACK)
    lower.axhline(0, color=style.GREY, linewidth=0.7, zorder=0)
    lower.set(xlabel=style.WAVENUMBER, ylabel=r"difference of $T$, $\pm 1.96\,\sigma$")
    lower.set_xlim(0, min(max_k, float(pooled.bin_edges[-1])))
    return figure


class RealizationsComparison(_OfRealizations):
    """T of two arrays over the same draws, and their difference, with realizations-comparison.csv."""

    version: ClassVar[int] = 2

    kind: str = "realizations-comparison"

    of = ("collection",)
    titles = TWO_ARRAYS
    caption = (
        "Transfer function outside the wedge of two arrays, over the same draws of EoR, gains and noise: mean and "
        "scatter of one realization, and the mean difference with bars of 1.96 standard errors of all that was drawn."
    )
    tolerances = ((".*", Measured("follows from the figures of the members")),)

    def draw(self, job: Job) -> Drawing:
        """Write the table, and draw both arrays and their difference."""
        regions, inputs = {}, members_of(job)
        members = job.settings["members"]
        if len({str(settings) for settings in members.values()}) > 1:
            raise InputError(f"{self.label}: the members draw different realizations; give them the same blocks")
        for role, title in self.titles.items():
            settings = members[role]
            design = Design(settings["draws"], [(block["draw"], block["members"]) for block in settings["blocks"]])
            samples = realizations.read_samples(inputs[role], len(design.draws), OUTSIDE)
            regions[title] = pool_region(samples, design)
        first, second = regions.values()
        if not np.array_equal(first.bin_edges, second.bin_edges):
            raise InputError(f"{self.label}: the members have different bins of k, expected the same power.bins")
        differences = _differences(first, second)
        _write(job.output / CSV, regions, differences)
        shown = {role: regions[title].total for role, title in self.titles.items()}
        arrays = {"k": first.k, "bin_edges": first.bin_edges, "difference": differences, **shown}
        return Drawing(draw_comparison(regions, differences["transfer"], self.max_k), arrays)


def _differences(first: PooledRegion, second: PooledRegion) -> dict[str, Pooled]:
    """Return the difference of every quantity, realization by realization, pooled over all blocks."""
    blocks = [places for _, places in first.design.blocks]
    return {
        name: together(values - second.values[name], np.hypot(first.quoted[name], second.quoted[name]), blocks)
        for name, values in first.values.items()
    }


def _write(path: Path, regions: Mapping[str, PooledRegion], differences: Mapping[str, Pooled]) -> None:
    first = next(iter(regions.values()))
    columns = {"k [h/Mpc]": first.k, "k from [h/Mpc]": first.bin_edges[:-1], "k to [h/Mpc]": first.bin_edges[1:]}
    for name, difference in differences.items():
        for title, region in regions.items():
            columns[f"{name}, {title.lower()}"] = region.total[name].mean
        columns |= {f"{name}, difference": difference.mean, f"{name}, error of difference": difference.error}
    write_columns(path, columns)
