"""Predict the fraction of a small signal that a calibration preserves, from the fit alone.

At the minimum of the likelihood sum w |V - g_a g_b* F|^2, let J be the Jacobian of the model g_a g_b* F in all
unknowns, gains and coefficients of the foregrounds, times sqrt(w) and free of the phases of g_a g_b*. A small signal s
in the calibrated visibilities changes the data by y = sqrt(D) s in the same unit, with D = w |g_a g_b*|^2. To first
order, in the Gauss-Newton approximation, the unknowns change by (J^T J)^-1 J^T y, and the residual by

    y - P y,   P = J (J^T J)^-1 J^T,

the part of y that is orthogonal to the tangent space of the fit, P being the projector on that. A signal with white y
therefore keeps the fraction

    T(p, tau) = <|f* (1 - P) y|^2> / <|f* y|^2> = 1 - <f|P|f> / <f|f>

of its power on baseline p at delay tau, where f is the tapered delay mode. All matrices are real, because gains enter
with their conjugates: data and unknowns count as twice as many real numbers, and <f|P|f> is the mean over the two
phases of the mode.

P is the sum of two projectors. P_F projects on the foreground sequences, weighted by sqrt(D), and is known in closed
form for each baseline or group. The other projects on changes of the gains that foregrounds cannot follow, the span of
Z = (1 - P_F) J_g with the Jacobian J_g of the gains. Far from the modelled delays, gains that are free in every channel
absorb their share of the degrees of freedom, (2 N - 1) / (N (N - 1)) for N antennas.

With a finite prior, the foregrounds respond to y with the smoother B (1 + B^T B)^-1 B^T = 1 - W, where B = sqrt(D) A
are their sequences for coefficients of unit variance. W takes the place of 1 - P_F, but is no projector. The residual
is

    M y,   M = W - W J_g (J_g^T W J_g)^-1 J_g^T W,   T = <f|M^2|f> / <f|f>.

Gains absorb <f|W^2 - M^2|f>. For an infinite prior this is <f|P|f> of their projector.

The second part is exact from a dense decomposition for small arrays. For others it is a stochastic diagonal (Hutchinson
1990, Commun. Stat. Simul. Comput. 19, 433; Bekas, Kokiopoulou & Saad 2007, Appl. Numer. Math. 57, 1214), here in the
basis of the delay modes: for white noise x with <x x*> = 1, the mean of |f* P x|^2 is <f|P P|f> = <f|P|f>, that of |f*
W x|^2 - |f* M x|^2 is <f|W^2 - M^2|f>, and P x or M x cost one solve of the normal equations of the reduced problem
(`calstudy.calibrate.solvers.reduced`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.basis import channel_grid
from calstudy.calibrate.problem import CalibrationProblem, sum_by_antenna
from calstudy.calibrate.solvers.preconditioners import DEGREE_FLOOR, Inverse, channel_inverse
from calstudy.calibrate.solvers.reduced import FINITE, FREE, NormalEquations, compiled
from calstudy.calibrate.tangent_space import TangentSpace
from calstudy.power.delay import make_taper

TAPER = "blackman-harris"
# Largest number of elements of the dense Jacobian for the exact diagonal.
DENSE = 3e7
CG_TOLERANCE, CG_ITERATIONS = 1e-5, 500


class DelayModes:
    """Tapered delay modes of a band, with or without gaps.

    Channel centres are on an even grid, Hz, (Nfreqs,); tapers are those of `calstudy.power.delay.TAPERS`.
    """

    def __init__(self, frequency: np.ndarray, taper: str = TAPER) -> None:
        grid = channel_grid(np.asarray(frequency, float))
        self._grid = grid
        self.delay = np.fft.fftshift(np.fft.fftfreq(grid.n_channels, grid.width))
        self.weights = make_taper(taper, grid.n_channels)[grid.positions]

    def amplitudes(self, values: np.ndarray) -> np.ndarray:
        """Compute f* values for every delay: frequency is the last axis, (..., Nfreqs) to (..., Ndelays)."""
        transformed = np.fft.ifft(self._grid.filled(values * self.weights), axis=-1, norm="forward")
        return np.fft.fftshift(transformed, axes=-1)


@dataclass(frozen=True)
class ExpectedTransfer:
    """The fraction of a white signal's power that a fit preserves, at ascending delays, s, (Ndelays,).

    `transfer` is T, (Nbls, Ndelays), NaN for baselines without data, and `error` its standard deviation, zero if it is
    exact. T and the fractions that foregrounds and gains absorb add up to one.
    """

    delay: np.ndarray = field(metadata={"unit": "s"})
    transfer: np.ndarray = field(metadata={"unit": ""})
    error: np.ndarray = field(metadata={"unit": ""})
    foregrounds: np.ndarray = field(metadata={"unit": ""})
    gains: np.ndarray = field(metadata={"unit": ""})


def expected_transfer(
    problem: CalibrationProblem, gains: np.ndarray, model: np.ndarray, modes: DelayModes, probes: int | None = None
) -> ExpectedTransfer:
    """Predict the fraction of a white signal that a fit preserves, for every baseline and delay.

    The solution of the fitted problem is complex, (Nants, Nfreqs) and (Nbls, Nfreqs); `modes` are those of its
    channels. `probes` is the number of random vectors, None for the exact diagonal. Raises ValueError if the latter is
    requested for a large problem, or fewer than two probes.
    """
    tangent = TangentSpace.at(problem, gains, model)
    used = tangent.roots > 0
    norm = np.sum(modes.weights**2 * used, axis=1)[:, None]
    if probes is None:
        by_gains, error = _exact_diagonal(problem, gains, tangent, modes), np.zeros((len(norm), modes.delay.size))
    else:
        by_gains, error = _stochastic_diagonal(problem, gains, tangent, modes, probes)
    norm = np.where(norm > 0, norm, np.nan)
    foregrounds, by_gains, error = _foreground_diagonal(tangent, modes) / norm, by_gains / norm, error / norm
    return ExpectedTransfer(modes.delay, 1 - foregrounds - by_gains, error, foregrounds, by_gains)


def _foreground_diagonal(tangent: TangentSpace, modes: DelayModes) -> np.ndarray:
    """Return <f|1 - W^2|f> of the unnormalized modes f, (Nbls, Ndelays); <f|P_F|f> if foregrounds are free."""
    found = np.zeros((len(tangent.roots), modes.delay.size))
    for response in tangent.responses:
        sequences, common = response.sequences, response.common
        spectra = modes.amplitudes(np.swapaxes(sequences, 1, 2))
        power = np.sum(np.abs(spectra) ** 2, axis=1)
        if tangent.finite:
            products = np.swapaxes(sequences, 1, 2) @ sequences
            # The common sequences reach from one baseline to the others.
            last = slice(-common.shape[2], None)
            products[:, last, last] = np.einsum("pfv,pfu->vu", common, common, optimize=True)
            power = 2 * power - np.einsum("pvd,pvu,pud->pd", spectra.conj(), products, spectra, optimize=True).real
        found[response.members] = power
    return found


def jacobian_size(problem: CalibrationProblem) -> int:
    """Return the number of elements of the dense Jacobian of the gains."""
    structure = problem.structure
    n_gains = structure.n_frequencies if structure.gain_vectors is None else structure.gain_vectors.shape[1]
    return 4 * structure.n_baselines * structure.n_frequencies * structure.n_antennas * n_gains


def _exact_diagonal(
    problem: CalibrationProblem, gains: np.ndarray, tangent: TangentSpace, modes: DelayModes
) -> np.ndarray:
    """Compute <f|P|f> of the gains, (Nbls, Ndelays), from dense matrices."""
    if jacobian_size(problem) > DENSE:
        raise ValueError(
            f"the exact transfer of {problem.structure.n_antennas} antennas and {problem.structure.n_frequencies} "
            "channels needs too large a matrix; use random probes"
        )
    jacobian, degrees = _jacobian(problem, gains, tangent)
    left = tangent.without_foregrounds(jacobian)
    again = tangent.without_foregrounds(left) if tangent.finite else None
    # The damped projector is one but for directions of next to no curvature; its square is what the probes measure.
    least = (FINITE if tangent.finite else FREE)[tf.float32].least
    inverse = np.linalg.inv(_real_product(jacobian, left) + np.diag(least * degrees))
    kernel = inverse @ _real_product(left, left) @ inverse
    found = np.empty((len(left), modes.delay.size))
    for p in range(len(left)):
        # Re and Im of f* x are two real functionals of the real and imaginary parts of x.
        once = modes.amplitudes(left[p].T)
        found[p] = _quadratic_form(once, kernel, once) / 2
        if again is not None:
            found[p] = _quadratic_form(modes.amplitudes(again[p].T), inverse, once) - found[p]
    return found


def _real_product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return Re(first^H second) over baselines and channels, for columns (Nbls, Nfreqs, unknowns)."""
    first, second = first.reshape(-1, first.shape[-1]), second.reshape(-1, second.shape[-1])
    return first.real.T @ second.real + first.imag.T @ second.imag


def _quadratic_form(first: np.ndarray, matrix: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return Re sum_uv first_u* matrix_uv second_v for each delay; amplitudes are (unknowns, Ndelays)."""
    return np.sum((first.conj() * (matrix @ second)).real, axis=0)


def _jacobian(problem: CalibrationProblem, gains: np.ndarray, tangent: TangentSpace) -> tuple[np.ndarray, np.ndarray]:
    """Return J_g, complex, (Nbls, Nfreqs, unknowns), and the diagonal that damping scales."""
    structure, shape = problem.structure, tangent.slope.shape
    n_antennas, n_frequencies = structure.n_antennas, structure.n_frequencies
    directions = np.eye(n_frequencies) if structure.gain_vectors is None else structure.gain_vectors
    degrees = sum_by_antenna(np.abs(tangent.slope) ** 2, structure.antennas, n_antennas)
    degrees = np.maximum(degrees, DEGREE_FLOOR * degrees.mean())
    columns, diagonal = [], []
    for turn in (1, 1j):
        for antenna in range(n_antennas):
            relative = turn * directions / (1 if structure.gain_vectors is None else gains[antenna][:, None])
            change = np.zeros((*shape, directions.shape[1]), complex)
            for side, column in enumerate(structure.antennas.T):
                rows = column == antenna
                change[rows] += tangent.slope[rows][:, :, None] * (relative.conj() if side else relative)
            columns.append(change)
            diagonal.append(np.sum(degrees[antenna][:, None] * np.abs(relative) ** 2, axis=0))
    return np.concatenate(columns, axis=2), np.concatenate(diagonal)


class GainResponse:
    """The linear response of the gains to a change of the data, at a solution, (Nants, Nfreqs), complex.

    `tolerance` is the relative residual of the normal equations, `dtype` the precision of their products.
    """

    def __init__(
        self,
        problem: CalibrationProblem,
        gains: np.ndarray,
        tolerance: float = CG_TOLERANCE,
        dtype: tf.DType = tf.float32,
    ) -> None:
        self._tolerance = tolerance
        self._kernels = kernels = compiled(problem.structure, problem.frozen, dtype)
        self._antennas, self._shape = problem.structure.antennas.T, gains.shape
        reduced = kernels.reduce(problem, gains)
        self._unit, self._total = reduced.loss_unit, float(np.sum(problem.weights))
        projection = kernels.project(reduced.gains, *reduced.data)
        stronger = kernels.scalar(kernels.dampings.preconditioner)
        if kernels.by_channel:
            inverse: Inverse = channel_inverse(kernels.tensors, projection, stronger)
        else:
            inverse = kernels.inverse(kernels.blocks(projection), stronger, reduced.gains)
        damping = kernels.scalar(kernels.dampings.least)
        self._equations = NormalEquations(projection, reduced.gains, damping, inverse)

    def left_of(self, difference: np.ndarray) -> np.ndarray:
        """Return the rest of a difference of calibrated data after a fit of gains and foregrounds, times D.

        Both are complex, (Nbls, Nfreqs).
        """
        tensors, unit = self._kernels.tensors, float(np.sqrt(np.mean(np.abs(difference) ** 2)))
        loaded = tensors.load_model(difference, unit, self._kernels.dtype)
        left = self._kernels.left_of(self._equations, loaded, self._tolerance, CG_ITERATIONS)
        return tensors.unload(left, unit * self._total)

    def change(self, tangent: TangentSpace, left: np.ndarray) -> np.ndarray:
        """Return the relative change of g_a g_b* that W y causes, (Nbls, Nfreqs)."""
        first, second = self._antennas
        gradient = tangent.slope.conj() * left
        descent = np.zeros(self._shape, complex)
        np.add.at(descent, first, gradient)
        np.add.at(descent, second, gradient.conj())
        # Inside the kernels the loss has the weighted square of the data for a unit.
        right_side = pairs.to_pair(descent / self._unit, self._kernels.dtype)
        eta, _ = self._kernels.solve_graph(self._equations, right_side, self._tolerance, CG_ITERATIONS)
        change = pairs.to_complex(eta)
        return change[first] + change[second].conj()

    def absorbed(self, tangent: TangentSpace, left: np.ndarray) -> np.ndarray:
        """Return the part of W y that gains absorb, less the foregrounds' response to it, (Nbls, Nfreqs)."""
        return tangent.without_foregrounds(tangent.slope * self.change(tangent, left))


def linear_response(
    problem: CalibrationProblem, gains: np.ndarray, model: np.ndarray, signal: np.ndarray
) -> np.ndarray:
    """Compute the residual of a small signal after calibration, to first order.

    It is the difference of the residuals of two fits, of data with the signal and without, if both are at the minimum;
    it does not depend on where these start and stop. Single precision does not resolve it where foregrounds nearly
    follow the gains. It is complex, (Nbls, Nfreqs), and zero for samples without weight where foregrounds are fitted.
    Where they are the sky model, the residual has these samples too.

    The solution is complex, (Nants, Nfreqs) and (Nbls, Nfreqs); the signal is like the model and in its unit.
    """
    tangent, response = TangentSpace.at(problem, gains, model), GainResponse(problem, gains, dtype=tf.float64)
    left = tangent.without_foregrounds(tangent.roots * signal)
    if problem.frozen:
        return signal - model * response.change(tangent, left)
    left = left - response.absorbed(tangent, left)
    return np.divide(left, tangent.roots, out=np.zeros(left.shape, complex), where=tangent.roots > 0)


def _stochastic_diagonal(
    problem: CalibrationProblem, gains: np.ndarray, tangent: TangentSpace, modes: DelayModes, probes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate <f|P|f> of the gains and its standard deviation, (Nbls, Ndelays) each.

    Raises ValueError for fewer than two probes, which give no error.
    """
    if probes < 2:
        raise ValueError(f"probes: {probes}, at least 2 are needed")
    response, rng = GainResponse(problem, gains), np.random.default_rng(0)
    shape, used = tangent.slope.shape, tangent.roots > 0
    sums = np.zeros((2, shape[0], modes.delay.size))
    for _ in range(probes):
        noise = used * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)
        left = tangent.without_foregrounds(noise)
        amplitudes = modes.amplitudes(response.absorbed(tangent, left))
        power = np.abs(amplitudes) ** 2
        if tangent.finite:
            power = 2 * np.real(modes.amplitudes(left).conj() * amplitudes) - power
        sums += power, power**2
    mean, square = sums / probes
    return mean, np.sqrt(np.maximum(square - mean**2, 0) / (probes - 1))
