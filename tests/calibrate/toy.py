"""A small array under a sky of point sources seen through a chromatic beam, with gains and noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.constants import speed_of_light

from calstudy.calibrate.basis import make_basis
from calstudy.calibrate.problem import CalibrationProblem, FitStructure, flag_weights, gain_products
from calstudy.calibrate.settings import BasisSettings

FREQUENCIES = 160e6 + 400e3 * np.arange(64)
BASIS = BasisSettings(min_delay="50 ns", buffer="50 ns")
HEX = 14.0 * np.array([[x + y / 2, y * np.sqrt(0.75), 0] for y in (-1, 0, 1) for x in range(-1, 2) if abs(x + y) < 2])
LARGE_HEX = 14.0 * np.array(
    [[x + y / 2, y * np.sqrt(0.75), 0] for y in range(-2, 3) for x in range(-2, 3) if abs(x + y) < 3]
)


@dataclass(frozen=True)
class Toy:
    """Positions (Nants, 3) in m, antennas (Nbls, 2), foregrounds, gains and the noise in the visibilities."""

    positions: np.ndarray
    antennas: np.ndarray
    foregrounds: np.ndarray
    gains: np.ndarray
    noise: np.ndarray

    @property
    def visibilities(self) -> np.ndarray:
        return gain_products(self.gains, self.antennas) * (self.foregrounds + self.noise)

    @property
    def vectors(self) -> np.ndarray:
        return self.positions[self.antennas[:, 1]] - self.positions[self.antennas[:, 0]]

    @property
    def basis(self):
        return make_basis(np.linalg.norm(self.vectors, axis=1), FREQUENCIES, BASIS)

    @property
    def structure(self) -> FitStructure:
        return FitStructure.per_baseline(self.antennas, len(self.positions), self.basis)

    def problem(self, structure: FitStructure | None = None, **changes) -> CalibrationProblem:
        fields = {
            "structure": structure or self.structure,
            "visibilities": self.visibilities,
            "weights": flag_weights(np.zeros(self.foregrounds.shape, bool)),
            "initial_gains": np.ones(self.gains.shape, complex),
        }
        return CalibrationProblem(**(fields | changes))


def complex_normal(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def point_source_visibilities(vectors: np.ndarray, rng: np.random.Generator, n_sources: int = 300) -> np.ndarray:
    """Return visibilities in Jy, shape (Nbls, Nfreqs), of sources all over the upper hemisphere."""
    east_north = rng.uniform(-1, 1, (4 * n_sources, 2))
    east_north = east_north[(east_north**2).sum(1) < 1][:n_sources]
    up = np.sqrt(1 - (east_north**2).sum(1))
    delays = vectors @ np.column_stack([east_north, up]).T / speed_of_light
    flux = rng.pareto(1.5, up.size) + 1
    width = 0.3 * 160e6 / FREQUENCIES[:, None]
    beam = np.exp(-(np.arccos(up) ** 2) / (2 * width**2)) + 0.02 * up
    fringes = np.exp(-2j * np.pi * FREQUENCIES[:, None, None] * delays)
    return np.einsum("fbs,fs->bf", fringes, flux * beam)


def make_toy(positions: np.ndarray, noise: float = 1e-3, seed: int = 1, autos: bool = False) -> Toy:
    rng = np.random.default_rng(seed)
    antennas = np.column_stack(np.triu_indices(len(positions), 0 if autos else 1))
    foregrounds = point_source_visibilities(positions[antennas[:, 1]] - positions[antennas[:, 0]], rng)
    rms = np.sqrt(np.mean(np.abs(foregrounds) ** 2))
    shape = (len(positions), FREQUENCIES.size)
    gains = 1 + 0.1 * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    return Toy(positions, antennas, foregrounds, gains, noise * rms * complex_normal(rng, foregrounds.shape))


def scattered(n_antennas: int, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-10, 10, (n_antennas, 2)), np.zeros(n_antennas)])


def turned(toy):
    """The toy with every second baseline reversed."""
    antennas, foregrounds = toy.antennas.copy(), toy.foregrounds.copy()
    antennas[::2] = antennas[::2, ::-1]
    foregrounds[::2] = foregrounds[::2].conj()
    noise = toy.noise.copy()
    noise[::2] = noise[::2].conj()
    return replace(toy, antennas=antennas, foregrounds=foregrounds, noise=noise)
