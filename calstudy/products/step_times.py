"""Times of steps and solves of one array: ``python -m calstudy.products.step_times``, started by `run_times`."""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from calstudy.base.resources import Usage, resident_memory
from calstudy.base.tensorflow import tf
from calstudy.calibrate.problem import CalibrationProblem, FitStructure
from calstudy.calibrate.solvers.adamax import STEPS_PER_CALL, Adamax
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve
from calstudy.calibrate.synthetic import Case, Simulation
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.settings import Channels, Layout
from calstudy.products.run_times import TimedArray

ROUNDS = 10
"""Number of rounds in which the samples of all solvers are taken, so that other load affects all of them equally."""
FLOOR_TOLERANCE, FLOOR_STEPS = 1e-5, 200
SETTLED = 0.5
"""Duration of warm-up steps, seconds."""

LEARNING_RATE = 0.01
"""Of the paper's solver."""

Clock = Callable[[], float]


class PaperStep:
    """One Adamax step in the form of the paper's own code: the unknowns of a problem, and the graph of a step.

    All baselines share one basis tensor padded with zeros to the widest (Nvec, Nbls, 1, Nfreqs); the model is a
    broadcast product summed over the first axis; real and imaginary parts are separate; the optimizer is Keras'
    Adamax; single precision. The step is one TensorFlow graph, written from the paper's equations and description. It
    takes as long as the loss function of the authors' code with the same optimizer (benchmarks/README.md).

    The start is at unity gains and at the foregrounds of an unweighted least-squares fit.
    """

    def __init__(self, problem: CalibrationProblem) -> None:
        structure = problem.structure
        buckets = structure.basis.buckets
        widest = max(bucket.vectors.shape[1] for bucket in buckets)
        basis = np.zeros((widest, structure.n_baselines, structure.n_frequencies))
        for bucket in buckets:
            basis[: bucket.vectors.shape[1], bucket.members] = bucket.vectors.T[:, None]
        scale = np.sqrt(np.mean(np.abs(problem.visibilities) ** 2))
        data = problem.visibilities / scale
        coefficients = np.einsum("kbf,bf->kb", basis, data)[:, :, None, None]
        self._basis = tf.constant(basis[:, :, None], tf.float32)
        self._first = tf.constant(structure.antennas[:, :1], tf.int32)
        self._second = tf.constant(structure.antennas[:, 1:], tf.int32)
        self._data = [tf.constant(part[:, None], tf.float32) for part in (data.real, data.imag)]
        self._weights = tf.constant(problem.weights[:, None], tf.float32)
        self._target = [tf.reduce_sum(part * self._weights) for part in self._data]
        shape = (structure.n_antennas, structure.n_frequencies)
        start = (np.ones(shape), np.zeros(shape), coefficients.real, coefficients.imag)
        self.variables = [tf.Variable(values, dtype=tf.float32) for values in start]
        self._optimizer = tf.keras.optimizers.Adamax(LEARNING_RATE)
        self._optimizer.build(self.variables)
        self.step = tf.function(self._step)
        self.model_sum = tf.function(self._model_sum)

    @property
    def basis_bytes(self) -> int:
        """Size of the padded basis, the paper's A."""
        return 4 * int(tf.size(self._basis))

    def _model_sum(self) -> tuple[tf.Tensor, ...]:
        """Compute the sum over the basis alone, sum u A, and its gradient: the dominant part of a step in the paper."""
        with tf.GradientTape() as tape:
            parts = [tf.reduce_sum(u * self._basis, axis=0) for u in self.variables[2:]]
        return tuple(tape.gradient(parts, self.variables[2:], output_gradients=self._data))

    def _step(self) -> tf.Tensor:
        """Take one step, and return the loss before it."""
        with tf.GradientTape() as tape:
            loss = self._loss()
        gradients = tape.gradient(loss, self.variables)
        self._optimizer.apply_gradients(zip(gradients, self.variables, strict=True))
        return loss

    def _loss(self) -> tf.Tensor:
        """Compute the loss, paper Eq. LOGLIKELIHOOD with the prior on the summed model."""
        real, imaginary, u_real, u_imaginary = self.variables
        a_real, a_imaginary = tf.gather(real, self._first), tf.gather(imaginary, self._first)
        b_real, b_imaginary = tf.gather(real, self._second), tf.gather(imaginary, self._second)
        f_real = tf.reduce_sum(u_real * self._basis, axis=0)
        f_imaginary = tf.reduce_sum(u_imaginary * self._basis, axis=0)
        product_real = a_real * b_real + a_imaginary * b_imaginary
        product_imaginary = a_imaginary * b_real - a_real * b_imaginary
        model_real = product_real * f_real - product_imaginary * f_imaginary
        model_imaginary = product_imaginary * f_real + product_real * f_imaginary
        misfit = tf.square(self._data[0] - model_real) + tf.square(self._data[1] - model_imaginary)
        prior = tf.square(tf.reduce_sum(f_real * self._weights) - self._target[0])
        prior += tf.square(tf.reduce_sum(f_imaginary * self._weights) - self._target[1])
        return tf.reduce_sum(misfit * self._weights) + prior


def make_simulation(layout: Layout, channels: Channels) -> Simulation:
    """Return synthetic data of an array over the given channels."""
    positions = make_layout(layout).enu
    band = channels.count * channels.width
    case = Case(antennas=len(positions), channels=channels.count, first=channels.first, band=band)
    return Simulation(case, positions)


def time_steps(array: TimedArray, samples: Mapping[str, int], device: str) -> dict[str, Any]:
    """Time all solvers on one array, on ``cpu`` (one core) or ``gpu``, in this process.

    There are so many samples of ``steps`` of the paper's solver, of ``calls`` of our Adamax, each the mean of its
    `STEPS_PER_CALL` steps, and of complete, cold ``solves`` of the default solver, each with its own noise. The answer
    has ``longest`` in m; the foreground ``vectors`` of the longest baseline, to which the paper pads all others, and
    ``coefficients`` of all together; samples in ``seconds`` by name, of processor time or, on a GPU, elapsed time; and
    the bytes by which the paper's steps raised the memory of the process (``paper_memory``).
    """
    # Other work on the machine does not stretch processor time.
    clock = time.process_time if device == "cpu" else time.perf_counter
    with tf.device(f"/{device.upper()}:0"):
        simulation = make_simulation(array.layout, array.channels)
        structure = simulation.structure(array.basis)
        problem = simulation.problem(0, structure)
        before = resident_memory()
        with Usage() as usage:
            paper = PaperStep(problem)
            _settle(paper.step)
        seconds: dict[str, list[float]] = {}
        for name, sample in _all_samples(simulation, structure, paper, samples, clock):
            seconds.setdefault(name, []).append(sample)
    first, second = structure.antennas.T
    lengths = np.linalg.norm(simulation.positions[second] - simulation.positions[first], axis=1)
    return {
        "antennas": structure.n_antennas,
        "baselines": structure.n_baselines,
        "longest": float(lengths.max()),
        "vectors": max(bucket.vectors.shape[1] for bucket in structure.basis.buckets),
        "coefficients": structure.basis.n_coefficients,
        "seconds": seconds,
        "basis_bytes": paper.basis_bytes,
        "paper_memory": usage.peak_memory - before,
    }


def _settle(call: Callable[[], object]) -> None:
    """Compile a step, and run it long enough for the sampling of memory to find its peak."""
    call()
    end = time.perf_counter() + SETTLED
    call()
    while time.perf_counter() < end:
        call()


def _all_samples(
    simulation: Simulation, structure: FitStructure, paper: PaperStep, samples: Mapping[str, int], clock: Clock
) -> Iterator[tuple[str, float]]:
    """Yield samples by name, without compilation, in rounds that contain all kinds."""
    problem = simulation.problem(0, structure)
    solver = GaussNewton()
    adamax = Adamax(max_steps=10**6, tolerance=0.0)
    state = adamax.init(problem)
    for call in (paper.model_sum, lambda: adamax.step(state), lambda: solve(problem, solver)):
        call()
    for number in range(ROUNDS):
        for _ in range(_share(samples["steps"], number)):
            # Reading the loss waits for a GPU, which returns before it has finished.
            yield "paper-step", _seconds(lambda: float(paper.step()), clock)
            yield "paper-sum", _seconds(lambda: [part.numpy() for part in paper.model_sum()], clock)
        for _ in range(_share(samples["calls"], number)):
            # Every call starts from the same state.
            yield "adamax-step", _seconds(lambda: adamax.step(state), clock) / STEPS_PER_CALL
        for index in range(_share(samples["solves"], number)):
            realization = 1 + number * samples["solves"] + index
            yield from _solve_in_steps(simulation.problem(0, structure, realization), solver, clock)


def _share(total: int, number: int) -> int:
    """Return the number of the `total` samples that belong to one of the rounds."""
    return total * (number + 1) // ROUNDS - total * number // ROUNDS


def _seconds(call: Callable[[], object], clock: Clock) -> float:
    start = clock()
    call()
    return clock() - start


def _solve_in_steps(problem: CalibrationProblem, solver: GaussNewton, clock: Clock) -> Iterator[tuple[str, float]]:
    start = clock()
    state = solver.init(problem)
    while solver.terminate(state) is None:
        began = clock()
        state = solver.step(state)
        yield "default-step", clock() - began
    solver.estimate(state)
    yield "default-solve", clock() - start


def descend(array: TimedArray, max_steps: int) -> dict[str, Any]:
    """Run the paper's solver, Adamax at a fixed rate of 0.01 from unity, for all of `max_steps`.

    The answer has the minimum of the loss (``floor``), and the ``losses`` before the first step and after each.
    """
    simulation = make_simulation(array.layout, array.channels)
    structure = simulation.structure(array.basis)
    problem = simulation.problem(0, structure)
    floor = min(solve(problem, GaussNewton(FLOOR_TOLERANCE, FLOOR_STEPS)).record.loss_history)
    history = solve(problem, Adamax(max_steps=max_steps, tolerance=0.0)).record.loss_history
    return {"antennas": structure.n_antennas, "floor": float(floor), "losses": history.tolist()}


def answer(array: Mapping[str, Any], **request: Any) -> dict[str, Any]:
    """Return what `run_times.measured_apart` asks for: times, or with ``max_steps`` a descent."""
    measure = descend if "max_steps" in request else time_steps
    return measure(TimedArray.model_validate(array), **request)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    print(json.dumps(answer(**json.loads(sys.argv[1]))))
