"""Tables of runs in which the truth of every claim is known by construction."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calstudy.experiment.files import validate
from calstudy.power.score import Score
from calstudy.power.spectra import CylindricalSpectrum, SphericalSpectrum
from calstudy.power.tables import save_spectrum
from calstudy.power.transfer import TransferFunction
from calstudy.results.reader import Results

SIGNAL = 1e7
EDGES = 0.04 * np.arange(85)
K = (EDGES[1:] + EDGES[:-1]) / 2
DELAY = np.arange(193) / 30.72e6
LENGTHS = 4.0 * np.arange(3, 40)
PER_SECOND = 5.4e5
"""k_parallel over delay, h/Mpc/s: 1200 ns are at 0.648 h/Mpc."""


@dataclass(frozen=True)
class World:
    """What is true of a run; powers in units of the EoR's, the numbers of `agreement` as in agreement.json."""

    recovered: float = 1.0
    recovered_small_k: float = 1.0
    biased_below: float = 0.24
    outside_biased_below: float = 0.0
    noise: float = 0.03
    without_eor_bias: float = 0.0
    without_eor_error: float = 0.0
    leakage: float = 1e6
    foregrounds: float = 3e8
    sidelobes: float = 10.0
    window_leak: float = 0.0
    artefact: float = 0.0
    artefact_left: float = 0.0
    scale_free_transfer: float = 0.94
    coherence: float = 1.0
    flux_scale: float = 1.01
    redundant_fraction: float = 0.02
    agreement: dict[str, float] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)


PAPERS_AGREEMENT = {
    "gains_aligned": 0.1,
    "gains_raw": 0.12,
    "gains_by_delay": 0.1,
    "gains_worst_delay": 0.18,
    "gains_raw_by_delay": 0.11,
    "gains_raw_worst_delay": 0.19,
    "model_aligned": 0.15,
    "model_raw": 0.16,
    "model_over_noise": 100.0,
    "product_over_noise": 0.97,
    "product_over_data": 0.001,
    "product_worst_delay": 1.1,
    "correction_over_noise_outside": 0.8,
    "residual_over_noise_outside": 0.97,
    "residual_over_noise_inside": 0.3,
    "data_over_residual_outside": 1000.0,
    "data_over_noise_outside": 1.1,
}


def spherical(world: World, rng: np.random.Generator, kind: str, modes: str) -> SphericalSpectrum:
    noise, signal = SIGNAL * world.noise * rng.normal(size=K.size), np.full(K.size, SIGNAL)
    inside = (world.biased_below > EDGES[:-1] + 1e-9) if modes == "all-modes" else np.zeros(K.size, bool)
    lost = (world.outside_biased_below > EDGES[:-1] + 1e-9) if modes == "outside-wedge" else np.zeros(K.size, bool)
    kept = np.where(lost, 0.8, 1.0) * np.where(
        inside, 0.05, np.where(K < 0.3, world.recovered_small_k, world.recovered)
    )
    lowest = np.exp(-K / 0.01) if modes == "all-modes" else np.where(K < 0.25, world.sidelobes / world.foregrounds, 0)
    reflection = SIGNAL * ((K > 0.54) & (K < 0.76))
    power = {
        "eor": signal,
        "noise": noise,
        "uncorrupted": signal + noise + SIGNAL * world.foregrounds * lowest,
        "uncalibrated": signal + noise + SIGNAL * world.leakage + world.artefact * reflection,
        "residual": kept * signal + noise + world.artefact_left * reflection,
        "residual_without_eor": noise + SIGNAL * np.where(K < 0.5, world.without_eor_bias, 0),
    }[kind]
    has_noise, has_signal = kind != "eor", kind not in ("noise", "residual_without_eor")
    ones = np.ones(K.size)
    first = 0 if modes == "all-modes" else 2
    return SphericalSpectrum(
        k=K,
        bin_edges=EDGES,
        power=np.where(np.arange(K.size) < first, np.nan, power).astype(complex),
        n_modes=np.where(np.arange(K.size) < first, 0, 1000),
        noise_modes=1000 * ones,
        sample_modes=1000 * ones,
        cross_modes=1000 * ones,
        noise_error=SIGNAL * world.noise * ones * has_noise,
        sample_error=SIGNAL / np.sqrt(1000) * ones * has_signal,
        wedge_excluded=modes == "outside-wedge",
    )


def wedge(world: World, rng: np.random.Generator, kind: str) -> CylindricalSpectrum:
    shape = (LENGTHS.size, DELAY.size)
    horizon = LENGTHS / 299792458.0
    noise, signal = SIGNAL * rng.normal(size=shape), np.full(shape, SIGNAL)
    inside = (horizon + 130e-9)[:, None] > DELAY
    power = {
        "eor": signal,
        "noise": noise,
        "uncorrupted": signal + noise + SIGNAL * np.where(inside, world.foregrounds, world.window_leak),
        "uncalibrated": signal + noise + SIGNAL * world.leakage,
        "residual": world.recovered * signal + noise,
        "residual_without_eor": noise,
    }[kind]
    return CylindricalSpectrum(
        baseline_length=LENGTHS,
        bin_edges=np.column_stack([LENGTHS - 2, LENGTHS + 2]),
        k_perp=5.5e-4 * LENGTHS,
        delay=DELAY,
        k_parallel=PER_SECOND * DELAY,
        power=power.astype(complex),
        n_pairs=np.full(LENGTHS.size, 10),
        horizon_delay=horizon,
    )


def transfer(world: World) -> TransferFunction:
    ones = np.ones(K.size)
    scale_free = world.scale_free_transfer * ones
    value = scale_free / world.flux_scale**2
    return TransferFunction(
        k=K,
        bin_edges=EDGES,
        transfer=value,
        transfer_error=0.01 * ones,
        cross_transfer=scale_free / world.flux_scale,
        cross_transfer_error=0.01 * ones,
        scale_free_transfer=scale_free,
        scale_free_transfer_error=0.01 * ones,
        squared_coherence=world.coherence * ones,
        squared_coherence_error=0.001 * ones,
        signal=SIGNAL * ones,
        n_samples=100 * np.ones(K.size, int),
        flux_scale=world.flux_scale,
    )


def score(world: World) -> Score:
    ones = np.ones(K.size)
    # Of noise, and of what foregrounds leave: as in the spectra.
    error = np.hypot(world.noise, np.where(K < 0.5, world.without_eor_error, 0))
    return Score(
        k=K,
        bin_edges=EDGES,
        transfer=world.scale_free_transfer * ones,
        transfer_error=0.01 * ones,
        cross_transfer=world.scale_free_transfer * ones,
        bias=world.flux_scale**2 * np.where(K < 0.5, world.without_eor_bias, 0),
        bias_error=world.flux_scale**2 * error,
        recovered=world.recovered * ones,
        recovered_error=0.01 * ones,
        flux_scale=world.flux_scale,
    )


KINDS = ("eor", "noise", "uncorrupted", "uncalibrated", "residual", "residual_without_eor")


@pytest.fixture
def make_study(tmp_path) -> Callable[..., Results]:
    """Return a maker of studies: `make(name, kinds, **facts of World)`."""

    def make(name: str = "run", kinds: tuple[str, ...] = KINDS, seed: int = 1, **truth: Any) -> Results:
        world = World(**truth)
        folder = tmp_path / name
        folder.mkdir(parents=True)
        for kind in kinds:
            rng = np.random.default_rng(seed)
            for modes in ("all-modes", "outside-wedge"):
                save_spectrum(folder / f"{kind}.{modes}.h5", spherical(world, rng, kind, modes))
            save_spectrum(folder / f"{kind}.wedge.h5", wedge(world, rng, kind))
        save_spectrum(folder / "transfer.outside-wedge.h5", transfer(world))
        save_spectrum(folder / "score-bins.h5", score(world))
        values = PAPERS_AGREEMENT | world.agreement
        measurements = {
            key: {"value": value, "scatter": 0.1 * value, "count": 100, "over": "baselines"}
            for key, value in values.items()
        }
        agreement = {"measurements": measurements, "redundant_fraction": world.redundant_fraction}
        Path(folder / "agreement.json").write_text(json.dumps(agreement))
        calibration = {"weights": "flags", **world.facts.get("calibration", {})}
        data = {"name": name, "papers": ["calamity2022"], **world.facts, "calibration": calibration}
        experiment = validate(data, tmp_path)
        return Results((folder,), experiment)

    return make
