"""The pooled realizations of an experiment: tables and verdicts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calstudy.base.resources import Cost
from calstudy.base.table import Table, number
from calstudy.experiment.realizations import described
from calstudy.power.corrected import Corrected
from calstudy.power.realizations import QUANTITIES, TRANSFER_QUANTITIES, PooledRegion, error_ratio, mean_over_bins
from calstudy.products import realizations
from calstudy.products.files import REALIZATIONS
from calstudy.products.graph import Graph, memoize
from calstudy.products.realizations import JUDGED_K, JUDGED_REGION, RegionResults, judge, read_results
from calstudy.run.task import Inputs, Task
from calstudy.verdicts.criterion import Finding, Verdict
from calstudy.verdicts.tables import from_json, tally, to_json, to_markdown, verdict_table

CSV, MARKDOWN = "realizations.csv", "realizations.md"
PULLS = ("pull_eor", "pull_input", "pull_without_eor")
BANDS = ((0.1, 0.2), (0.2, 0.3), (0.3, 0.5), (0.5, 1.0), (JUDGED_K, np.inf))
"""Bands of k, h/Mpc, of the summary; the last is that of the verdicts."""


@memoize
def pooled(graph: Graph) -> Task:
    """Return the task that pools all realizations of an experiment into tables and verdicts."""
    settings = realizations.settings(graph)
    return Pooled("realizations", title=graph.experiment.name, **settings, realizations=realizations.inputs(graph))


class Pooled(Task, stage="pooled-realizations", version=4, cost=Cost(5, disk=1e6)):
    """All realizations of an experiment."""

    title: str
    draws: Sequence[Mapping[str, Any]]
    blocks: Sequence[Mapping[str, Any]]
    realizations: Inputs

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write realizations.csv, realizations.md, and the verdicts in realizations.json."""
        results = read_results(self.settings, self.realizations)
        verdicts = judge(results[JUDGED_REGION])
        rows = [row for region, found in results.items() for row in _csv_rows(region, found, self.blocks)]
        Table.of_records(rows).write_csv(output / CSV)
        (output / MARKDOWN).write_text(_markdown(results, verdicts, self.title, self.blocks), encoding="utf-8")
        (output / REALIZATIONS).write_text(to_json(verdicts) + "\n", encoding="utf-8")
        return {"verdicts": tally(verdicts), "failed": [item.name for item in verdicts if item.verdict == "FAIL"]}

    def shown(self, folder: Path) -> Sequence[Table]:
        """Return the verdicts."""
        verdicts = from_json((folder / REALIZATIONS).read_text(encoding="utf-8"))
        return [verdict_table(verdicts, "Realizations", "All numbers are in realizations.md and realizations.csv.")]


def _csv_rows(
    region: str, results: RegionResults, blocks: Sequence[Mapping[str, Any]]
) -> Iterator[dict[str, str | float]]:
    """Yield a row for each bin and block, and for all blocks together if there are several."""
    found = results.pooled
    everyone = list(range(len(found.design.draws)))
    parts = [(described(block["draw"]), block["members"], place) for place, block in enumerate(blocks)]
    for draw, places, place in [*parts, *([("all blocks", everyone, -1)] if len(blocks) > 1 else [])]:
        for column, k in enumerate(found.k):
            row: dict[str, str | float] = {
                "region": region,
                "drawn": draw,
                "realizations": len(places),
                "k [h/Mpc]": float(k),
                "k from [h/Mpc]": float(found.bin_edges[column]),
                "k to [h/Mpc]": float(found.bin_edges[column + 1]),
                "input [mK2 h-3 Mpc3]": float(results.put_in[places, column].mean()),
            }
            for name in found.values:
                pooled_quantity = found.total[name] if place < 0 else found.blocks[name][place]
                for kind in ("mean", "scatter", "error", "quoted"):
                    row[f"{name} {kind}"] = float(getattr(pooled_quantity, kind)[column])
            for kind, inside in results.covered.items():
                row[f"covered: {kind.replace('_', ' ')}"] = _mean_of_known(inside[places, column])
            if results.corrected is not None:
                row["P^R / T [mK2 h-3 Mpc3]"] = _mean_of_known(results.corrected.power[places, column])
                row["sigma from P^S [mK2 h-3 Mpc3]"] = _mean_of_known(results.corrected.error[places, column])
                row["sigma from input [mK2 h-3 Mpc3]"] = _mean_of_known(
                    results.corrected.error_with_sample[places, column]
                )
                row["why not corrected"] = str(results.corrected.reasons[column])
            yield row


def _mean_of_known(values: np.ndarray) -> float:
    known = np.isfinite(values)
    return float(values[known].mean()) if known.any() else float("nan")


def _markdown(
    results: Mapping[str, RegionResults], verdicts: Sequence[Verdict], title: str, blocks: Sequence[Mapping[str, Any]]
) -> str:
    drawn = "; ".join(f"{len(block['members'])} realizations of {described(block['draw'])}" for block in blocks)
    summary = (
        f"{drawn}. The first realization, the experiment itself, is in every block. {tally(verdicts)}.\n\n"
        "Numbers with ± have their standard error over all that was drawn. Scatter is the standard deviation of one "
        "bin of one realization, by all that was drawn; what depends on the draws of several blocks counts once. "
        "Coverage is that of the block that draws the noise (for P^S) or the EoR (for the input). P^R0 is P^R of data "
        "without the EoR."
    )
    text = [to_markdown(verdicts, f"Realizations: {title}", ("criterion", "wanted"), summary)]
    for region, found in results.items():
        text += [f"## {region.replace('-', ' ').capitalize()}", ""]
        if found.corrected is not None:
            text += [_loss_table(found, blocks).markdown()]
        text += [_power_table(found).markdown()]
        if found.corrected is not None:
            text += [_of_other_realizations(found.corrected), "", _corrected_table(found).markdown()]
    return "\n".join(text).rstrip() + "\n"


def _bands(found: PooledRegion) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and bins, (Nk,) bool, of each band of k that has modes."""
    known = np.isfinite(found.values["ratio"]).all(axis=0)
    for low, high in BANDS:
        bins = known & (found.k >= low) & (found.k < high)
        if bins.any():
            yield (f"{low:g} to {high:g}" if np.isfinite(high) else f">= {low:g}"), bins


def _cell(found: Finding | None) -> str:
    return "-" if found is None or not np.isfinite(found.value) else number(found.value, found.uncertainty)


def _percent(found: Finding | None) -> str:
    if found is None or not np.isfinite(found.value):
        return "-"
    return f"{100 * found.value:.1f} ± {100 * found.uncertainty:.1f} %"


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _loss_table(results: RegionResults, blocks: Sequence[Mapping[str, Any]]) -> Table:
    """Return T, its scatter for each block of draws, and the ratio of that scatter to the quoted error."""
    found = results.pooled
    names = [described(block["draw"]) for block in blocks]
    rows = []
    for name, bins in _bands(found):
        scatters = [f"{_rms(block.scatter[bins]):.4f}" for block in found.blocks["transfer"]]
        ratios = [
            error_ratio(*(values["transfer"][list(places)][:, bins] for values in (found.values, found.quoted)))
            for _, places in found.design.blocks
        ]
        total = found.total["transfer"]
        squares = np.array([ratio.value**2 for ratio in ratios])
        # Squared scatters of blocks add up, minus what is in several blocks; so do their parts of the ratio's error.
        counted = 1 - total.counted_twice
        ratio = float(np.sqrt(counted * squares.sum()))
        error = counted * float(np.sqrt(sum((item.value * item.uncertainty) ** 2 for item in ratios)) / ratio)
        rows.append(
            (
                name,
                *(_cell(mean_over_bins(found.values[key][:, bins], found.design)) for key in TRANSFER_QUANTITIES),
                *scatters,
                f"{_rms(total.quoted[bins]):.4f}",
                _cell(Finding(ratio, error)),
            )
        )
    symbols = [quantity.symbol for quantity in TRANSFER_QUANTITIES.values()]
    drawn = [f"scatter of T, {name} drawn" for name in names]
    return Table(("k [h/Mpc]", *symbols, *drawn, "quoted error of T", "scatter over quoted"), rows)


def _power_table(results: RegionResults) -> Table:
    """Return P^R and P^R0 over P^S, the pulls, and the coverage of the bars of P^R."""
    found, rows = results.pooled, []
    for name, bins in _bands(found):
        means = {key: mean_over_bins(found.values[key][:, bins], found.design) for key in QUANTITIES}
        scatters = {key: f"{_rms(found.total[key].scatter[bins]):.2f}" for key in PULLS}
        rows.append(
            (
                name,
                *(_cell(means[key]) for key in QUANTITIES if key not in PULLS),
                *(f"{_cell(means[key])}; {scatters[key]}" for key in PULLS),
                _percent(results.coverage("eor", bins)),
                _percent(results.coverage("input", bins)),
            )
        )
    symbols = [quantity.symbol for key, quantity in QUANTITIES.items() if key not in PULLS]
    pulls = [f"{QUANTITIES[key].symbol}: mean; scatter" for key in PULLS]
    return Table(("k [h/Mpc]", *symbols, *pulls, "bars that cover P^S", "the input"), rows)


def _corrected_table(results: RegionResults) -> Table:
    rows = []
    for name, bins in _bands(results.pooled):
        known = np.isfinite(results.corrected.power).all(axis=0)[bins] if results.corrected else np.zeros(0, bool)
        rows.append(
            (
                name,
                _cell(results.corrected_over(results.put_in, bins)),
                _cell(results.corrected_over(results.eor, bins)),
                _percent(results.coverage("corrected_eor", bins)),
                _percent(results.coverage("corrected_input", bins)),
                f"{known.sum()} of {known.size}",
            )
        )
    headings = (
        "k [h/Mpc]",
        "P^R / T over input",
        "over P^S",
        "intervals that cover P^S",
        "the input",
        "bins corrected",
    )
    return Table(headings, rows)


def _of_other_realizations(corrected: Corrected) -> str:
    """Describe in one sentence the realizations that T is taken from."""
    shared = corrected.shared
    same = "; the others by T of realizations some of which share a part, the EoR where gains and noise are drawn"
    return (
        f"P^R / T, T of other realizations: {np.sum(shared == 0)} of {shared.size} realizations are corrected by T of "
        f"other EoR, gains and noise{same if (shared > 0).any() else ''}. There is no result where T or C is not above "
        "five times its error, or C is not above half of T; realizations.csv says why."
    )
