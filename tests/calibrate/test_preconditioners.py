"""Blocks and inverses of the preconditioners against the Gauss-Newton matrix itself, in NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toy import FREQUENCIES, HEX, complex_normal, make_toy
from toy_structures import redundant_structure

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.basis import gain_vectors
from calstudy.calibrate.problem import flag_weights
from calstudy.calibrate.projection import Projector
from calstudy.calibrate.solvers.preconditioners import (
    antenna_blocks,
    antenna_inverse,
    channel_inverse,
    conjugate_gradients,
    coordinate_inverse,
    coupled_blocks,
    coupled_inverse,
)
from calstudy.calibrate.tensors import FitTensors, GainSpace

DAMPING = 1e-4


def at_random_gains(problem, seed=9, dtype=tf.float32):
    """The projector, the projection at gains with errors, and those gains."""
    tensors = FitTensors(problem.structure)
    data = tensors.load(problem, tf.float64)
    projector = Projector(problem.structure, tensors, dtype, twice=dtype == tf.float64)
    gains = 1 + 0.2 * complex_normal(np.random.default_rng(seed), problem.initial_gains.shape)
    return projector, projector.project(pairs.to_pair(gains, tf.float64), data.visibilities, data.weights), gains


def hessian_block(projector, projection, antenna):
    """The block of one antenna, (Nfreqs, Nfreqs), column by column."""
    tensors = projector.tensors
    product = tf.function(projector.hessian_product)
    block = np.empty((tensors.n_frequencies, tensors.n_frequencies), complex)
    for channel in range(tensors.n_frequencies):
        eta = np.zeros((tensors.n_antennas, tensors.n_frequencies), complex)
        eta[antenna, channel] = 1
        block[:, channel] = pairs.to_complex(product(pairs.to_pair(eta, tf.float32), projection))[antenna]
    return block


def dense_preconditioner(blocks, antenna):
    """M of one antenna as a matrix, in the form with L (see the module)."""
    common, degrees = blocks.common.numpy().astype(float), blocks.degrees[antenna].numpy().astype(float)
    absorbed = blocks.absorbed[0, antenna].numpy() + 1j * blocks.absorbed[1, antenna].numpy()
    lift = degrees[:, None] * common @ np.linalg.inv(common.T @ (degrees[:, None] * common))
    return np.diag((1 + DAMPING) * degrees) - lift @ absorbed @ lift.T


@pytest.fixture(scope="module", params=["per-baseline", "few-at-once", "flagged"])
def blocks(request, toy):
    problem = toy.problem()
    if request.param == "few-at-once":
        problem = toy.problem(replace(toy.structure, models_at_once=5))
    if request.param == "flagged":
        rng = np.random.default_rng(3)
        flags = rng.random(toy.foregrounds.shape) < 0.1
        flags[:, 20:29] = True
        problem = toy.problem(weights=flag_weights(flags))
    projector, projection, gains = at_random_gains(problem)
    return projector, projection, gains, antenna_blocks(projector, projection)


@pytest.mark.chain
@pytest.mark.parametrize("antenna", [0, 7])
def test_blocks_are_those_of_the_hessian_on_the_common_basis(blocks, antenna):
    projector, projection, _, found = blocks
    common = found.common.numpy()
    expected = common.T @ hessian_block(projector, projection, antenna) @ common
    absorbed = found.absorbed[0, antenna].numpy() + 1j * found.absorbed[1, antenna].numpy()
    # Degrees are floored where the Gauss-Newton matrix is not, by 1e-4 of their mean.
    floored = np.abs(found.degrees.numpy() - found.degrees.numpy().min()) < 1e-12
    tolerance = 2e-4 if np.count_nonzero(floored) > 1 else 2e-6
    assert np.abs(found.gram[antenna].numpy() - absorbed - expected).max() < tolerance * np.abs(expected).max()


@pytest.mark.parametrize("antenna", [0, 7])
def test_inverse_is_that_of_the_dense_preconditioner(blocks, antenna):
    _, _, gains, found = blocks
    values = complex_normal(np.random.default_rng(4), gains.shape)
    solved = pairs.to_complex(antenna_inverse(found, tf.constant(DAMPING)).apply(pairs.to_pair(values, tf.float32)))
    matrix, result = dense_preconditioner(found, antenna), solved[antenna]
    # Of the size that float32 leaves in the product, not in the values: M is far from the identity.
    rounding = np.linalg.norm(matrix) * np.linalg.norm(result)
    assert np.linalg.norm(matrix @ result - values[antenna]) < 1e-6 * rounding


def test_preconditioned_blocks_are_nearly_one(blocks):
    projector, projection, _, found = blocks
    block, degrees = hessian_block(projector, projection, 3), found.degrees[3].numpy()
    # Where there are no data the floor of the degrees is all there is.
    block += np.diag(DAMPING * degrees + np.where(np.diag(block) == 0, degrees, 0))
    eigenvalues = np.linalg.eigvals(np.linalg.solve(dense_preconditioner(found, 3), block)).real
    plain = np.linalg.eigvals(block / ((1 + DAMPING) * degrees[:, None])).real
    assert eigenvalues.min() > 0.2
    assert eigenvalues.max() < 3
    assert plain.min() < 0.01


def test_inverse_for_smooth_gains_is_that_of_the_reduced_matrix(blocks):
    _, _, gains, found = blocks
    space = GainSpace(gain_vectors(FREQUENCIES, 100e-9), tf.float32)
    columns = space.columns(pairs.to_pair(gains, tf.float32))
    values = complex_normal(np.random.default_rng(5), (gains.shape[0], columns.shape[-1]))
    inverse = coordinate_inverse(found, columns, tf.constant(DAMPING))
    solved = pairs.to_complex(inverse.apply(pairs.to_pair(values, tf.float32)))
    for antenna in (0, 7):
        relative = space.vectors.numpy() / gains[antenna][:, None]
        reduced = relative.conj().T @ dense_preconditioner(found, antenna) @ relative
        assert np.abs(reduced @ solved[antenna] - values[antenna]).max() < 1e-3 * np.abs(values[antenna]).max()


def test_models_in_common_count_as_models_of_their_own(hexagon):
    structure = redundant_structure(hexagon)
    projector, projection, gains = at_random_gains(hexagon.problem(structure))
    found = antenna_blocks(projector, projection)
    (part,) = projection.parts
    model, curvature = pairs.to_complex(part.model), part.curvature.numpy()
    tensors, common = projector.tensors, projector.common.numpy()
    expected = np.zeros((gains.shape[0], common.shape[1], common.shape[1]), complex)
    roots = [
        root @ piece.span.numpy().T
        for piece, _, part in projector.of_pieces(projection)
        for root in projector.baseline_roots(piece, *part.roots).numpy()
    ]
    for p, (a, b) in enumerate(np.transpose(tensors.ends)):
        mixed = (curvature[p] * model[p])[:, None] * common
        block = (roots[p] @ mixed).conj().T @ (roots[p] @ mixed)
        expected[a] += block
        expected[b] += block.conj()
    absorbed = pairs.to_complex(found.absorbed)
    assert np.abs(absorbed - expected).max() < 1e-5 * np.abs(expected).max()


def test_channel_inverse_solves_for_gains_under_fixed_foregrounds(toy):
    projector, projection, gains = at_random_gains(toy.problem())
    eta = complex_normal(np.random.default_rng(6), gains.shape)
    inverse = channel_inverse(projector.tensors, projection, tf.constant(DAMPING))
    solved = pairs.to_complex(inverse.apply(pairs.to_pair(eta, tf.float32)))
    power, ends = projection.power().numpy(), np.array(projector.tensors.ends)
    change = power * gain_changes(projector.tensors, solved)
    image = np.zeros(gains.shape, complex)
    np.add.at(image, ends[0], change)
    np.add.at(image, ends[1], change.conj())
    degrees = np.zeros(gains.shape)
    for index in ends:
        np.add.at(degrees, index, power)
    image += DAMPING * degrees * solved
    # The common phase of each channel is lifted: it is compared without.
    image, wanted = (values - 1j * values.imag.mean(axis=0) for values in (image, eta))
    assert np.abs(image - wanted).max() < 2e-3 * np.abs(eta).max()


class Coupled:
    """The Gauss-Newton matrix in double precision, and the coupled blocks, on real and imaginary parts of the gains."""

    def __init__(self, problem):
        self.projector, self.projection, gains = at_random_gains(problem, dtype=tf.float64)
        product, shape = tf.function(self.projector.hessian_product), (2, *gains.shape)
        columns = [product(tf.reshape(row, shape), self.projection) for row in tf.eye(gains.size * 2, dtype=tf.float64)]
        self.hessian = np.array(columns).reshape(2 * gains.size, -1)
        self.blocks = coupled_blocks(self.projector, self.projection)
        self.ends, self.degrees = self.projector.tensors.ends, np.tile(self.blocks.degrees.numpy().ravel(), 2)
        self.common = np.kron(np.eye(2 * len(gains)), self.blocks.common.numpy())

    def inverse(self, damping):
        return by_columns(coupled_inverse(self.blocks, self.ends, damping), self.blocks.degrees.shape)


@pytest.fixture(scope="module", params=["per-baseline", "few-at-once"])
def coupled(request):
    small = make_toy(HEX[:5])
    structure = small.structure if request.param == "per-baseline" else replace(small.structure, models_at_once=3)
    return Coupled(small.problem(structure))


@pytest.mark.chain
def test_coupled_blocks_are_the_hessian_on_the_common_basis(coupled):
    expected = coupled.common.T @ coupled.hessian @ coupled.common
    found = coupled.blocks.matrix(coupled.ends)
    # Rounding of the largest values: both are differences of numbers of their size.
    assert np.abs(found - expected).max() < 1e-14 * np.abs(coupled.hessian).max()
    # The couplings between antennas are what the blocks of each antenna do not have.
    rows = len(expected) // len(coupled.blocks.degrees) // 2
    assert np.abs(found[:rows, rows : 2 * rows]).max() > 0.01 * np.abs(found).max()


def test_coupled_inverse_is_the_formula_of_the_module(coupled):
    """K^-1 + Q ((Q^T H Q)^-1 - (Q^T K Q)^-1) Q^T, damped, with the common phase of a channel no null."""
    n_antennas = len(coupled.blocks.degrees)
    damped, common = np.diag((1 + DAMPING) * coupled.degrees), coupled.common
    lift = coupled.blocks.degrees.numpy().mean(axis=0) / n_antennas
    phases = np.kron(np.diag([0.0, 1.0]), np.kron(np.ones((n_antennas, n_antennas)), np.diag(lift)))
    whole = common.T @ (coupled.hessian + DAMPING * np.diag(coupled.degrees) + phases) @ common
    expected = np.linalg.inv(damped)
    expected += common @ (np.linalg.inv(whole) - np.linalg.inv(common.T @ damped @ common)) @ common.T
    assert np.abs(coupled.inverse(DAMPING) - expected).max() < 1e-9 * np.abs(expected).max()


@pytest.mark.chain
def test_coupled_blocks_resolve_what_those_of_each_antenna_do_not(coupled):
    """Conjugate gradients with both, at a damping far below what single precision resolves."""
    rng, damping = np.random.default_rng(8), 1e-11
    matrix = coupled.hessian + damping * np.diag(coupled.degrees)
    descent = coupled.hessian @ rng.standard_normal(len(matrix))
    blocks = antenna_blocks(coupled.projector, coupled.projection)
    own = by_columns(antenna_inverse(blocks, tf.constant(damping, tf.float64)), blocks.degrees.shape)
    left = [unsolved(matrix, inverse, descent) for inverse in (coupled.inverse(damping), own)]
    assert left[0] < 1e-5
    assert left[1] > 100 * left[0]


def test_blocks_that_rounding_has_left_indefinite_are_no_error(coupled):
    broken = coupled.blocks._replace(alike=-coupled.blocks.alike)
    assert np.isnan(coupled_inverse(broken, coupled.ends, DAMPING).factor.numpy()).all()


def by_columns(inverse, shape):
    apply, size = tf.function(inverse.apply), 2 * np.prod(shape)
    columns = [apply(tf.reshape(row, (2, *shape))) for row in tf.eye(size, dtype=tf.float64)]
    return np.array(columns).reshape(size, size).T


def unsolved(matrix, inverse, descent):
    """What 30 iterations of conjugate gradients leave of the right side, relative to it."""

    def product(array):
        return lambda values: tf.linalg.matvec(tf.constant(array), values)

    arguments = tf.constant(descent), tf.constant(0.0, tf.float64), tf.constant(30)
    found, _ = conjugate_gradients(product(matrix), product(inverse), *arguments)
    return np.linalg.norm(descent - matrix @ found.numpy()) / np.linalg.norm(descent)


def gain_changes(tensors, eta):
    return eta[tensors.ends.first.numpy()] + eta[tensors.ends.second.numpy()].conj()
