"""Steps 0.0 to 0.2: the estimator of power spectra, on noise and on the EoR alone.

Step 0.0: noise alone, whose power follows from its standard deviation.

For white noise of standard deviation sigma (Jy, complex) per integration, N_t integrations averaged, and a taper T, the
noise power of one baseline is

    P_N = dnu sum_nu T^2 s^2 / sum_nu T^2 (Omega_pp / Omega_p^2) / (X^2 Y),   s = sigma / sqrt(N_t) in mK,

which is the familiar X^2 Y Omega_eff T^2 dnu; X and Y are evaluated at the channels of the band. Even and odd
data have independent noise, so that Re and Im of their product have mean zero and standard deviation
P_N / sqrt(2).

Baselines have independent noise. Means and mean squares over a baseline's delays are the samples, from whose scatter
the sampling errors are computed: these include correlations between delays and the long tails of the products.

Step 0.1: a flat P(k) alone, through the beam, the simulation and the estimator.

For a Gaussian sky each mode's power |V~(tau)|^2 is exponentially distributed about P. A window function does not change
the mean of a flat spectrum, and no modes are cut. Experiments (skies of other seeds, other arrays) are pooled.

- *normalization*: mean of P^ / P over all modes; its error from the scatter of baselines, each one sample.
- *exponential*: Kolmogorov-Smirnov p-value of the modes about their own mean, by Monte Carlo with that mean fitted. Of
  correlated modes one is kept: delays further apart than the taper's correlation, baselines further apart than the
  beam's.
- *imaginary*: the estimate of two *different* baselines of a redundant group is complex; mean of Im over mean of Re,
  each pair in one order only, because the two orders are conjugates when there is no noise. A baseline crossed with
  itself has no imaginary part.

Step 0.2: a steep P(k), which the taper's window mixes.

A delay spectrum at tau estimates the mean of P over k_par, weighted with the window |T~(tau - tau')|^2 of the taper T:

    E P^(tau) = sum_tau' |T~(tau - tau')|^2 P(sqrt(k_perp^2 + k_par(tau')^2)) / sum_tau' |T~|^2,

over the delays that the channels represent (the simulated sky has no others). The spread of k_perp by the beam is
neglected: beyond 0.3 h/Mpc it changes k only in second order. Only baselines within the resolution of the map are used.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import Field
from scipy.stats import expon, goodness_of_fit, sem

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.units import Wavenumber
from calstudy.claims.bins import clustered_mean, pooled
from calstudy.corrupt.levels import Levels
from calstudy.experiment.model import Component, Variant
from calstudy.instrument.beams import make_beam
from calstudy.instrument.settings import InstrumentSettings
from calstudy.power.cosmology import make_cosmology, radial_scale, redshift, transverse_scale
from calstudy.power.delay import make_taper
from calstudy.power.estimate import kelvin_per_jansky
from calstudy.power.settings import PowerSettings
from calstudy.power.spectra import DelaySpectra
from calstudy.products import corruption, spectra
from calstudy.products.graph import Graph
from calstudy.run.task import Task
from calstudy.validation.step import (
    MINREDUNDANT,
    REDUNDANT,
    Case,
    Findings,
    Limit,
    Step,
    StepInput,
    largest,
    mean_over,
    only,
)
from calstudy.verdicts.criterion import AtLeast, Equal, Finding, Within


def _alone(graph: Graph, component: Component) -> Mapping[str, Task]:
    """Return the spectra of one component without the others, by its name, and the levels of all."""
    variant = Variant(components=(component,))
    return {component: spectra.variant_power(graph, component, variant), "levels": corruption.levels(graph)}


class Noise(Step):
    """The scatter of the estimates over that of theory, and the means of Re and Im in units of P_N."""

    kind: str = "noise"
    number = "0.0"
    proves = "the theoretical P_N equals the scatter of the estimates; even x odd has mean zero"
    experiments: ClassVar = {"noise": MINREDUNDANT}
    sections: ClassVar = ("instrument", "power")
    limits: ClassVar = {
        "scatter_over_theory": Limit(
            "rms of even x odd over P_N / sqrt(2)",
            Equal(1, 3),
            "3 sigma of the sampling error, from the scatter of baselines",
        ),
        "mean_real": Limit("mean of Re(even x odd) over P_N", Equal(0, 3), "independent noise has no cross power"),
        "mean_imaginary": Limit("mean of Im(even x odd) over P_N", Equal(0, 3), "as above"),
    }

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        return _alone(graph, "noise")

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        run = only(runs)
        found = run.delay_spectra("noise")
        theory = noise_power(run.experiment.instrument, run.experiment.power, run.levels)
        products = found.power * np.sqrt(found.n_pairs)[:, None] / theory
        square = _mean(np.mean(products.real**2, axis=1))
        scatter = np.sqrt(2 * square.value)
        values = {
            "scatter_over_theory": Finding(scatter, scatter * square.uncertainty / (2 * square.value)),
            "mean_real": _mean(products.real.mean(axis=1)),
            "mean_imaginary": _mean(products.imag.mean(axis=1)),
        }
        return Findings(
            values, (f"P_N of one baseline: {theory:.4g} mK2 h-3 Mpc3; {len(products)} baselines or groups",)
        )


def noise_power(instrument: InstrumentSettings, power: PowerSettings, levels: Levels) -> float:
    """Return P_N of one baseline and the first polarization in mK2 h-3 Mpc3; see the module."""
    channels = instrument.channels
    frequencies = channels.frequencies
    omega_p, omega_pp = make_beam(instrument.beam, channels).solid_angles(frequencies, instrument.polarizations[0])
    sigma = levels.noise if levels.noise_spectrum is None else np.array(levels.noise_spectrum)[:, 0]
    temperature = 1e3 * sigma / np.sqrt(instrument.times.count) * kelvin_per_jansky(frequencies, omega_p, None)
    cosmology = make_cosmology(power.cosmology)
    redshifts = np.asarray(redshift(frequencies))
    volume = cosmology.h**3 * np.array(
        [transverse_scale(cosmology, z) ** 2 * radial_scale(cosmology, z) for z in redshifts]
    )
    taper = make_taper(power.taper, channels.count) ** 2
    return float(channels.width * np.sum(taper * temperature**2) / np.sum(taper * omega_pp / omega_p**2 / volume))


def _mean(values: np.ndarray) -> Finding:
    return Finding(float(values.mean()), float(values.std(ddof=1) / np.sqrt(values.size)))


UNCORRELATED = 0.02
"""Modes whose powers correlate by less than this count as independent."""
DRAWS = 499
LARGEST_SAMPLE = 20_000
PAIRS = "pspec.h5"
"""File with the spectra of all pairs of baselines, which the estimator of hera_pspec stores with its product."""


EOR_ALONE: dict[str, Any] = {
    "corruption.eor_level": None,
    "sky.foregrounds": "none",
    "variants": {"eor": {"components": ["eor"]}},
    "outputs.figures": [],
}


def _sky(seed: int) -> Case:
    """Return another sky; its spectrum is white, so that pixels may be larger."""
    changes = {"sky.eor.seed": seed, "sky.eor.nside": 64, "simulation.chunks": 4, **EOR_ALONE}
    return Case("minredundant.yaml", changes, {"sky.eor.seed": seed})


class FlatSignal(Step):
    """Normalization, p-value of the distribution, and imaginary part."""

    kind: str = "flat-signal"
    version: ClassVar[int] = 2
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
            "1 % is two errors by the scatter of three skies; at small scale 3 sampling errors",
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
        return _alone(graph, "eor")

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        normalizations, independent = [], []
        for name, run in runs.items():
            if name == self.redundant:
                continue
            found = run.delay_spectra("eor")
            relative = found.power.real / run.input_power(np.array(1.0))
            normalizations.append(mean_over(relative, np.ones(relative.shape, bool)))
            independent.append(thinned(relative, found))
        sample = np.concatenate(independent)
        if sample.size > LARGEST_SAMPLE:
            sample = np.random.default_rng(0).choice(sample, LARGEST_SAMPLE, replace=False)
        each = ", ".join(f"{item.value:.4f} ± {item.uncertainty:.4f}" for item in normalizations)
        normalization = pooled(normalizations)
        if len(normalizations) > 1:
            # Their scatter has what the errors of one sky lack.
            scatter = float(sem([item.value for item in normalizations]))
            normalization = normalization._replace(uncertainty=largest((normalization.uncertainty, scatter)))
        values = {
            "normalization": normalization,
            "exponential": Finding(_exponential(sample), 0.0),
            "imaginary": imaginary_part(runs[self.redundant]),
        }
        remark = f"normalization of each experiment: {each}; {sample.size} independent modes in the distribution"
        return Findings(values, (remark,))


def _exponential(sample: np.ndarray) -> float:
    if not np.isfinite(sample).all():
        return np.nan
    known, rng = {"loc": 0.0}, np.random.default_rng(1)
    return float(goodness_of_fit(expon, sample, known_params=known, statistic="ks", n_mc_samples=DRAWS, rng=rng).pvalue)


def thinned(power: np.ndarray, modes: DelaySpectra) -> np.ndarray:
    """Return the powers of modes (Nu, Nd) of which no two are correlated, flattened."""
    step = int(np.argmax(modes.between_delays < UNCORRELATED))
    # See `calstudy.power.binned`: powers of two baselines correlate by the square of the beam's own transform.
    rate = 2 * np.pi * modes.omega_pp * (modes.frequency / SPEED_OF_LIGHT) ** 2
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


FINE = 8
"""Points of the integral over delays per delay of the spectrum."""
MARGIN = 60
"""Multipoles by which the beam spreads those of a baseline."""
BANDS = (0.3, 0.5, 1.0, np.inf)
POWER_LAW = {"sky.eor.spectrum": "power-law", "sky.eor.index": -2.0}
# Maps of nside 128 resolve baselines up to 80 m, more than half of the 630. The sampling error of one sky is 0.4 %.
STEEP = Case(
    "minredundant.yaml",
    {**POWER_LAW, "sky.eor.nside": 128, "sky.eor.seed": 2, "simulation.chunks": 2, **EOR_ALONE},
    {**POWER_LAW, "sky.eor.nside": 64},
)


class SteepSignal(Step):
    """The mean of P^ over its expectation beyond a wavenumber, for all modes together and in bands."""

    kind: str = "steep-signal"
    version: ClassVar[int] = 2
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
        return _alone(graph, "eor")

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        whole: list[Finding] = []
        bands: dict[tuple[float, float], list[Finding]] = {band: [] for band in itertools.pairwise(BANDS)}
        for run in runs.values():
            found = run.delay_spectra("eor")
            relative = found.power.real / windowed(run.input_power, found)
            multipoles = 2 * np.pi * found.length * found.frequency / SPEED_OF_LIGHT + MARGIN
            resolved = (multipoles <= 3 * run.experiment.sky.eor.nside - 1)[:, None]
            k = np.hypot(found.k_perp[:, None], found.k_parallel)
            whole.append(mean_over(relative, resolved & (k > self.k_min)))
            for low, high in bands:
                bands[low, high].append(mean_over(relative, resolved & (k > low) & (k <= high)))
        parts = {band: pooled(means) for band, means in bands.items() if all(np.isfinite(item.value) for item in means)}
        remarks = tuple(
            f"k from {low:g} to {high:g} h/Mpc: {mean.value:.4f} ± {mean.uncertainty:.4f}"
            for (low, high), mean in parts.items()
        )
        lowest = next(iter(parts.values()), Finding(np.nan, np.nan))
        return Findings({"normalization": pooled(whole), "lowest_band": lowest}, remarks)


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
