"""Step 0.2: a steep P(k), which the taper's window mixes.

A delay spectrum at tau estimates the mean of P over k_par, weighted with the window |T~(tau - tau')|^2 of the taper T:

    E P^(tau) = sum_tau' |T~(tau - tau')|^2 P(sqrt(k_perp^2 + k_par(tau')^2)) / sum_tau' |T~|^2,

over the delays that the channels represent (the simulated sky has no others). The spread of k_perp by the beam is
neglected: beyond 0.3 h/Mpc it changes k only in second order. Only baselines within the resolution of the map are used.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field
from scipy.constants import speed_of_light

from calstudy.base.units import Wavenumber
from calstudy.claims.bins import clustered_mean, pooled
from calstudy.experiment.model import Variant
from calstudy.power.delay import make_taper
from calstudy.power.spectra import DelaySpectra
from calstudy.products import corruption, spectra
from calstudy.products.graph import Graph
from calstudy.run.task import Task
from calstudy.validation.step import Case, Findings, Limit, Step, StepInput
from calstudy.verdicts.criterion import Equal, Finding, Within

FINE = 8
"""Points of the integral over delays per delay of the spectrum."""
MARGIN = 60
"""Multipoles by which the beam spreads those of a baseline."""
BANDS = (0.3, 0.5, 1.0, np.inf)
POWER_LAW = {"sky.eor.spectrum": "power-law", "sky.eor.index": -2.0}
# Maps of nside 128 resolve baselines up to 80 m, more than half of the 630. The sampling error of one sky is 0.4 %.
STEEP = Case(
    "minredundant.yaml",
    {
        **POWER_LAW,
        "sky.eor.nside": 128,
        "sky.eor.seed": 2,
        "simulation.chunks": 2,
        "corruption.eor_level": None,
        "sky.foregrounds": "none",
        "variants": {"eor": {"components": ["eor"]}},
        "outputs.figures": [],
    },
    {**POWER_LAW, "sky.eor.nside": 64},
)


class SteepSignal(Step):
    """The mean of P^ over its expectation beyond a wavenumber, for all modes together and in bands."""

    number = "0.2"
    proves = "P(k) proportional to k^-2 is recovered, with the window function applied to the input"
    experiments: ClassVar = {"sky 2": STEEP}
    sections: ClassVar = ("power", "sky")
    parameters: ClassVar = {"k_min": "0.3 h/Mpc"}
    limits: ClassVar = {
        "normalization": Limit(
            "mean of estimated P over input P with window function, k > 0.3 h/Mpc",
            Within(0.98, 1.02),
            "2 %; at small scale 3 sampling errors",
            small=Equal(1, 3),
        ),
    }

    k_min: Wavenumber = Field(description="Modes below are left out.")

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the spectra of the EoR alone, and its level."""
        eor = Variant(components=("eor",))
        return {"eor": spectra.variant_power(graph, "eor", eor), "levels": corruption.levels(graph)}

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        """Compare the modes of all experiments with the windowed input."""
        whole: list[Finding] = []
        bands: dict[tuple[float, float], list[Finding]] = {band: [] for band in itertools.pairwise(BANDS)}
        for run in runs.values():
            found = run.delay_spectra("eor")
            relative = found.power.real / windowed(run.input_power, found)
            resolved = 2 * np.pi * found.length * found.frequency / speed_of_light + MARGIN
            relative[resolved > 3 * run.experiment.sky.eor.nside - 1] = np.nan
            k = np.hypot(found.k_perp[:, None], found.k_parallel)
            whole.append(clustered_mean(np.where(k > self.k_min, relative, np.nan)))
            for low, high in bands:
                bands[low, high].append(clustered_mean(np.where((k > low) & (k <= high), relative, np.nan)))
        parts = {band: pooled(means) for band, means in bands.items() if all(np.isfinite(item.value) for item in means)}
        remarks = tuple(
            f"k from {low:g} to {high:g} h/Mpc: {mean.value:.4f} ± {mean.uncertainty:.4f}"
            for (low, high), mean in parts.items()
        )
        return Findings({"normalization": pooled(whole), "lowest_band": next(iter(parts.values()))}, remarks)


def windowed(power: Callable[[np.ndarray], np.ndarray], modes: DelaySpectra) -> np.ndarray:
    """Return the expected estimates of `power` (a function of k in h/Mpc), (Nu, Nd); see the module."""
    count = modes.delay.size
    # Columns run through the delays in the order of the spectrum, each divided into FINE.
    offsets = (np.arange(FINE) - (FINE - 1) / 2) / FINE
    cells = (np.arange(count) - count // 2)[:, None] + offsets
    step = modes.k_parallel[1] - modes.k_parallel[0]
    k_parallel = cells * step
    expected = np.zeros((len(modes.k_perp), count))
    for column, offset in enumerate(offsets):
        values = power(np.hypot(modes.k_perp[:, None], k_parallel[:, column]))
        # A wave between two delays contributes to delay m of the transform with this weight.
        waves = make_taper(modes.taper, count) * np.exp(2j * np.pi * offset * np.arange(count) / count)
        weights = np.abs(np.fft.fft(waves)) ** 2
        expected += np.fft.ifft(np.fft.fft(values, axis=1) * np.fft.fft(weights), axis=1).real / weights.sum()
    return expected / FINE
