"""The realizations of an experiment, each reduced to spectra in bins of k."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calstudy.base.resources import Cost
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS, Variant
from calstudy.experiment.realizations import Realization, expand_realizations, members
from calstudy.products import corruption, signal_loss, spectra
from calstudy.products.corruption import LEVELS
from calstudy.products.files import read_json, spectrum_file, write_json
from calstudy.products.graph import Graph, once, required
from calstudy.run.task import Job, Stage, Task

if TYPE_CHECKING:
    from calstudy.power.realizations import Sample

NOISE = "noise"
INPUT = "input.json"
REGIONS = ("outside-wedge", "inside-wedge", "all-modes")
"""Parts of Fourier space in which spectra are averaged; the transfer function is known in those of `signal_loss`."""


@dataclass(frozen=True)
class RealizationGraph:
    """One realization, and the graph of its experiment."""

    realization: Realization
    graph: Graph


@once
def realization_graphs(graph: Graph) -> list[RealizationGraph]:
    """Return the graphs of all realizations of an experiment; the first is the experiment's own.

    Visibilities of the others are removed from the store after their reduction.
    """
    first, *others = expand_realizations(graph.experiment)
    found = [RealizationGraph(first, Graph(first.experiment))]
    return found + [RealizationGraph(item, Graph(item.experiment, keep_visibilities=False)) for item in others]


def inputs(graph: Graph) -> dict[str, Task]:
    """Return the tasks of all inputs of pooling: ``spectra:n`` and ``transfer:n`` of realization n, counted from 0."""
    found = {}
    for number, item in enumerate(realization_graphs(graph)):
        found[f"spectra:{number}"] = _reduced(item.graph)
        found[f"transfer:{number}"] = required(signal_loss.transfer(item.graph))
    return found


def settings(graph: Graph) -> dict[str, Any]:
    """Return the settings of pooling: the draws of each realization, and the blocks."""
    blocks = [
        {"draw": list(block.draw), "members": places}
        for block, places in zip(graph.experiment.realizations, members(graph.experiment), strict=True)
    ]
    return {"draws": [dict(item.realization.draws) for item in realization_graphs(graph)], "blocks": blocks}


@once
def _reduced(graph: Graph) -> Task:
    experiment = graph.experiment
    needed = {name: spectra.power(graph, name) for name in SIGNAL_LOSS_VARIANTS}
    needed["levels"] = corruption.levels(graph)
    noisy = "noise" in experiment.variants[SIGNAL_LOSS_VARIANTS[0]].components
    if noisy:
        needed[NOISE] = spectra.variant_power(graph, NOISE, Variant(components=("noise",)))
    return Task(REDUCE, "spectra of a realization", {"power": experiment.power, "eor": experiment.sky.eor}, needed)


def reduce(job: Job) -> Mapping[str, Any]:
    """Write P^R with and without the EoR and P^S in all regions with their errors, and the input power at the same k.

    Errors are as in `calstudy.products.spectra`.
    """
    from calstudy.power.binned import make_bin_edges, spherical_average
    from calstudy.power.cosmology import input_power
    from calstudy.power.errors import noise_level, with_errors
    from calstudy.power.tables import save_spectrum

    power = job.settings["power"]
    names = [*SIGNAL_LOSS_VARIANTS, *([NOISE] if NOISE in job.inputs else [])]
    delays = {name: spectra.read_delay_spectra(job.inputs[name]) for name in names}
    sigma_noise = noise_level(delays[NOISE]) if NOISE in delays else 0.0
    residual, without, eor = SIGNAL_LOSS_VARIANTS
    for region in REGIONS:
        means = {
            name: spherical_average(delays[name], power, region == "outside-wedge", region == "inside-wedge")
            for name in SIGNAL_LOSS_VARIANTS
        }
        errors: dict[str, dict[str, Any]] = {
            residual: {"noise": sigma_noise, "signal": means[eor]},
            without: {"noise": sigma_noise},
            eor: {"signal": means[eor]},
        }
        for name, mean in means.items():
            save_spectrum(job.output / spectrum_file(name, region), with_errors(mean, **errors[name]))
    edges = make_bin_edges(power.bins)
    put_in = input_power(job.settings["eor"], (edges[1:] + edges[:-1]) / 2, power.cosmology)
    factor = read_json(job.inputs["levels"] / LEVELS)["eor_factor"]
    write_json(job.output / INPUT, {"power_mk2_h3_mpc3": (factor**2 * put_in).tolist()})
    return {}


def read_samples(folders: Mapping[str, Path], count: int, region: str) -> Sequence[Sample]:
    """Read the samples of the first `count` realizations in one of `REGIONS` from the products of `inputs`."""
    import numpy as np

    from calstudy.power.realizations import Sample
    from calstudy.power.spectra import SphericalSpectrum
    from calstudy.power.tables import load_spectrum
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


REDUCE = Stage(name="realization", version=1, make=reduce, cost=lambda task: Cost(10, disk=1e6))
