"""Loss, gradient, projection and Gauss-Newton matrix against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from toy import HEX, complex_normal, make_toy
from toy_structures import redundant_structure

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.problem import flag_weights, gain_products
from calstudy.calibrate.projection import Projector
from calstudy.calibrate.solvers import adamax
from calstudy.calibrate.solvers.adamax import FitData, Parameters
from calstudy.calibrate.tensors import FitTensors

TOLERANCE = {"single": 1e-6, "double": 1e-12}


@pytest.fixture(params=["per-baseline", "redundant", "autos"])
def case(request):
    """A problem with random flags and weights, random gains, and random coefficients of each bucket."""
    toy = make_toy(HEX, autos=request.param == "autos")
    structure = redundant_structure(toy) if request.param == "redundant" else toy.structure
    rng = np.random.default_rng(5)
    weights = flag_weights(rng.random(toy.foregrounds.shape) < 0.1) * rng.uniform(0.5, 2, toy.foregrounds.shape)
    problem = toy.problem(structure, weights=weights)
    coefficients = [complex_normal(rng, (b.members.size, b.vectors.shape[1])) for b in structure.basis.buckets]
    gains = 1 + 0.3 * complex_normal(rng, problem.initial_gains.shape)
    return problem, gains, coefficients


def numpy_model(structure, coefficients):
    models = np.empty((structure.basis.n_models, structure.n_frequencies), complex)
    for bucket, u in zip(structure.basis.buckets, coefficients, strict=True):
        models[bucket.members] = u @ bucket.vectors.T
    model = models[structure.groups]
    return np.where(structure.conjugated[:, None], model.conj(), model)


def numpy_loss(problem, gains, coefficients):
    """Paper Eq. LOGLIKELIHOOD / LOGLIKELIHOODREDUNDANT, and the prior on the summed model."""
    model = numpy_model(problem.structure, coefficients)
    data = problem.visibilities / np.where(
        problem.weights > 0, gain_products(problem.initial_gains, problem.structure.antennas), 1
    )
    residual = problem.visibilities - gain_products(gains, problem.structure.antennas) * model
    likelihood = np.sum(problem.weights * np.abs(residual) ** 2)
    return likelihood + np.abs(np.sum(problem.weights * (model - data))) ** 2


def tensor_problem(problem, gains, coefficients, precision):
    kernels = adamax.JointKernels(problem.structure, precision, "sum")
    measured, exact = (kernels.tensors.load(problem, dtype) for dtype in (kernels.dtype, tf.float64))
    target = pairs.to_pair(np.array(problem.prior_target / measured.scale), kernels.dtype)
    data = FitData(measured.visibilities, measured.weights, target, kernels.loss.summed(exact.weights))
    parameters = Parameters(
        pairs.to_pair(gains, kernels.dtype),
        tuple(pairs.to_pair(u / measured.scale, kernels.dtype) for u in coefficients),
    )
    return kernels, parameters, data, measured.scale


@pytest.mark.parametrize("precision", ["single", "double"])
def test_loss_is_the_papers_formula(case, precision):
    problem, gains, coefficients = case
    kernels, parameters, data, scale = tensor_problem(problem, gains, coefficients, precision)
    value = scale**2 * float(kernels.loss.value(parameters, data))
    assert value == pytest.approx(numpy_loss(problem, gains, coefficients), rel=TOLERANCE[precision])


def test_gradient_is_the_finite_difference(case):
    problem, gains, coefficients = case
    kernels, parameters, data, scale = tensor_problem(problem, gains, coefficients, "double")
    _, gradient = kernels.loss.value_and_gradient(parameters, data)
    rng = np.random.default_rng(6)
    step_gains = complex_normal(rng, gains.shape)
    step_coefficients = [scale * complex_normal(rng, u.shape) for u in coefficients]
    h = 1e-5

    def along(sign):
        moved = [u + sign * h * du for u, du in zip(coefficients, step_coefficients, strict=True)]
        return numpy_loss(problem, gains + sign * h * step_gains, moved) / scale**2

    slope = np.sum(gradient.gains * pairs.to_pair(step_gains, tf.float64))
    for part, step in zip(gradient.coefficients, step_coefficients, strict=True):
        slope += np.sum(part * pairs.to_pair(step / scale, tf.float64))
    assert slope == pytest.approx((along(1) - along(-1)) / (2 * h), rel=1e-7)


def dense_projection(problem, gains):
    """Foregrounds by dense weighted least squares, group by group."""
    structure = problem.structure
    products, model = gain_products(gains, structure.antennas), np.empty_like(problem.visibilities)
    basis = {int(member): bucket.vectors for bucket in structure.basis.buckets for member in bucket.members}
    for group in range(structure.basis.n_models):
        members = np.flatnonzero(structure.groups == group)
        turned = structure.conjugated[members, None]
        product = np.where(turned, products[members].conj(), products[members])
        visibility = np.where(turned, problem.visibilities[members].conj(), problem.visibilities[members])
        root = np.sqrt(problem.weights[members])
        matrix = ((root * product)[:, :, None] * basis[group]).reshape(-1, basis[group].shape[1])
        u = np.linalg.lstsq(matrix, (root * visibility).ravel(), rcond=None)[0]
        model[members] = np.where(turned, (basis[group] @ u).conj(), basis[group] @ u)
    return model


def reduced_loss(problem, gains):
    residual = problem.visibilities - gain_products(gains, problem.structure.antennas) * dense_projection(
        problem, gains
    )
    return np.sum(problem.weights * np.abs(residual) ** 2)


def test_projection_is_weighted_least_squares(case):
    problem, gains, _ = case
    tensors = FitTensors(problem.structure)
    data = tensors.load(problem, tf.float64)
    projector = Projector(problem.structure, tensors)
    projection = projector.project(pairs.to_pair(gains, tf.float64), data.visibilities, data.weights)
    model = dense_projection(problem, gains)
    used = problem.weights > 0
    difference = (tensors.unload(projection.model, data.scale) - model)[used]
    assert np.abs(difference).max() < 1e-9 * np.abs(model[used]).max()
    assert data.scale**2 * float(projection.loss) == pytest.approx(reduced_loss(problem, gains), rel=1e-9)


def test_descent_is_the_gradient_of_the_reduced_loss(case):
    problem, gains, _ = case
    tensors = FitTensors(problem.structure)
    data = tensors.load(problem, tf.float64)
    projector = Projector(problem.structure, tensors)
    projection = projector.project(pairs.to_pair(gains, tf.float64), data.visibilities, data.weights)
    eta = complex_normal(np.random.default_rng(7), gains.shape)
    slope = -2 * float(pairs.inner_product(projection.descent, pairs.to_pair(eta, tf.float64)))
    h = 1e-5
    difference = reduced_loss(problem, gains * (1 + h * eta)) - reduced_loss(problem, gains * (1 - h * eta))
    assert slope == pytest.approx(difference / (2 * h) / data.scale**2, rel=1e-6)


def residual_jacobian_product(problem, gains, eta):
    """Change of the weighted residual for gains (1 + eta), foregrounds following; by dense projection in NumPy."""
    structure = problem.structure
    products, model = gain_products(gains, structure.antennas), dense_projection(problem, gains)
    change = products * model * (eta[structure.antennas[:, 0]] + eta[structure.antennas[:, 1]].conj())
    shifted = type(problem)(structure, change, problem.weights, problem.initial_gains)
    return np.sqrt(problem.weights) * (change - products * dense_projection(shifted, gains))


def test_hessian_is_the_projected_jacobian_squared(case):
    problem, gains, _ = case
    tensors = FitTensors(problem.structure)
    data = tensors.load(problem, tf.float64)
    projector = Projector(problem.structure, tensors)
    projection = projector.project(pairs.to_pair(gains, tf.float64), data.visibilities, data.weights)
    rng = np.random.default_rng(8)
    eta, other = complex_normal(rng, gains.shape), complex_normal(rng, gains.shape)
    image = projector.hessian_product(pairs.to_pair(eta, tf.float32), projection)
    expected = np.vdot(residual_jacobian_product(problem, gains, other), residual_jacobian_product(problem, gains, eta))
    assert float(pairs.inner_product(pairs.to_pair(other, tf.float32), image)) == pytest.approx(
        expected.real / data.scale**2, abs=2e-5 * float(tf.norm(image)) * np.linalg.norm(other)
    )


def test_updates_are_those_of_keras():
    rng = np.random.default_rng(10)
    variable = tf.Variable(rng.standard_normal((2, 3, 4)))
    gradients = [tf.constant(rng.standard_normal((2, 3, 4))) for _ in range(5)]
    parameters = Parameters(tf.constant(variable.numpy()), ())
    zero = Parameters(tf.zeros_like(parameters.gains), ())
    moments = (zero, zero)
    optimizer = tf.keras.optimizers.Adamax(0.03)
    for count, gradient in enumerate(gradients, 1):
        optimizer.apply_gradients([(gradient, variable)])
        step = tf.constant(float(count), tf.float64)
        parameters, moments = adamax.update(0.03, step, parameters, moments, Parameters(gradient, ()))
    assert np.allclose(parameters.gains, variable, rtol=0, atol=1e-6)
