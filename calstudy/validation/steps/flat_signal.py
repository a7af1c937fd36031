"""Step 0.1: a flat P(k) alone, through the beam, the simulation and the estimator.

For a Gaussian sky each mode's power |V~(tau)|^2 is exponentially distributed about P. A window function does not change
the mean of a flat spectrum, and no modes are cut. Experiments (skies of other seeds, other arrays) are pooled.

- *normalization*: mean of P^ / P over all modes; its error from the scatter of baselines, each one sample.
- *exponential*: Kolmogorov-Smirnov p-value of the modes about their own mean, by Monte Carlo with that mean fitted. Of
  correlated modes one is kept: delays further apart than the taper's correlation, baselines further apart than the
  beam's.
- *imaginary*: the estimate of two *different* baselines of a redundant group is complex; mean of Im over mean of Re,
  each pair in one order only, because the two orders are conjugates when there is no noise. A baseline crossed with
  itself has no imaginary part.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from astropy import constants
from pydantic import Field
from scipy.stats import expon, goodness_of_fit

from calstudy.claims.bins import clustered_mean, pooled
from calstudy.experiment.model import Variant
from calstudy.power.delay import mode_correlation
from calstudy.power.spectra import DelaySpectra
from calstudy.products import corruption, spectra
from calstudy.products.graph import Graph
from calstudy.run.task import Task
from calstudy.validation.step import MINREDUNDANT, REDUNDANT, Case, Findings, Limit, Step, StepInput
from calstudy.verdicts.criterion import AtLeast, Equal, Finding, Within

UNCORRELATED = 0.02
"""Modes whose powers correlate by less than this count as independent."""
DRAWS = 499
LARGEST_SAMPLE = 20_000
PAIRS = "pspec.h5"
"""File with the spectra of all pairs of baselines, which the estimator of hera_pspec stores with its product."""


def _sky(seed: int) -> Case:
    """Return another sky; its spectrum is white, so that pixels may be larger."""
    alone = {"corruption.eor_level": None, "sky.foregrounds": "none", "variants": {"eor": {"components": ["eor"]}}}
    changes: dict[str, Any] = {
        "sky.eor.seed": seed,
        "sky.eor.nside": 64,
        "simulation.chunks": 4,
        **alone,
        "outputs.figures": [],
    }
    return Case("minredundant.yaml", changes, {"sky.eor.seed": seed})


class FlatSignal(Step):
    """Normalization, p-value of the distribution, and imaginary part."""

    number = "0.1"
    proves = "the estimator recovers a flat input P(k) of the EoR, seen through the embedded element beam"
    # Several skies reduce the sampling error, 0.3 % for one.
    experiments: ClassVar = {"sky 2": MINREDUNDANT, "sky 12": _sky(12), "sky 22": _sky(22), "redundant": REDUNDANT}
    sections: ClassVar = ("power", "sky")
    parameters: ClassVar = {"redundant": "redundant"}
    limits: ClassVar = {
        "normalization": Limit(
            "mean of estimated over input P, all modes and skies",
            Within(0.99, 1.01),
            "1 % is several sampling errors; at small scale 3 sampling errors",
            small=Equal(1, 3),
        ),
        "exponential": Limit(
            "Kolmogorov-Smirnov p-value of independent modes against an exponential distribution",
            AtLeast(0.01),
            "a Gaussian sky has exponential powers; 1 % false alarms",
        ),
        "imaginary": Limit(
            "mean Im over mean Re of different baselines of redundant groups",
            Within(-0.015, 0.015),
            "1.5 %; at small scale 3 sampling errors",
            small=Equal(0, 3),
        ),
    }

    redundant: str = Field(description="The experiment whose baselines are crossed with others of their group.")

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the spectra of the EoR alone, and its level."""
        eor = Variant(components=("eor",))
        return {"eor": spectra.variant_power(graph, "eor", eor), "levels": corruption.levels(graph)}

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        """Compare the modes of all experiments with the input."""
        normalizations, independent = [], []
        for name, run in runs.items():
            if name == self.redundant:
                continue
            found = run.delay_spectra("eor")
            relative = found.power.real / run.input_power(np.array(1.0))
            normalizations.append(clustered_mean(relative))
            independent.append(thinned(relative, found))
        sample = np.concatenate(independent)
        if sample.size > LARGEST_SAMPLE:
            sample = np.random.default_rng(0).choice(sample, LARGEST_SAMPLE, replace=False)
        fit = goodness_of_fit(
            expon, sample, known_params={"loc": 0.0}, statistic="ks", n_mc_samples=DRAWS, rng=np.random.default_rng(1)
        )
        each = ", ".join(f"{item.value:.4f} ± {item.uncertainty:.4f}" for item in normalizations)
        values = {
            "normalization": pooled(normalizations),
            "exponential": Finding(float(fit.pvalue), 0.0),
            "imaginary": imaginary_part(runs[self.redundant]),
        }
        remark = f"normalization of each experiment: {each}; {sample.size} independent modes in the distribution"
        return Findings(values, (remark,))


def thinned(power: np.ndarray, modes: DelaySpectra) -> np.ndarray:
    """Return the powers of modes (Nu, Nd) of which no two are correlated, flattened."""
    correlation = mode_correlation(modes.taper, modes.delay.size)
    step = int(np.argmax(correlation < UNCORRELATED))
    # See `calstudy.power.errors`: powers of two baselines correlate by the square of the beam's own transform.
    rate = 2 * np.pi * modes.omega_pp * (modes.frequency / constants.c.value) ** 2
    reach = np.sqrt(-np.log(UNCORRELATED) / rate)
    kept: list[int] = []
    for index, vector in enumerate(modes.vectors):
        others = modes.vectors[kept]
        distance = np.minimum(np.linalg.norm(others - vector, axis=1), np.linalg.norm(others + vector, axis=1))
        if not (distance < reach).any():
            kept.append(index)
    return power[kept, ::step].ravel()


def imaginary_part(run: StepInput) -> Finding:
    """Return the mean imaginary part of different baselines of redundant groups, over the mean real part."""
    from hera_pspec import UVPSpec

    uvp = UVPSpec()
    uvp.read_hdf5(str(run.products["eor"] / PAIRS))
    first, second = np.divmod(uvp.blpair_array, 10**6)
    once = first < second
    power = uvp.data_array[0][once].mean(axis=2)
    # A baseline's pairs share its sky: its mean over partners is one sample.
    _, sample = np.unique(first[once], return_inverse=True)
    counts = np.bincount(sample)
    means = np.bincount(sample, power.imag.mean(axis=1)) / counts
    found, real = clustered_mean(means[:, None], counts), float(power.real.mean())
    return Finding(found.value / real, found.uncertainty / abs(real))
