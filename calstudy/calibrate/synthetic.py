"""Small synthetic integrations of the paper's problem: point sources, random gains, thermal noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.calibrate.basis import make_basis
from calstudy.calibrate.problem import CalibrationProblem, FitStructure, flag_weights, gain_products
from calstudy.calibrate.settings import BasisSettings

SIDEREAL_RATE = 7.2921e-5
SOURCES = 150


@dataclass(frozen=True)
class Case:
    """Size and noise of a synthetic problem.

    A random array has the diameter `extent`, m. The first channel and the band, by default the paper's, are in Hz, and
    the time between integrations is in s. Noise and EoR are over the rms of the foregrounds.
    """

    antennas: int = 36
    channels: int = 384
    extent: float = 176.0
    first: float = 167.075e6
    band: float = 30.72e6
    gain_scatter: float = 0.1
    noise: float = 1e-3
    eor: float = 0.0
    integration: float = 2.0
    seed: int = 1

    @property
    def frequencies(self) -> np.ndarray:
        """Channel centres, Hz, (channels,)."""
        return self.first + self.band / self.channels * np.arange(self.channels)


class Simulation:
    """Array, sky and gains of a case.

    Positions are east, north, up of the antennas in m, (Nants, 3), by default at random within `case.extent`. Baselines
    are pairs of antenna indices, (Nbls, 2); true gains are constant in time, (Nants, Nfreqs).
    """

    def __init__(self, case: Case, positions: np.ndarray | None = None) -> None:
        self.case = case
        rng = np.random.default_rng(case.seed)
        self.positions = _disc(case, rng) if positions is None else positions
        self.antennas = np.column_stack(np.triu_indices(case.antennas, 1))
        self._east, self._north, self._flux = _sky(rng)
        shape = (case.antennas, case.channels)
        self.gains = 1 + case.gain_scatter * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
        self._rms = float(np.sqrt(np.mean(np.abs(self.foregrounds(0)) ** 2)))

    def structure(self, basis: BasisSettings | None = None) -> FitStructure:
        """Return the structure of per-baseline modelling."""
        lengths = np.linalg.norm(self.positions[self.antennas[:, 1]] - self.positions[self.antennas[:, 0]], axis=1)
        found = make_basis(lengths, self.case.frequencies, basis or BasisSettings())
        return FitStructure.per_baseline(self.antennas, self.case.antennas, found)

    def foregrounds(self, integration: int) -> np.ndarray:
        """Simulate the foregrounds F of one integration under the drifting sky, (Nbls, Nfreqs), complex."""
        angle = SIDEREAL_RATE * self.case.integration * integration
        east = self._east + angle * np.sqrt(np.maximum(1 - self._east**2 - self._north**2, 0))
        up = np.sqrt(np.maximum(1 - east**2 - self._north**2, 0))
        delay = self.positions @ np.stack([east, self._north, up]) / SPEED_OF_LIGHT
        first, second = self.antennas.T
        result = np.empty((len(self.antennas), self.case.channels), complex)
        for channel, frequency in enumerate(self.case.frequencies):
            width = 0.25 * 182e6 / frequency
            beam = np.exp(-(np.arccos(up) ** 2) / (2 * width**2)) + 0.01 * up
            fringe = np.exp(2j * np.pi * frequency * delay)
            matrix = (fringe * (beam * self._flux * (frequency / 182e6) ** -0.8)) @ fringe.conj().T
            result[:, channel] = matrix[second, first]
        return result

    def problem(self, integration: int, structure: FitStructure, realization: int = 0) -> CalibrationProblem:
        """Return the problem of one integration with one realization of the noise, starting from unity gains.

        The EoR is white in frequency, independent by baseline, and the same in all integrations.
        """
        shape = (len(self.antennas), self.case.channels)
        eor = self.case.eor * self._rms * _complex_normal(np.random.default_rng([self.case.seed, 17]), shape)
        rng = np.random.default_rng([self.case.seed, 3, integration, realization])
        noise = self.case.noise * self._rms * _complex_normal(rng, shape)
        return CalibrationProblem(
            structure,
            gain_products(self.gains, self.antennas) * (self.foregrounds(integration) + eor + noise),
            flag_weights(np.zeros(shape, bool)),
            np.ones(self.gains.shape, complex),
        )


def _disc(case: Case, rng: np.random.Generator) -> np.ndarray:
    """Draw antennas in a flat disc, (Nants, 3), m."""
    radius = case.extent / 2 * np.sqrt(rng.uniform(0, 1, case.antennas))
    angle = rng.uniform(0, 2 * np.pi, case.antennas)
    # The longest baseline is between two antennas at the rim.
    radius[:2], angle[:2] = case.extent / 2, (0.0, np.pi)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(case.antennas)])


def _complex_normal(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def _sky(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw direction cosines and flux densities of sources that do not set."""
    radius, angle = 0.98 * np.sqrt(rng.uniform(0, 1, SOURCES)), rng.uniform(0, 2 * np.pi, SOURCES)
    return radius * np.cos(angle), radius * np.sin(angle), rng.pareto(1.5, SOURCES) + 1
