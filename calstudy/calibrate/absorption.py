"""How much of a small signal a calibration is expected to leave, from the fit alone.

At the minimum of the likelihood, a small change of the data changes gains and foregrounds to first order, and the
residual by the part of the change that neither can follow: whitened by the root of D = w |g_a g_b*|^2, its projection
onto the complement of the tangent space of the fit. A white signal, the same in all visibilities, therefore keeps the
fraction

    T(p, tau) = 1 - <f|P|f> / <f|f>

of its power on baseline p at delay tau, f being the tapered delay mode and P the projector on the tangent space. P is
the sum of two: the projector on the foreground sequences, which is known in closed form for each baseline, and the one
on what the gains can do that foregrounds cannot, Z = (1 - P_F) J with the Jacobian J of the gains. The matrices are
real, because gains enter with their conjugates: data and gains count as twice as many real numbers, and <f|P|f> is the
mean over the two phases of the mode. What gains of per-channel freedom absorb far from the modelled delays is their
share of the degrees of freedom, (2 N - 1) / (N (N - 1)).

The second part is exact from a dense decomposition for small arrays. For others it is a stochastic diagonal: for white
noise x with <|x|^2> = 1, the mean of |f* P x|^2 is <f|P|f>, and P x costs one linear solve.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calstudy.calibrate.probing import probe
from calstudy.calibrate.problem import CalibrationProblem
from calstudy.calibrate.solvers.gauss_newton import DAMPING_BOUNDS
from calstudy.calibrate.solvers.preconditioners import DEGREE_FLOOR
from calstudy.calibrate.tangent import DelayModes, Tangent

# Elements of the dense Jacobian up to which the exact diagonal is offered.
DENSE = 3e7


@dataclass(frozen=True)
class ExpectedTransfer:
    """The fraction of a white signal's power that a fit leaves.

    Attributes
    ----------
    delay
        Ascending, s, (Ndelays,).
    transfer
        T, (Nbls, Ndelays); NaN for baselines without data.
    error
        Standard deviation of the stochastic estimate, of the same shape; zero if it is exact.
    foregrounds, gains
        What each of them absorbs, of the same shape; the three add up to one.
    """

    delay: np.ndarray = field(metadata={"unit": "s"})
    transfer: np.ndarray = field(metadata={"unit": ""})
    error: np.ndarray = field(metadata={"unit": ""})
    foregrounds: np.ndarray = field(metadata={"unit": ""})
    gains: np.ndarray = field(metadata={"unit": ""})


def expected_transfer(
    problem: CalibrationProblem,
    gains: np.ndarray,
    model: np.ndarray,
    modes: DelayModes,
    probes: int | None = None,
    seed: int = 0,
) -> ExpectedTransfer:
    """Return what a fit is expected to leave of a white signal, for every baseline and delay.

    Parameters
    ----------
    problem
        What was fitted.
    gains, model
        The solution, (Nants, Nfreqs) and (Nbls, Nfreqs), complex.
    modes
        The delay modes of its channels.
    probes
        Number of random vectors; None for the exact diagonal.
    seed
        Of the random vectors.

    Raises
    ------
    ValueError
        If the exact diagonal of a large problem is asked for, or fewer than two probes.
    """
    tangent = Tangent.at(problem, gains, model)
    used = tangent.roots > 0
    norm = np.sum(modes.weights**2 * used, axis=1)[:, None]
    if probes is None:
        by_gains, error = _exact(problem, gains, tangent, modes), np.zeros((len(norm), modes.delay.size))
    else:
        by_gains, error = probe(problem, gains, tangent, modes, probes, seed)
    norm = np.where(norm > 0, norm, np.nan)
    foregrounds, by_gains, error = tangent.absorbed(modes) / norm, by_gains / norm, error / norm
    return ExpectedTransfer(modes.delay, 1 - foregrounds - by_gains, error, foregrounds, by_gains)


def jacobian_size(problem: CalibrationProblem) -> int:
    """Return the number of elements of the dense Jacobian of the gains."""
    structure = problem.structure
    n_gains = structure.n_frequencies if structure.gain_vectors is None else structure.gain_vectors.shape[1]
    return 4 * structure.n_baselines * structure.n_frequencies * structure.n_antennas * n_gains


def _exact(problem: CalibrationProblem, gains: np.ndarray, tangent: Tangent, modes: DelayModes) -> np.ndarray:
    """Return <f|P|f> of the gains, (Nbls, Ndelays), from dense matrices."""
    if jacobian_size(problem) > DENSE:
        raise ValueError(
            f"the exact transfer of {problem.structure.n_antennas} antennas and {problem.structure.n_frequencies} "
            "channels needs too large a matrix; use random probes"
        )
    jacobian, degrees = _jacobian(problem, gains, tangent)
    normal = jacobian.T @ jacobian
    inverse = np.linalg.inv(normal + np.diag(DAMPING_BOUNDS[0] * degrees))
    # The damped projector is one but for directions of next to no curvature; its square is what the probes measure.
    kernel = inverse @ normal @ inverse
    n_baselines, n_frequencies = tangent.roots.shape
    rows = jacobian.reshape(2, n_baselines, n_frequencies, -1)
    found = np.empty((n_baselines, modes.delay.size))
    for p in range(n_baselines):
        real, imaginary = (modes.amplitudes(part[p].T) for part in rows)
        # Re and Im of f* x are two real functionals of the real and imaginary parts of x.
        first, second = real.real - imaginary.imag, real.imag + imaginary.real
        found[p] = sum(np.einsum("ud,uv,vd->d", part, kernel, part, optimize=True) for part in (first, second)) / 2
    return found


def _jacobian(problem: CalibrationProblem, gains: np.ndarray, tangent: Tangent) -> tuple[np.ndarray, np.ndarray]:
    """Return Z, (2 Nbls Nfreqs, unknowns), real and imaginary parts stacked, and the diagonal that damping scales."""
    structure, shape = problem.structure, tangent.slope.shape
    n_antennas, n_frequencies = structure.n_antennas, structure.n_frequencies
    directions = np.eye(n_frequencies) if structure.gain_vectors is None else structure.gain_vectors
    columns, power = [], np.abs(tangent.slope) ** 2
    degrees = np.zeros((n_antennas, n_frequencies))
    for column in structure.antennas.T:
        np.add.at(degrees, column, power)
    degrees = np.maximum(degrees, DEGREE_FLOOR * degrees.mean())
    diagonal = []
    for turn in (1, 1j):
        for antenna in range(n_antennas):
            relative = turn * directions / (1 if structure.gain_vectors is None else gains[antenna][:, None])
            change = np.zeros((*shape, directions.shape[1]), complex)
            for side, column in enumerate(structure.antennas.T):
                rows = column == antenna
                change[rows] += tangent.slope[rows][:, :, None] * (relative.conj() if side else relative)
            columns.append(tangent.free_of_foregrounds(change).reshape(-1, directions.shape[1]))
            diagonal.append(np.sum(degrees[antenna][:, None] * np.abs(relative) ** 2, axis=0))
    whole = np.concatenate(columns, axis=1)
    return np.concatenate([whole.real, whole.imag]), np.concatenate(diagonal)
