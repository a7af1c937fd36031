"""The realizations of an experiment: spectra in bins of k of each, pooled by region, and criteria on what they say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.resources import Cost
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS, Variant
from calstudy.experiment.realizations import expand_realizations, members
from calstudy.power.corrected import Corrected, correct_realizations
from calstudy.power.realizations import (
    Design,
    PooledRegion,
    Sample,
    coverage,
    inside_bars,
    mean_over_bins,
    pool_region,
)
from calstudy.power.tables import load_spectrum, save_spectrum
from calstudy.products import corruption, signal_loss, spectra
from calstudy.products.corruption import LEVELS
from calstudy.products.files import read_json, spectrum_file, write_json
from calstudy.products.graph import Graph, memoize, required
from calstudy.run.task import Input, Task, called
from calstudy.verdicts.criterion import Criterion, Finding, Verdict, Within

if TYPE_CHECKING:
    from calstudy.power.settings import PowerSettings
    from calstudy.sky.settings import Eor

NOISE = "noise"
INPUT = "input.json"
REGIONS = ("outside-wedge", "inside-wedge", "all-modes")
"""Parts of Fourier space in which spectra are averaged; the transfer function is known in those of `signal_loss`."""
JUDGED_REGION, JUDGED_K = "outside-wedge", 0.2
WHERE = f"outside the wedge, k >= {JUDGED_K:g} h/Mpc"
CRITERIA = {
    "bars-cover-eor": Criterion(
        "bars-cover-eor",
        "Error bars as quoted",
        "the 95 % bars of P^R cover P^S in 95 % of bins",
        f"part of bins with |P^R - P^S| within 1.96 sigma of noise; {WHERE}",
        Within(0.93, 0.97),
        "95 ± 2 %, as of a 95 % bar",
    ),
    "bars-cover-input": Criterion(
        "bars-cover-input",
        "Error bars as quoted",
        "the 95 % bars of P^R cover the input power in 95 % of bins",
        f"part of bins with |P^R - input| within 1.96 (sigma_N + sigma_S); {WHERE}",
        Within(0.93, 0.97),
        "95 ± 2 %, as of a 95 % bar",
    ),
    "corrected-mean": Criterion(
        "corrected-mean",
        "P^R corrected by T of other realizations",
        "P^R / T is the input on average",
        f"mean of P^R / T over the input; {WHERE}",
        Within(0.99, 1.01),
        "to 1 %",
    ),
    "corrected-mean-known-scale": Criterion(
        "corrected-mean-known-scale",
        "P^R corrected by T of other realizations",
        "P^R / T is the input on average where the flux scale is known",
        f"mean of P^R s^2 / (T s^2) over the input, s of the same realization; {WHERE}",
        Within(0.99, 1.01),
        "to 1 %",
    ),
    "corrected-covers-eor": Criterion(
        "corrected-covers-eor",
        "P^R corrected by T of other realizations",
        "the 95 % intervals of P^R / T cover P^S in 95 % of bins",
        f"part of bins with |P^R / T - P^S| within 1.96 sigma; {WHERE}",
        Within(0.92, 0.98),
        "95 ± 3 %, as of a 95 % interval",
    ),
    "corrected-covers-input": Criterion(
        "corrected-covers-input",
        "P^R corrected by T of other realizations",
        "the 95 % intervals of P^R / T cover the input power in 95 % of bins",
        f"part of bins with |P^R / T - input| within 1.96 sigma, sample variance included; {WHERE}",
        Within(0.92, 0.98),
        "95 ± 3 %, as of a 95 % interval",
    ),
}
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
    """Return the graphs of all realizations of an experiment; the first is the experiment's own.

    Visibilities of the others are removed from the store after their reduction.
    """
    found = expand_realizations(graph.experiment)
    return [Graph(item.experiment, keep_visibilities=place == 0) for place, item in enumerate(found)]


def inputs(graph: Graph) -> dict[str, Task]:
    """Return the tasks of all inputs of pooling: ``spectra:n`` and ``transfer:n`` of realization n, counted from 0."""
    found = {}
    for number, item in enumerate(realization_graphs(graph)):
        found[f"spectra:{number}"] = _reduced(item)
        found[f"transfer:{number}"] = required(signal_loss.transfer(item))
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
        residual=residual,
        residual_without_eor=without,
        eor=eor,
        levels=corruption.levels(graph),
        noise=spectra.variant_power(graph, NOISE, Variant(components=("noise",))) if noisy else None,
    )


class Reduced(Task, stage="realization", version=1, cost=Cost(10, disk=1e6)):
    """P^R with and without the EoR and P^S in all regions, with errors as in `calstudy.products.spectra`."""

    power: PowerSettings
    eor_settings: Eor = called("eor")
    residual: Input
    residual_without_eor: Input
    eor: Input
    levels: Input
    noise: Input = None

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the spectra, and the input power at the same k."""
        from calstudy.power.binned import make_bin_edges, spherical_average
        from calstudy.power.cosmology import input_power
        from calstudy.power.errors import noise_level, with_errors

        power = self.power
        delays = {name: spectra.read_delay_spectra(getattr(self, name)) for name in SIGNAL_LOSS_VARIANTS}
        sigma_noise = 0.0 if self.noise is None else noise_level(spectra.read_delay_spectra(self.noise))
        residual, without, eor = SIGNAL_LOSS_VARIANTS
        for region in REGIONS:
            means = {
                name: spherical_average(found, power, region == "outside-wedge", region == "inside-wedge")
                for name, found in delays.items()
            }
            errors: dict[str, dict[str, Any]] = {
                residual: {"noise": sigma_noise, "signal": means[eor]},
                without: {"noise": sigma_noise},
                eor: {"signal": means[eor]},
            }
            for name, mean in means.items():
                save_spectrum(output / spectrum_file(name, region), with_errors(mean, **errors[name]))
        edges = make_bin_edges(power.bins)
        put_in = input_power(self.eor_settings, (edges[1:] + edges[:-1]) / 2, power.cosmology)
        factor = read_json(self.levels / LEVELS)["eor_factor"]
        write_json(output / INPUT, {"power_mk2_h3_mpc3": (factor**2 * put_in).tolist()})
        return {}


def read_samples(folders: Mapping[str, Path], count: int, region: str) -> Sequence[Sample]:
    """Read the samples of the first `count` realizations in one of `REGIONS` from the products of `inputs`."""
    from calstudy.power.spectra import SphericalSpectrum
    from calstudy.power.transfer import TransferFunction

    samples = []
    for number in range(count):
        folder = folders[f"spectra:{number}"]
        residual, without, eor = (
            load_spectrum(folder / spectrum_file(name, region), SphericalSpectrum) for name in SIGNAL_LOSS_VARIANTS
        )
        loss = None
        if region in signal_loss.REGIONS:
            file = folders[f"transfer:{number}"] / spectrum_file(signal_loss.TRANSFER, region)
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
        place = self.pooled.design.block_of(DRAWN_FOR[kind.removeprefix("corrected_")])
        if place is None or kind not in self.covered:
            return None
        return coverage(self.covered[kind][list(self.pooled.design.blocks[place][1])][:, bins], independent=True)

    def corrected_over(self, power: np.ndarray, bins: np.ndarray, known_scale: bool = False) -> Finding | None:
        """Return the mean of P^R / T over another power, (K, Nk), in some bins; None where T is not known.

        With `known_scale`, it is the mean for P^R s^2 / (T s^2).
        """
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
