"""The realizations of an experiment, each reduced to spectra in bins of k."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calstudy.base.resources import Cost
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS, Variant
from calstudy.experiment.realizations import expand_realizations, members
from calstudy.products import corruption, signal_loss, spectra
from calstudy.products.corruption import LEVELS
from calstudy.products.files import read_json, spectrum_file, write_json
from calstudy.products.graph import Graph, memoize, required
from calstudy.run.task import Input, Task, called

if TYPE_CHECKING:
    from calstudy.power.realizations import Sample
    from calstudy.power.settings import PowerSettings
    from calstudy.sky.settings import Eor

NOISE = "noise"
INPUT = "input.json"
REGIONS = ("outside-wedge", "inside-wedge", "all-modes")
"""Parts of Fourier space in which spectra are averaged; the transfer function is known in those of `signal_loss`."""


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


class Reduced(Task, stage="realization", version=1):
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
        from calstudy.power.drawn import input_power
        from calstudy.power.errors import noise_level, with_errors
        from calstudy.power.spherical import make_bin_edges, spherical_average
        from calstudy.power.tables import save_spectrum

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

    def _cost(self) -> Cost:
        return Cost(10, disk=1e6)


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
