"""The deviation of the foregrounds' prior from the data themselves, by restricted maximum likelihood.

In units in which the noise is white, data that are linearized about the best gains are

    y = J eta + sum_k B_k x_k + n,

where J is the Jacobian of the gains, B_k x_k are errors of the sky model with coefficients x_k of unit variance, of
each baseline by itself and common to redundant ones, and n is the noise. Gains are free, so that the likelihood of the
variances is that of what gains cannot follow (Patterson & Thompson 1971, Biometrika 58, 545). With M as in
`calstudy.calibrate.expected_loss`, its derivative in a factor f_k on the variance of x_k is, at f_k = 1,

    |B_k^T M y|^2 - tr(B_k^T M B_k),

and the Fisher matrix is F_kl = tr(B_k^T M B_l B_l^T M B_k). The residual of the fit is M y, and B_k^T M y are the
fitted coefficients. So a fit estimates its own prior: coefficients that are larger than their expectation ask for a
larger deviation. Where data determine all coefficients, the best factor is the ratio of both terms; where they
determine few, it is further away. A step

    ln f = F^-1 diag(t) ln(|B_k^T M y|^2 / t_k),   t_k = tr(B_k^T M B_k),

is exact in the first case, for one k, and a step of Fisher scoring near the maximum. F^-1 is the covariance of ln f
there. Traces are from random x (Hutchinson 1990, Commun. Stat. Simul. Comput. 19, 433), with a variance of F over their
number.

A variance whose likelihood is largest at or below zero shrinks forever, to less and less effect: it is taken out of F,
so that the others settle without it. All coefficients of all integrations of a solve count as independent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from calstudy.base.tensorflow import tf
from calstudy.calibrate.expected_loss import GainResponse
from calstudy.calibrate.problem import CalibrationProblem, gain_products

LEAST, MOST = 1e-7, 10.0
"""Limits of the deviation, over the rms of the sky model."""
FURTHEST = math.log(100)
"""Largest change of the logarithm of a variance in a step."""
FAR_BELOW = -0.7
"""Steps down to noise are short of it, and are doubled from here on."""
PROBES = 4
TOLERANCE = 1e-2
"""Of the gains' response to a probe: traces have an error of some percent in any case."""
SETTLED = 0.05
"""Increase of the logarithm of the likelihood from which on another pass is made: that of a step of 0.3 errors."""
PASSES = 10
"""Largest number of passes, or that of the weights if they have more."""
SINGLE = 200.0
"""Largest ratio of deviation and noise for probes in single precision."""
ALIKE = 0.95
"""Largest correlation of two variances in F: without redundant baselines they are one, and their probes differ."""
ROUNDED = 1.1
"""F_kk is below t_k for each probe; probes beyond this are rounding."""


class Estimate(NamedTuple):
    """Deviations of the prior, (own, shared), over the rms of the sky model.

    `error` is that of the logarithm of each, None for one that noise hides, or that the prior does not have. `settled`
    says whether another pass would not change them, and `resolved` whether they are more than rounding.
    """

    deviations: tuple[float, float]
    error: tuple[float | None, float | None]
    settled: bool
    resolved: bool = True


def estimate(problem: CalibrationProblem, gains: np.ndarray, model: np.ndarray, seed: Sequence[int]) -> Estimate:
    """Make one step from the deviations of a problem towards the most likely ones, at its solution.

    The foregrounds of the problem have a finite prior. The solution is complex, (Nants, Nfreqs) and (Nbls, Nfreqs).
    `seed` is that of the probes, other numbers for other solves.
    """
    sequences = _Sequences(problem)
    widest = max(problem.deviations) * math.sqrt(problem.weights.max())
    response = GainResponse(problem, gains, TOLERANCE, tf.float32 if widest < SINGLE else tf.float64)
    products, rng = gain_products(gains, problem.structure.antennas), np.random.default_rng(list(seed))
    residual = problem.weights * np.abs(products) ** 2 * (problem.visibilities / products - model)
    # A residual of exactly zero has a logarithm, too.
    powers = np.array([_power(found) for found in sequences.coefficients(residual)]) + np.finfo(float).tiny
    traces, fisher = np.zeros(len(powers)), np.zeros((len(powers), len(powers)))
    for _ in range(PROBES):
        for level in range(len(powers)):
            drawn = sequences.draw(level, rng)
            left = response.left_of(drawn)
            traces[level] += np.vdot(drawn, left).real / PROBES
            fisher[level] += [_power(found) / PROBES for found in sequences.coefficients(left)]
    if not (np.isfinite(fisher).all() and (traces > 0).all() and (np.diag(fisher) < ROUNDED * traces).all()):
        return Estimate(problem.fractions, (None, None), settled=False, resolved=False)
    return _stepped(problem, sequences.levels, powers, traces, fisher)


def _stepped(
    problem: CalibrationProblem, levels: Sequence[int], powers: np.ndarray, traces: np.ndarray, fisher: np.ndarray
) -> Estimate:
    """Return the deviations after a step, from |B_k^T M y|^2, t and F of the levels of the prior."""
    # Noise hides them, and the best variance is negative.
    vanishing = (np.diag(fisher) < 1) & (traces - powers > np.diag(fisher))
    scale = np.sqrt(np.outer(np.diag(fisher), np.diag(fisher)))
    correlation = np.clip((fisher + fisher.T) / 2 / scale, -ALIKE, ALIKE)
    np.fill_diagonal(correlation, 1)
    covariance = np.zeros_like(fisher)
    kept = np.ix_(~vanishing, ~vanishing)
    covariance[kept] = np.linalg.inv((correlation * scale)[kept])
    change = covariance @ (traces * np.log(powers / traces))
    change = np.clip(np.where(change < FAR_BELOW, 2 * change, change), -FURTHEST, FURTHEST)
    change[vanishing] = -FURTHEST
    score = powers - traces
    gained = score @ covariance @ score / 2 - np.sum(score[vanishing])
    deviations = [0.0, 0.0]
    errors: list[float | None] = [None, None]
    for place, level in enumerate(levels):
        deviations[level] = min(max(problem.fractions[level] * math.exp(change[place] / 2), LEAST), MOST)
        if not vanishing[place]:
            errors[level] = math.sqrt((1 + 1 / PROBES) * covariance[place, place]) / 2
    return Estimate((deviations[0], deviations[1]), (errors[0], errors[1]), bool(gained < SETTLED))


def _power(values: list[np.ndarray]) -> float:
    return float(sum(np.sum(np.abs(part) ** 2) for part in values))


class _Sequences:
    """The sequences A_k of errors of the sky model, where B_k = sqrt(D) A_k, in the unit of the data.

    They are (0) of each baseline by itself, (1) common to those of a model. `levels` are those that the prior has.
    """

    def __init__(self, problem: CalibrationProblem) -> None:
        structure = problem.structure
        self.levels = {"own": [0], "shared": [1], "both": [0, 1]}[structure.prior]
        self._deviations, self._conjugated = problem.deviations, structure.conjugated[:, None]
        self._models = [
            (np.flatnonzero(structure.groups == index), bucket.vectors)
            for bucket in structure.basis.buckets
            for index in bucket.members
        ]

    def coefficients(self, weighted: np.ndarray) -> list[list[np.ndarray]]:
        """Return A_k^T of values times D, (Nbls, Nfreqs), for each level k: an array for each model."""
        turned = np.where(self._conjugated, weighted.conj(), weighted)
        own = [turned[members] @ vectors for members, vectors in self._models]
        return [
            [self._deviations[level] * (part.sum(axis=0) if level else part) for part in own] for level in self.levels
        ]

    def draw(self, place: int, rng: np.random.Generator) -> np.ndarray:
        """Return A_k x of white x, E|x|^2 = 1, complex, (Nbls, Nfreqs), for the k at a place in `levels`."""
        level = self.levels[place]
        found = np.zeros((len(self._conjugated), len(self._models[0][1])), complex)
        for members, vectors in self._models:
            shape = (2, 1 if level else members.size, vectors.shape[1])
            real, imaginary = rng.standard_normal(shape) * (self._deviations[level] / math.sqrt(2))
            found[members] = (real + 1j * imaginary) @ vectors.T
        return np.where(self._conjugated, found.conj(), found)
