"""Compare `gpu_loop` with calstudy: loss, gradient and Gauss-Newton product on the same data, and times in turn.

It needs calstudy with TensorFlow, and JAX, in one environment:

    taskset -c 0 python benchmarks/gpu_loop_check.py             # the paper's array on one core

Times are processor seconds, of alternating calls in one process.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import gpu_loop
import jax
import jax.numpy as jnp
import numpy as np

from calstudy.base.tensorflow import tf
from calstudy.calibrate import pairs
from calstudy.calibrate.problem import CalibrationProblem
from calstudy.calibrate.projection import Projection
from calstudy.calibrate.solvers.adamax import STEPS_PER_CALL, Adamax, FitData, JointKernels, Parameters
from calstudy.calibrate.solvers.reduced import ReducedKernels, as_graph
from calstudy.calibrate.synthetic import Case, Simulation
from calstudy.products.step_times import PaperStep

ROUNDS = 15


def make_problem(antennas: int, channels: int) -> CalibrationProblem:
    """Return one synthetic integration of antennas at random."""
    simulation = Simulation(Case(antennas=antennas, channels=channels))
    return simulation.problem(0, simulation.structure())


def fit_of(kernels: JointKernels, data: FitData) -> gpu_loop.Fit:
    """Return the same integration for `gpu_loop`."""
    tensors = kernels.tensors
    sizes = [last - first for first, last in tensors.slices]
    ends = (index.numpy() for index in tensors.ends)
    return gpu_loop.Fit(
        tensors.n_antennas, *ends, tensors.bases, sizes, data.visibilities.numpy(), data.weights.numpy()
    )


def normal_data(kernels: ReducedKernels, projection: Projection) -> list[Any]:
    """Return the data of `gpu_loop.normal_product` at a projection."""
    found = []
    for piece, _, part in kernels.projector.of_pieces(projection):
        ends = kernels.tensors.ends.slice(*piece.batch.baselines)
        arrays = (part.curvature, part.model, piece.span, part.roots[0].first)
        found.append(
            (tuple(jnp.asarray(index.numpy()) for index in ends), *(jnp.asarray(one.numpy()) for one in arrays))
        )
    return found


def compare_values(precision: str) -> None:
    """Print the relative differences of losses, gradients and products."""
    dtype = {"single": "float32", "double": "float64"}[precision]
    problem = make_problem(12, 96)
    kernels = JointKernels(problem.structure, gpu_loop.LEARNING_RATE, precision, problem.prior)
    parameters, data, _ = kernels.load(problem, problem.initial_gains)
    change = 0.1 * np.random.default_rng(5).standard_normal(parameters.gains.shape)
    # At the start the gradient of the coefficients is nearly zero.
    parameters = Parameters(parameters.gains + tf.constant(change, parameters.gains.dtype), parameters.coefficients)
    value, gradient = kernels.loss.value_and_gradient(parameters, data)
    fit = fit_of(kernels, data)
    for name, make, step in (
        ("buckets", gpu_loop.bucket_problem, gpu_loop.bucket_step),
        ("padded", gpu_loop.padded_problem, gpu_loop.padded_step),
    ):
        (_, coefficients), arrays = make(fit, dtype)
        loss, (of_gains, found) = jax.jit(step)((jnp.asarray(parameters.gains.numpy()), coefficients), arrays)
        expected = np.concatenate([part.numpy().reshape(-1) for part in gradient.coefficients])
        parts = found if name == "buckets" else _unpadded(np.asarray(found), fit)
        actual = np.concatenate([np.asarray(part).reshape(-1) for part in parts])
        print(
            f"{name}, {dtype}: loss {relative(loss, value.numpy()):.1e}, gradient of gains "
            f"{relative(of_gains, gradient.gains.numpy()):.1e}, of coefficients {relative(actual, expected):.1e}"
        )
    reduced = ReducedKernels(problem.structure, dtype=tf.as_dtype(dtype))
    start = reduced.reduce(problem, problem.initial_gains)
    projection = reduced.project(start.gains, *start.data)
    eta = np.random.default_rng(6).standard_normal(start.gains.shape).astype(dtype)
    expected = reduced.projector.hessian_product(tf.constant(eta), projection).numpy()
    actual = jax.jit(gpu_loop.normal_product)(jnp.asarray(eta), normal_data(reduced, projection))
    print(f"normal, {dtype}: product {relative(actual, expected):.1e}")


def _unpadded(coefficients: np.ndarray, fit: gpu_loop.Fit) -> list[np.ndarray]:
    """Return (2, N, Nvec) of each basis, for coefficients (2, Nvec, Nbls)."""
    edges = fit.edges
    return [
        coefficients[:, : basis.shape[1], edges[number] : edges[number + 1]].transpose(0, 2, 1)
        for number, basis in enumerate(fit.bases)
    ]


def relative(actual: Any, expected: Any) -> float:
    """Return |actual - expected| / |expected|."""
    difference = np.asarray(actual, float) - np.asarray(expected, float)
    return float(np.linalg.norm(difference) / np.linalg.norm(expected))


def compare_times(antennas: int, channels: int) -> None:
    """Print medians of processor time for each step, of both programs in turn."""
    problem = make_problem(antennas, channels)
    adamax = Adamax(max_steps=10**6, tolerance=0.0)
    state = adamax.init(problem)
    paper = PaperStep(problem)
    fit = fit_of(state.kernels, state.data)
    reduced = ReducedKernels(problem.structure)
    start = reduced.reduce(problem, problem.initial_gains)
    projection = reduced.project(start.gains, *start.data)
    eta = pairs.to_pair(np.random.default_rng(6).standard_normal((antennas, channels)) + 0j, tf.float32)
    product = as_graph(reduced.projector.hessian_product)
    calls: dict[str, tuple[Callable[[], object], int]] = {
        "buckets, calstudy": (lambda: adamax.step(state), STEPS_PER_CALL),
        "padded, calstudy": (lambda: float(paper.step()), 1),
        "normal, calstudy": (lambda: product(eta, projection).numpy(), 1),
    }
    for kernel in gpu_loop.KERNELS:
        calls[f"{kernel}, JAX"] = (_jax_call(kernel, fit), gpu_loop.STEPS)
    samples: dict[str, list[float]] = {name: [] for name in calls}
    for number in range(-1, ROUNDS):
        for name, (call, steps) in calls.items():
            used = time.process_time()
            call()
            if number >= 0:
                samples[name].append(1e3 * (time.process_time() - used) / steps)
    print(f"{antennas} antennas, {channels} channels, processor time of a step, ms")
    for name, values in sorted(samples.items()):
        low, median, high = np.quantile(values, [0.1, 0.5, 0.9])
        print(f"{name}: {median:.2f} (80 % within {low:.2f} to {high:.2f})")


def _jax_call(kernel: str, fit: gpu_loop.Fit) -> Callable[[], object]:
    loop, state, data = gpu_loop.prepare(kernel, fit, "float32", gpu_loop.STEPS)
    compiled = jax.jit(loop).lower(state, data).compile()
    return lambda: jax.block_until_ready(compiled(state, data))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--antennas", type=int, default=36)
    parser.add_argument("--channels", type=int, default=384)
    parser.add_argument("--values", action="store_true", help="compare values only")
    arguments = parser.parse_args()
    compare_values("single")
    compare_values("double")
    if not arguments.values:
        compare_times(arguments.antennas, arguments.channels)
