"""The realizations of an experiment: the spectra of each, pooled by region, with tables and criteria on them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.resources import Cost
from calstudy.base.table import Table, number
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS, Variant
from calstudy.experiment.realizations import described, expand_realizations, members
from calstudy.power.binned import make_bin_edges, noise_level, spherical_average, with_errors
from calstudy.power.cosmology import input_power
from calstudy.power.realizations import (
    QUANTITIES,
    TRANSFER_QUANTITIES,
    Corrected,
    Design,
    PooledRegion,
    Sample,
    correct_realizations,
    coverage,
    error_ratio,
    inside_bars,
    mean_over_bins,
    pool_region,
)
from calstudy.power.spectra import SphericalSpectrum
from calstudy.power.tables import load_spectrum, save_spectrum
from calstudy.power.transfer import TransferFunction
from calstudy.products import corruption, signal_loss, spectra
from calstudy.products.corruption import LEVELS
from calstudy.products.files import REALIZATIONS, TRANSFER, read_json, spectrum_file, write_json
from calstudy.products.graph import Graph, memoize, required
from calstudy.run.task import Input, Inputs, Task, called
from calstudy.verdicts.criterion import Criterion, Finding, Verdict, Within
from calstudy.verdicts.tables import from_json, tally, to_json, to_markdown, verdict_table

if TYPE_CHECKING:
    from calstudy.power.settings import PowerSettings
    from calstudy.sky.settings import Eor


NOISE = "noise"
INPUT = "input.json"
REGIONS = ("outside-wedge", "inside-wedge", "all-modes")
"""Parts of Fourier space in which spectra are averaged; the transfer function is known in those of `signal_loss`."""
JUDGED_REGION, JUDGED_K = "outside-wedge", 0.2
WHERE = f"outside the wedge, k >= {JUDGED_K:g} h/Mpc"
_CRITERIA = (
    Criterion(
        "bars-cover-eor",
        "Error bars as quoted",
        "the 95 % bars of P^R cover P^S in 95 % of bins",
        f"part of bins with |P^R - P^S| within 1.96 sigma of noise; {WHERE}",
        Within(0.93, 0.97),
        "95 ± 2 %, as of a 95 % bar",
    ),
    Criterion(
        "bars-cover-input",
        "Error bars as quoted",
        "the 95 % bars of P^R cover the input power in 95 % of bins",
        f"part of bins with |P^R - input| within 1.96 (sigma_N + sigma_S); {WHERE}",
        Within(0.93, 0.97),
        "95 ± 2 %, as of a 95 % bar",
    ),
    Criterion(
        "corrected-mean",
        "P^R corrected by T of other realizations",
        "P^R / T is the input on average",
        f"mean of P^R / T over the input; {WHERE}",
        Within(0.99, 1.01),
        "to 1 %",
    ),
    Criterion(
        "corrected-mean-known-scale",
        "P^R corrected by T of other realizations",
        "P^R / T is the input on average where the flux scale is known",
        f"mean of P^R s^2 / (T s^2) over the input, s of the same realization; {WHERE}",
        Within(0.99, 1.01),
        "to 1 %",
    ),
    Criterion(
        "corrected-covers-eor",
        "P^R corrected by T of other realizations",
        "the 95 % intervals of P^R / T cover P^S in 95 % of bins",
        f"part of bins with |P^R / T - P^S| within 1.96 sigma; {WHERE}",
        Within(0.92, 0.98),
        "95 ± 3 %, as of a 95 % interval",
    ),
    Criterion(
        "corrected-covers-input",
        "P^R corrected by T of other realizations",
        "the 95 % intervals of P^R / T cover the input power in 95 % of bins",
        f"part of bins with |P^R / T - input| within 1.96 sigma, sample variance included; {WHERE}",
        Within(0.92, 0.98),
        "95 ± 3 %, as of a 95 % interval",
    ),
)
CRITERIA = {criterion.name: criterion for criterion in _CRITERIA}
COVERED = {
    "bars-cover-eor": "eor",
    "bars-cover-input": "input",
    "corrected-covers-eor": "corrected_eor",
    "corrected-covers-input": "corrected_input",
}
"""Keys of `RegionResults.covered` for the criteria on coverage."""
DRAWN_FOR = {"eor": "noise", "input": "eor"}
"""Draw that a block needs so that its bars are independent trials of covering P^S (`eor`) or the input."""


@memoize
def realization_graphs(graph: Graph) -> list[Graph]:
    """Return the graphs of all realizations; the first is the experiment's own, and keeps its visibilities."""
    found = expand_realizations(graph.experiment)
    return [Graph(item.experiment, keep_visibilities=place == 0) for place, item in enumerate(found)]


def inputs(graph: Graph) -> dict[str, Task]:
    """Return the tasks of all inputs of pooling: ``spectra:n`` and ``transfer:n`` of realization n, counted from 0."""
    found = {}
    for place, item in enumerate(realization_graphs(graph)):
        found[f"spectra:{place}"] = _reduced(item)
        found[f"transfer:{place}"] = required(signal_loss.transfer(item))
    return found


def settings(graph: Graph) -> dict[str, Any]:
    """Return the settings of pooling: the draws of each realization, and the blocks."""
    blocks = [
        {"draw": list(block.draw), "members": places}
        for block, places in zip(graph.experiment.realizations, members(graph.experiment), strict=True)
    ]
    return {"draws": [dict(item.draws) for item in expand_realizations(graph.experiment)], "blocks": blocks}


@memoize
def _reduced(graph: Graph) -> Task:
    experiment = graph.experiment
    residual, without, eor = (spectra.power(graph, name) for name in SIGNAL_LOSS_VARIANTS)
    noisy = "noise" in experiment.variants[SIGNAL_LOSS_VARIANTS[0]].components
    return Reduced(
        "spectra of a realization",
        power=experiment.power,
        eor_settings=experiment.sky.eor,
        band=experiment.instrument.channels.band if experiment.sky.eor.spectrum == "box" else None,
        residual=residual,
        residual_without_eor=without,
        eor=eor,
        levels=corruption.levels(graph),
        noise=spectra.variant_power(graph, NOISE, Variant(components=("noise",))) if noisy else None,
    )


class Reduced(Task, stage="realization", version=2, cost=Cost(10, disk=1e6)):
    """P^R with and without the EoR and P^S in all regions, with errors as in `calstudy.products.spectra`."""

    power: PowerSettings
    eor_settings: Eor = called("eor")
    band: tuple[float, float] | None = None
    residual: Input
    residual_without_eor: Input
    eor: Input
    levels: Input
    noise: Input = None

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the spectra, and the input power at the same k."""
        power = self.power
        delays = {name: spectra.read_delay_spectra(getattr(self, name)) for name in SIGNAL_LOSS_VARIANTS}
        residual, without, eor = SIGNAL_LOSS_VARIANTS
        noise = {}
        if self.noise is not None:
            level = noise_level(spectra.read_delay_spectra(self.noise))
            noise = {
                name: level * spectra.excess_noise(getattr(self, name), self.noise) for name in (residual, without)
            }
        for region in REGIONS:
            means = {
                name: spherical_average(found, power, region == "outside-wedge", region == "inside-wedge")
                for name, found in delays.items()
            }
            for name, mean in means.items():
                found = with_errors(mean, noise.get(name, 0.0), None if name == without else means[eor])
                save_spectrum(output / spectrum_file(name, region), found)
        edges = make_bin_edges(power.bins)
        put_in = input_power(self.eor_settings, (edges[1:] + edges[:-1]) / 2, power.cosmology, self.band)
        factor = read_json(self.levels / LEVELS)["eor_factor"]
        write_json(output / INPUT, {"power_mk2_h3_mpc3": (factor**2 * put_in).tolist()})
        return {}

    def _cost(self) -> Cost:
        if self.band is None or self.eor_settings.path is None:
            return self.typical
        from calstudy.sky.boxes import MEMORY_PER_CELL, read_box

        cells = read_box(self.eor_settings.path).n_cells(self.band)
        return replace(self.typical, memory=self.typical.memory + MEMORY_PER_CELL * cells)


def read_samples(folders: Mapping[str, Path], count: int, region: str) -> Sequence[Sample]:
    """Read the samples of the first `count` realizations in one of `REGIONS` from the products of `inputs`."""
    samples = []
    for place in range(count):
        folder = folders[f"spectra:{place}"]
        residual, without, eor = (
            load_spectrum(folder / spectrum_file(name, region), SphericalSpectrum) for name in SIGNAL_LOSS_VARIANTS
        )
        loss = None
        if region in signal_loss.REGIONS:
            file = folders[f"transfer:{place}"] / spectrum_file(TRANSFER, region)
            loss = load_spectrum(file, TransferFunction)
        put_in = np.array(read_json(folder / INPUT)["power_mk2_h3_mpc3"])
        samples.append(Sample(residual, without, eor, put_in, loss))
    return samples


@dataclass(frozen=True)
class RegionResults:
    """All results of one region.

    Powers of the input (`put_in`) and P^S (`eor`) are (K, Nk) for K realizations. `covered` is 1 or 0 where bars cover
    or not, and NaN where this is not known, (K, Nk), with the keys ``eor`` and ``input`` for P^R, ``corrected_eor`` and
    ``corrected_input`` for P^R / T. `corrected` is P^R / T, or None where T is not known.
    """

    pooled: PooledRegion
    put_in: np.ndarray
    covered: Mapping[str, np.ndarray]
    corrected: Corrected | None
    eor: np.ndarray

    def coverage(self, kind: str, bins: np.ndarray) -> Finding | None:
        """Return the coverage in some bins over the block with independent trials; None without such a block."""
        trials = self.trials(kind)
        return None if trials is None else coverage(trials[:, bins])

    def trials(self, kind: str) -> np.ndarray | None:
        """Return which realizations of the block with independent trials cover, (K, Nk); None without such a block."""
        place = self.pooled.design.block_of(DRAWN_FOR[kind.removeprefix("corrected_")])
        if place is None or kind not in self.covered:
            return None
        return self.covered[kind][list(self.pooled.design.blocks[place][1])]

    def corrected_over(self, power: np.ndarray, bins: np.ndarray, known_scale: bool = False) -> Finding | None:
        """Return the mean of P^R / T, or P^R s^2 / (T s^2), over a power, (K, Nk), in some bins; None without T."""
        if self.corrected is None:
            return None
        corrected = self.corrected.power_known_scale if known_scale else self.corrected.power
        return mean_over_bins((corrected / power)[:, bins], self.pooled.design)


def read_results(settings: Mapping[str, Any], folders: Mapping[str, Path]) -> dict[str, RegionResults]:
    """Read and pool all realizations, by region; settings and folders as `settings` and `inputs`."""
    design = Design(settings["draws"], [(block["draw"], block["members"]) for block in settings["blocks"]])
    return {region: results_of(read_samples(folders, len(settings["draws"]), region), design) for region in REGIONS}


def results_of(samples: Sequence[Sample], design: Design) -> RegionResults:
    """Pool the samples of all realizations in one region, and correct P^R where T is known."""
    residual, eor = (np.stack([getattr(sample, name).power.real for sample in samples]) for name in ("residual", "eor"))
    put_in = np.stack([sample.put_in for sample in samples])
    covered = {
        "eor": inside_bars(residual - eor, np.stack([sample.residual.difference_error for sample in samples])),
        "input": inside_bars(residual - put_in, np.stack([sample.residual.error for sample in samples])),
    }
    corrected = None
    if samples[0].transfer is not None:
        corrected = correct_realizations(samples, design)
        covered["corrected_eor"] = inside_bars(corrected.power - eor, corrected.error)
        covered["corrected_input"] = inside_bars(corrected.power - put_in, corrected.error_with_sample)
    return RegionResults(pool_region(samples, design), put_in, covered, corrected, eor)


def judge(results: RegionResults) -> list[Verdict]:
    """Compare the results outside the wedge with the criteria."""
    bins = results.pooled.k >= JUDGED_K
    verdicts = []
    for name, criterion in CRITERIA.items():
        if name in COVERED:
            found = results.coverage(COVERED[name], bins)
            reason = f"no block of the realizations draws the {DRAWN_FOR[COVERED[name].removeprefix('corrected_')]}"
        else:
            found = results.corrected_over(results.put_in, bins, known_scale=name == "corrected-mean-known-scale")
            reason = "there is no bin in which P^R / T is known in all realizations"
        if found is None or not np.isfinite(found.value):
            verdicts.append(criterion.unevaluated(reason))
        else:
            verdicts.append(criterion.judge(found))
    return verdicts


CSV, MARKDOWN = "realizations.csv", "realizations.md"
PULLS = ("pull_eor", "pull_input", "pull_without_eor")
BANDS = ((0.1, 0.2), (0.2, 0.3), (0.3, 0.5), (0.5, 1.0), (JUDGED_K, np.inf))
"""Bands of k, h/Mpc, of the summary; the last is that of the verdicts."""


@memoize
def pooled(graph: Graph) -> Task:
    """Return the task that pools all realizations of an experiment into tables and verdicts."""
    return Pooled("realizations", title=graph.experiment.name, **settings(graph), realizations=inputs(graph))


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
            if (corrected := results.corrected) is not None:
                powers = {"P^R / T": corrected.power, "sigma from P^S": corrected.error}
                powers["sigma from input"] = corrected.error_with_sample
                for name, values in powers.items():
                    row[f"{name} [mK2 h-3 Mpc3]"] = _mean_of_known(values[places, column])
                row["why not corrected"] = str(corrected.reasons[column])
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


def _mean(found: PooledRegion, name: str, bins: np.ndarray) -> str:
    return _cell(mean_over_bins(found.values[name][:, bins], found.design))


def _percent(found: Finding | None) -> str:
    if found is None or not np.isfinite(found.value):
        return "-"
    return f"{100 * found.value:.1f} ± {100 * found.uncertainty:.1f} %"


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _loss_table(results: RegionResults, blocks: Sequence[Mapping[str, Any]]) -> Table:
    """Return T, its scatter for each block of draws, and the ratio of that scatter to the quoted error."""
    found, rows = results.pooled, []
    for name, bins in _bands(found):
        scatters = {
            f"scatter of T, {described(block['draw'])} drawn": f"{_rms(pooled.scatter[bins]):.4f}"
            for block, pooled in zip(blocks, found.blocks["transfer"], strict=True)
        }
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
            {
                "k [h/Mpc]": name,
                **{quantity.symbol: _mean(found, key, bins) for key, quantity in TRANSFER_QUANTITIES.items()},
                **scatters,
                "quoted error of T": f"{_rms(total.quoted[bins]):.4f}",
                "scatter over quoted": _cell(Finding(ratio, error)),
            }
        )
    return Table.of_records(rows, "k [h/Mpc]")


def _power_table(results: RegionResults) -> Table:
    """Return P^R and P^R0 over P^S, the pulls, and the coverage of the bars of P^R."""
    found, rows = results.pooled, []
    for name, bins in _bands(found):
        row = {"k [h/Mpc]": name}
        for key, quantity in QUANTITIES.items():
            scatter = f"; {_rms(found.total[key].scatter[bins]):.2f}" if key in PULLS else ""
            row[quantity.symbol + (": mean; scatter" if scatter else "")] = _mean(found, key, bins) + scatter
        row["bars that cover P^S"] = _percent(results.coverage("eor", bins))
        row["the input"] = _percent(results.coverage("input", bins))
        rows.append(row)
    return Table.of_records(rows, "k [h/Mpc]")


def _corrected_table(results: RegionResults) -> Table:
    rows = []
    for name, bins in _bands(results.pooled):
        known = np.isfinite(results.corrected.power).all(axis=0)[bins] if results.corrected else np.zeros(0, bool)
        rows.append(
            {
                "k [h/Mpc]": name,
                "P^R / T over input": _cell(results.corrected_over(results.put_in, bins)),
                "over P^S": _cell(results.corrected_over(results.eor, bins)),
                "intervals that cover P^S": _percent(results.coverage("corrected_eor", bins)),
                "the input": _percent(results.coverage("corrected_input", bins)),
                "bins corrected": f"{known.sum()} of {known.size}",
            }
        )
    return Table.of_records(rows, "k [h/Mpc]")


def _of_other_realizations(corrected: Corrected) -> str:
    """Describe in one sentence the realizations that T is taken from."""
    shared = corrected.shared
    same = "; the others by T of realizations some of which share a part, the EoR where gains and noise are drawn"
    return (
        f"P^R / T, T of other realizations: {np.sum(shared == 0)} of {shared.size} realizations are corrected by T of "
        f"other EoR, gains and noise{same if (shared > 0).any() else ''}. There is no result where T or C is not above "
        "five times its error, or C is not above half of T; realizations.csv says why."
    )
