"""The stochastic diagonal of what gains absorb: one linear solve of the fit's own kind for each random vector."""

from __future__ import annotations

import numpy as np
import tensorflow as tf

from calstudy.calibrate import pairs
from calstudy.calibrate.problem import CalibrationProblem
from calstudy.calibrate.projection import Projection
from calstudy.calibrate.solvers.gauss_newton import (
    DAMPING_BOUNDS,
    PRECONDITIONER_DAMPING,
    Kernels,
    NormalEquations,
    compiled,
)
from calstudy.calibrate.solvers.preconditioners import Inverse, channel_inverse
from calstudy.calibrate.tangent import DelayModes, Tangent

CG_TOLERANCE, CG_ITERATIONS = 1e-5, 500


class Follower:
    """What gains do about a change of the data, at a solution.

    Parameters
    ----------
    problem
        What was fitted.
    gains
        The solution, (Nants, Nfreqs).
    """

    def __init__(self, problem: CalibrationProblem, gains: np.ndarray) -> None:
        self.kernels: Kernels = compiled(problem.structure, problem.frozen)
        reduced = self.kernels.reduce(problem, gains)
        self._unit = reduced.loss_unit
        projection: Projection = self.kernels.project(reduced.gains, *reduced.measured)
        stronger = tf.constant(PRECONDITIONER_DAMPING, tf.float32)
        if self.kernels.by_channel:
            inverse: Inverse = channel_inverse(self.kernels.tensors, projection, stronger)
        else:
            inverse = self.kernels.inverse(self.kernels.blocks(projection), stronger, reduced.gains)
        damping = tf.constant(DAMPING_BOUNDS[0], tf.float32)
        self._equations = NormalEquations(projection, reduced.gains, damping, inverse)
        self._solve = tf.function(self._follow)

    def follow(self, change: np.ndarray) -> np.ndarray:
        """Return the relative change eta of the gains, (Nants, Nfreqs), for a weighted change of the data.

        Parameters
        ----------
        change
            J* applied to the whitened change, in the unit of its square root of the loss: complex, (Nants, Nfreqs).
        """
        # Inside the kernels the loss has the weighted square of the data for a unit.
        return pairs.to_complex(self._solve(pairs.to_pair(change / self._unit, tf.float32)))

    def _follow(self, descent: tf.Tensor) -> tf.Tensor:
        eta, _ = self.kernels.solve(self._equations, descent, CG_TOLERANCE, CG_ITERATIONS)
        return eta


def probe(
    problem: CalibrationProblem, gains: np.ndarray, tangent: Tangent, modes: DelayModes, probes: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return <f|P|f> of the gains and its standard deviation, (Nbls, Ndelays) each; parameters as `expected_transfer`.

    Raises
    ------
    ValueError
        If there are fewer than two probes, which give no error.
    """
    if probes < 2:
        raise ValueError(f"probes: {probes}, at least 2 are needed")
    follower, rng = Follower(problem, gains), np.random.default_rng(seed)
    first, second = problem.structure.antennas.T
    shape, used = tangent.slope.shape, tangent.roots > 0
    sums = np.zeros((2, shape[0], modes.delay.size))
    for _ in range(probes):
        noise = used * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)
        pull = tangent.slope.conj() * tangent.free_of_foregrounds(noise)
        descent = np.zeros(gains.shape, complex)
        np.add.at(descent, first, pull)
        np.add.at(descent, second, pull.conj())
        eta = follower.follow(descent)
        response = tangent.free_of_foregrounds(tangent.slope * (eta[first] + eta[second].conj()))
        power = np.abs(modes.amplitudes(response)) ** 2
        sums += power, power**2
    mean, square = sums / probes
    return mean, np.sqrt(np.maximum(square - mean**2, 0) / (probes - 1))
