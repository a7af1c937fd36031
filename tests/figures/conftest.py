"""Small data with the dynamic range of the study: foregrounds 1e15, EoR 3e7, noise 6e7 mK² h⁻³ Mpc³."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.figure import Figure

from calstudy.figures.gains import compare_gains, draw_gains, draw_reflections
from calstudy.figures.layout import LayoutPanel, draw_layouts
from calstudy.figures.members import draw_solver_comparison
from calstudy.figures.runtime import draw_runtime, summarize_runtime
from calstudy.figures.spherical import SphericalColumn, draw_spherical
from calstudy.figures.visibilities import (
    BaselineSpectra,
    VisibilityComparison,
    compare_visibilities,
    draw_baselines,
    draw_comparison,
)
from calstudy.figures.wedge import TITLES, draw_wedge
from calstudy.plotting import style
from calstudy.plotting.axes import in_two_domains
from calstudy.power.delay import delays
from calstudy.power.spectra import CylindricalSpectrum, SphericalSpectrum

FREQUENCY = 167.075e6 + 80e3 * np.arange(64)


@pytest.fixture(scope="session")
def make_wedge_spectrum() -> Callable[..., CylindricalSpectrum]:
    """Return a maker of wedge spectra: power (Nb, Nd), bin edges (Nb, 2) in m."""

    def make(power: np.ndarray, bin_edges: np.ndarray, delay: np.ndarray) -> CylindricalSpectrum:
        length = bin_edges.mean(axis=1)
        return CylindricalSpectrum(
            baseline_length=length,
            bin_edges=bin_edges,
            k_perp=5.55e-4 * length,
            delay=delay,
            k_parallel=5.4e5 * delay,
            power=power.astype(complex),
            n_pairs=np.ones(length.size, dtype=int),
            horizon_delay=length / 299792458.0,
        )

    return make


@pytest.fixture(scope="session")
def wedge_panels(make_wedge_spectrum) -> dict[str, CylindricalSpectrum]:
    rng = np.random.default_rng(11)
    lower = 4.0 * np.concatenate([[2, 3], np.arange(6, 40, 3)])
    edges, delay = np.column_stack([lower, lower + 4]), np.arange(60) / 30.72e6
    shape = (lower.size, delay.size)
    inside = delay <= edges.mean(axis=1)[:, None] / 299792458.0
    foregrounds = np.where(inside, 1e15, 1e4) * rng.exponential(size=shape)
    eor, noise = 3e7 * rng.exponential(size=shape), 6e7 * rng.normal(size=shape)
    leaked = 1e12 * rng.exponential(size=shape)
    powers = (foregrounds + eor + noise, foregrounds + leaked, ~inside * (eor + noise), eor, noise)
    return {name: make_wedge_spectrum(power, edges, delay) for name, power in zip(TITLES, powers, strict=True)}


@pytest.fixture(scope="session")
def make_spherical_spectrum() -> Callable[..., SphericalSpectrum]:
    """Return a maker of spherical spectra in bins of 0.04 h/Mpc: power (Nk,), errors (Nk,) or numbers."""

    def make(power: np.ndarray, noise_error: np.ndarray | float, sample_error: np.ndarray | float) -> SphericalSpectrum:
        edges = 0.04 * np.arange(power.size + 1)
        ones = np.ones(power.size)
        return SphericalSpectrum(
            k=(edges[1:] + edges[:-1]) / 2,
            bin_edges=edges,
            power=power + 1e3j,
            n_modes=ones.astype(int),
            noise_modes=ones,
            sample_modes=ones,
            cross_modes=ones,
            noise_error=noise_error * ones,
            sample_error=sample_error * ones,
            wedge_excluded=True,
        )

    return make


@pytest.fixture(scope="session")
def make_column(make_spherical_spectrum) -> Callable[..., SphericalColumn]:
    """Return a maker of whole columns; the first bins, where everything is excised, are empty."""

    def make(seed: int, empty: int = 0, n_bins: int = 40) -> SphericalColumn:
        rng = np.random.default_rng(seed)
        k = 0.04 * (np.arange(n_bins) + 0.5)
        eor, noise = np.full(n_bins, 3e7), 2e6 * rng.normal(size=(3, n_bins))
        for array in (eor, noise):
            array[..., :empty] = np.nan
        foregrounds = 1e15 * np.exp(-k / 0.02)
        sample, thermal = 3e6 * np.sqrt(0.04 / k), 2e6
        return SphericalColumn(
            title=f"seed {seed}",
            eor=make_spherical_spectrum(eor, 0.0, sample),
            uncorrupted=make_spherical_spectrum(foregrounds + eor + noise[0], thermal, sample),
            uncalibrated=make_spherical_spectrum(1e12 + foregrounds + eor, thermal, sample),
            residual=make_spherical_spectrum(eor + noise[1], thermal, sample),
            residual_without_eor=make_spherical_spectrum(noise[2], thermal, 0.0),
            noise=make_spherical_spectrum(noise[0], thermal, 0.0),
        )

    return make


@pytest.fixture(scope="session")
def visibility_comparison() -> VisibilityComparison:
    rng = np.random.default_rng(12)
    foregrounds = 30 * np.exp(-2j * np.pi * FREQUENCY * 100e-9)
    noise = 0.02 * (rng.normal(size=64) + 1j * rng.normal(size=64))
    return compare_visibilities(((0, 1), 54.9), FREQUENCY, foregrounds + noise, foregrounds, noise)


@pytest.fixture(scope="session")
def baseline_spectra() -> list[BaselineSpectra]:
    delay = delays(64, 80e3)
    noise = np.full(64, 2e4)
    made = []
    for partner, length in enumerate((14.0, 54.9, 101.0, 170.0), start=1):
        inside = np.abs(delay) < length / 299792458.0
        data = np.where(inside, 1e8, 3e6)
        made.append(BaselineSpectra((0, partner), length, delay, data, 0.99 * data, noise * (1 - 0.5 * inside), noise))
    return made


@pytest.fixture(scope="session")
def draw_all(wedge_panels, make_column, visibility_comparison, baseline_spectra) -> Callable[..., dict[str, Figure]]:
    """Return a function that draws every kind of figure, or those named, with the given stand-ins."""
    rng = np.random.default_rng(13)
    arrays = [LayoutPanel(f"array {n}", np.arange(n), 40 * rng.normal(size=(n, 3)), (0, 1)) for n in (9, 36)]
    gains = 1 + 0.1 * (rng.normal(size=(2, 2, 64)) + 1j * rng.normal(size=(2, 2, 64)))
    excised = make_column(2, empty=1)
    seconds = np.array([[10.0], [40.0], [160.0]]) * np.exp(0.1 * rng.normal(size=(3, 50)))
    steps = [summarize_runtime(label, np.array([8, 16, 32]), seconds / speed) for label, speed in (("A", 1), ("B", 30))]

    def draw(stand_ins: tuple[str, ...] = (), only: tuple[str, ...] | None = None) -> dict[str, Figure]:
        drawings = {
            "layouts": lambda: draw_layouts(arrays),
            "layout": lambda: draw_layouts(arrays[:1]),
            "wedge": lambda: draw_wedge(wedge_panels),
            "spherical": lambda: draw_spherical([make_column(1), excised]),
            "spherical one column": lambda: draw_spherical([excised]),
            "solver comparison": lambda: draw_solver_comparison(
                {"one": (make_column(4), excised), "two": (excised, make_column(3, empty=1))}
            ),
            "gains": lambda: draw_gains(compare_gains((0, 1), FREQUENCY, *gains, gains[1])),
            "visibilities": lambda: draw_comparison(visibility_comparison, ("data", "model")),
            "baselines": lambda: draw_baselines(baseline_spectra),
            "three baselines": lambda: draw_baselines(baseline_spectra[:3]),
            "baseline": lambda: draw_baselines(baseline_spectra[:1]),
            "reflections": lambda: draw_reflections(in_two_domains(FREQUENCY, gains[0])),
            "runtime": lambda: draw_runtime(steps, "number of antennas", r"N_\mathrm{ant}"),
        }
        with style.journal_style():
            drawn = {name: drawings[name]() for name in only or drawings}
            for figure in drawn.values():
                style.note_stand_ins(figure, stand_ins)
        return drawn

    return draw
