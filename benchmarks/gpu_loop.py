"""Time the paper's loop on a GPU or a processor, in JAX.

calstudy's solvers are written in TensorFlow. Here their inner loops are written again in JAX, for machines that have a
GPU and JAX but no TensorFlow. The script needs JAX, with the numpy and scipy that JAX itself needs, and no calstudy:

    python benchmarks/gpu_loop.py --out gpu.json                                    # on the GPU, if JAX finds one
    JAX_PLATFORMS=cpu python benchmarks/gpu_loop.py --out cpu.json                  # on all cores
    JAX_PLATFORMS=cpu taskset -c 0,2 python benchmarks/gpu_loop.py --out two.json   # on two cores

Three kernels are timed:

- ``padded``: a step of Adamax as in the paper and in the code of its authors. All baselines share one basis tensor,
  padded with zeros, (Nvec, Nbls, Nfreqs). See `calstudy.products.step_times.PaperStep`.
- ``buckets``: a step of Adamax as in `calstudy.calibrate.solvers.adamax`, with a matrix product for each basis.
- ``normal``: a product with the Gauss-Newton matrix of the gains, the foregrounds eliminated, as in
  `calstudy.calibrate.projection.Projector.hessian_product`. The default solver spends most of its time in it.

Gains, data, weights and the prior on the summed model are those of the paper. Each call runs several steps in one
compiled loop, and ends when its results are there. On a processor, memory for temporary arrays is allocated once in a
call, which can take longer than a step. The first calls, with compilation, do not count. Matrix products in
float32 are not rounded to TF32. The saved GPU times (results/gpu-loop.csv) were taken with
``XLA_FLAGS="--xla_gpu_autotune_level=0 --xla_gpu_enable_triton_gemm=false"``, for a shorter compilation.

`benchmarks/gpu_loop_check.py` compares loss, gradient and product with those of calstudy, and the times as well.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.signal.windows import dpss

LIGHT = 299_792_458.0
# The basis of the studies: minimum delay, buffer and step of half-widths, s, and the least concentration.
MIN_DELAY, BUFFER, DELAY_STEP, CUTOFF = 100e-9, 50e-9, 10e-9, 1e-12
# As in `calstudy.calibrate.solvers.adamax`.
LEARNING_RATE, BETA_1, BETA_2, EPSILON, PARTS = 0.01, 0.9, 0.999, 1e-7, 8
# As in `calstudy.calibrate.batches`.
MODELS_AT_ONCE, WIDEST = 1024, 4 / 3
SPAN_CUTOFF = {"float32": 1e-9, "float64": 1e-15}
# Steps in a call; calls at least and at most, and the seconds after which no further one starts.
STEPS, FEWEST, MOST, ENOUGH = 10, 3, 40, 3.0
NOISE = 1e-3

Loop = Callable[..., Any]


@dataclass(frozen=True)
class Array:
    """Antenna positions, (Nants, 2), m, and channels of a width, Hz."""

    name: str
    positions: np.ndarray
    channels: int
    width: float

    @property
    def antennas(self) -> int:
        """Number of antennas."""
        return len(self.positions)


def disc(antennas: int) -> Array:
    """Return antennas at random within 176 m, the longest baseline of the paper's array, with its 384 channels."""
    rng = np.random.default_rng(1)
    radius, angle = 88.0 * np.sqrt(rng.uniform(0, 1, antennas)), rng.uniform(0, 2 * np.pi, antennas)
    radius[:2], angle[:2] = 88.0, (0.0, np.pi)
    positions = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    return Array(f"disc-{antennas}", positions, 384, 80e3)


def rows(antennas: int) -> Array:
    """Return the paper's rows of eight antennas with 2 m between neighbours, 100 m across, and its 200 channels."""
    column, row = np.arange(antennas) % 8, np.arange(antennas) // 8
    depth = np.sqrt(100.0**2 - 14.0**2) / max(row.max(), 1)
    return Array(f"rows-{antennas}", np.column_stack([2.0 * column, depth * row]), 200, 300e3)


def line(length: int) -> Array:
    """Return the paper's line of ten antennas, of a length in m, with its 200 channels."""
    return Array(f"line-{length}", np.column_stack([np.linspace(0, length, 10), np.zeros(10)]), 200, 300e3)


class Fit(NamedTuple):
    """One integration, baselines sorted by basis.

    Attributes
    ----------
    first, second : antennas of the baselines, (Nbls,)
    bases, sizes : different bases, (Nfreqs, Nvec), and number of baselines of each
    visibilities, weights : (2, Nbls, Nfreqs) in units of their rms, and (Nbls, Nfreqs)
    """

    antennas: int
    first: np.ndarray
    second: np.ndarray
    bases: list[np.ndarray]
    sizes: list[int]
    visibilities: np.ndarray
    weights: np.ndarray

    @property
    def edges(self) -> list[int]:
        """First baseline of each basis, and one past the last of all."""
        return [0, *np.cumsum(self.sizes).tolist()]

    @property
    def coefficients(self) -> list[np.ndarray]:
        """Coefficients that fit the data best for unity gains, (2, N, Nvec) for each basis."""
        return [
            self.visibilities[:, start:end] @ basis
            for (start, end), basis in zip(pairwise(self.edges), self.bases, strict=True)
        ]


def make_fit(array: Array, dtype: str) -> Fit:
    """Return random foregrounds within the basis, times random gains, with noise."""
    rng = np.random.default_rng(2)
    first, second = np.triu_indices(array.antennas, 1)
    lengths = np.linalg.norm(array.positions[first] - array.positions[second], axis=1)
    reach = np.maximum(lengths / LIGHT, MIN_DELAY) + BUFFER
    half_widths = np.ceil(np.round(reach / DELAY_STEP, 6)) * DELAY_STEP
    order = np.argsort(half_widths, kind="stable")
    first, second = first[order], second[order]
    found, sizes = np.unique(half_widths, return_counts=True)
    bases = [_sequences(array.channels, array.channels * array.width * half_width) for half_width in found]
    model = [
        (rng.standard_normal((2, size, basis.shape[1]), np.float32) @ basis.T.astype("f4"))
        for size, basis in zip(sizes, bases, strict=True)
    ]
    foregrounds = np.concatenate(model, axis=1)
    shape = (2, array.antennas, array.channels)
    gains = 0.1 * rng.standard_normal(shape, np.float32) + np.array([1, 0], "f4")[:, None, None]
    product = (gains[0] + 1j * gains[1])[first] * (gains[0] - 1j * gains[1])[second]
    data = product * (foregrounds[0] + 1j * foregrounds[1])
    data /= np.sqrt(np.mean(np.abs(data) ** 2))
    visibilities = np.stack([data.real, data.imag])
    visibilities += np.float32(NOISE / np.sqrt(2)) * rng.standard_normal(visibilities.shape, np.float32)
    weights = np.full(data.shape, 1 / data.size)
    return Fit(array.antennas, first, second, bases, sizes.tolist(), visibilities.astype(dtype), weights.astype(dtype))


def _sequences(channels: int, half_bandwidth: float) -> np.ndarray:
    """Return the DPSS with a concentration above the cutoff, (channels, Nvec)."""
    asked = min(channels, int(2 * half_bandwidth) + 40)
    vectors, concentrations = dpss(channels, half_bandwidth, Kmax=asked, return_ratios=True)
    below = concentrations < CUTOFF
    return vectors[: int(np.argmax(below)) if below.any() else asked].T


def likelihood(ends: Any, gains: Any, model: Any, visibilities: Any, weights: Any) -> Any:
    """Return sum w |v - g_a g_b* F|^2; all but the weights are real and imaginary parts."""
    a_real, a_imaginary = gains[0][ends[0]], gains[1][ends[0]]
    b_real, b_imaginary = gains[0][ends[1]], gains[1][ends[1]]
    product_real = a_real * b_real + a_imaginary * b_imaginary
    product_imaginary = a_imaginary * b_real - a_real * b_imaginary
    residual_real = visibilities[0] - (product_real * model[0] - product_imaginary * model[1])
    residual_imaginary = visibilities[1] - (product_imaginary * model[0] + product_real * model[1])
    return jnp.sum(weights * (residual_real**2 + residual_imaginary**2))


def padded_loss(parameters: Any, data: Any) -> Any:
    """Return the loss with one padded basis for all baselines.

    Gains are (2, Nants, Nfreqs), coefficients (2, Nvec, Nbls).
    """
    gains, coefficients = parameters
    basis, ends, visibilities, weights, target = data
    model = [jnp.sum(part[:, :, None] * basis, axis=0) for part in coefficients]
    summed = jnp.stack([jnp.sum(part * weights) for part in model])
    return likelihood(ends, gains, model, visibilities, weights) + jnp.sum((summed - target) ** 2)


def padded_step(parameters: Any, data: Any) -> tuple[Any, Any]:
    """Return loss and gradient of `padded_loss`."""
    return jax.value_and_grad(padded_loss)(parameters, data)


def padded_problem(fit: Fit, dtype: str) -> tuple[Any, Any]:
    """Return parameters and data of `padded_loss`."""
    widest = max(basis.shape[1] for basis in fit.bases)
    stack = np.zeros((widest, len(fit.bases), fit.visibilities.shape[2]), dtype)
    for number, basis in enumerate(fit.bases):
        stack[: basis.shape[1], number] = basis.T
    basis = jnp.take(jnp.asarray(stack), np.repeat(np.arange(len(fit.sizes)), fit.sizes), axis=1)
    coefficients = [np.pad(part, ((0, 0), (0, 0), (0, widest - part.shape[2]))) for part in fit.coefficients]
    start = jnp.asarray(np.concatenate(coefficients, axis=1).transpose(0, 2, 1), dtype)
    return (_unity(fit, dtype), start), (basis, *_measured(fit), _target(fit))


def _unity(fit: Fit, dtype: str) -> Any:
    shape = (fit.antennas, fit.visibilities.shape[2])
    return jnp.stack([jnp.ones(shape, dtype), jnp.zeros(shape, dtype)])


def _measured(fit: Fit) -> tuple[Any, ...]:
    ends = (jnp.asarray(fit.first, jnp.int32), jnp.asarray(fit.second, jnp.int32))
    return ends, jnp.asarray(fit.visibilities), jnp.asarray(fit.weights)


def _target(fit: Fit) -> Any:
    return jnp.asarray((fit.visibilities * fit.weights).sum((1, 2), dtype="f8"), fit.visibilities.dtype)


def make_parts(edges: Sequence[int]) -> list[tuple[int, int]]:
    """Divide the bases into at most `PARTS` ranges with about equal numbers of baselines."""
    cuts = [0]
    for number, end in enumerate(edges[1:]):
        if end >= edges[-1] * len(cuts) / PARTS:
            cuts.append(number + 1)
    return list(pairwise(cuts))


def bucket_step(parameters: Any, data: Any) -> tuple[Any, Any]:
    """Return loss and gradient, part by part, with one matrix product for each basis."""
    gains, coefficients = parameters
    bases, ends, visibilities, weights, summed, target = data
    edges = [0, *np.cumsum([part.shape[1] for part in coefficients]).tolist()]

    def part_loss(gains: Any, chosen: Any, start: int, end: int) -> Any:
        products = [u @ basis for u, basis in zip(chosen, bases[start:end], strict=True)]
        model = jnp.concatenate(products, axis=1)
        rows = slice(edges[start], edges[end])
        mine = (ends[0][rows], ends[1][rows])
        return likelihood(mine, gains, model, visibilities[:, rows], weights[rows])

    def sum_prior(chosen: Any) -> Any:
        values = [(u * weight).reshape(2, -1) for u, weight in zip(chosen, summed, strict=True)]
        return jnp.sum((jnp.sum(jnp.concatenate(values, axis=1), axis=1) - target) ** 2)

    value, slopes = jax.value_and_grad(sum_prior)(coefficients)
    of_gains, of_likelihood = jnp.zeros_like(gains), []
    for start, end in make_parts(edges):
        gradient = jax.value_and_grad(part_loss, argnums=(0, 1))
        loss, (of_part, found) = gradient(gains, coefficients[start:end], start, end)
        value, of_gains = value + loss, of_gains + of_part
        of_likelihood.extend(found)
    return value, (of_gains, tuple(one + more for one, more in zip(of_likelihood, slopes, strict=True)))


def bucket_problem(fit: Fit, dtype: str) -> tuple[Any, Any]:
    """Return parameters and data of `bucket_step`."""
    bases = tuple(jnp.asarray(basis.T, dtype) for basis in fit.bases)
    summed = [
        np.stack([fit.weights[start:end] @ basis] * 2)
        for (start, end), basis in zip(pairwise(fit.edges), fit.bases, strict=True)
    ]
    start = tuple(jnp.asarray(part, dtype) for part in fit.coefficients)
    weights = tuple(jnp.asarray(part, dtype) for part in summed)
    return (_unity(fit, dtype), start), (bases, *_measured(fit), weights, _target(fit))


def adamax(step: Any, parameters: Any, moments: Any, gradient: Any) -> tuple[Any, Any]:
    """Take a step of Adamax, counted from one; return parameters and moments."""
    first = jax.tree.map(lambda m, g: BETA_1 * m + (1 - BETA_1) * g, moments[0], gradient)
    second = jax.tree.map(lambda n, g: jnp.maximum(BETA_2 * n, jnp.abs(g)), moments[1], gradient)
    rate = LEARNING_RATE / (1 - BETA_1 ** step.astype(gradient[0].dtype))
    moved = jax.tree.map(lambda x, m, n: x - rate * m / (n + EPSILON), parameters, first, second)
    return moved, (first, second)


def descent_loop(step: Callable[[Any, Any], tuple[Any, Any]], keep_best: bool, steps: int) -> Loop:
    """Return a function that takes some steps; calstudy keeps the parameters with the lowest loss besides."""

    def body(_: Any, carry: Any, data: Any) -> Any:
        done, parameters, moments, best, least = carry
        value, gradient = step(parameters, data)
        if keep_best:
            better = value < least
            best = jax.tree.map(lambda new, old: jnp.where(better, new, old), parameters, best)
        moved, moments = adamax(done + 1, parameters, moments, gradient)
        return done + 1, moved, moments, best, jnp.minimum(value, least)

    return lambda carry, data: lax.fori_loop(0, steps, lambda index, now: body(index, now, data), carry)


def descent_start(parameters: Any, keep_best: bool) -> Any:
    """Return what `descent_loop` starts from."""

    def zero() -> Any:
        return jax.tree.map(jnp.zeros_like, parameters)

    best = jax.tree.map(jnp.copy, parameters) if keep_best else ()
    return jnp.zeros((), jnp.int32), parameters, (zero(), zero()), best, jnp.array(jnp.inf, parameters[0].dtype)


def normal_product(eta: Any, data: Any) -> Any:
    """Return the Gauss-Newton matrix times eta, both (2, Nants, Nfreqs).

    `data` are, for each batch of baselines, antennas, curvature D, model F, span Q and roots S.
    """
    total = jnp.zeros_like(eta)
    for (first, second), curvature, model, span, root in data:
        change = jnp.stack([eta[0][first] + eta[0][second], eta[1][first] - eta[1][second]])
        weighted = curvature * _multiply(model, change)
        inner = jnp.swapaxes(weighted @ span, 0, 1)
        inner = (inner @ jnp.swapaxes(root, 1, 2)) @ root
        left = weighted - curvature * (jnp.swapaxes(inner, 0, 1) @ span.T)
        pulled = _multiply(jnp.stack([model[0], -model[1]]), left)
        # One real array at a time, as in calstudy.
        real, imaginary = total[0], total[1]
        total = jnp.stack(
            [
                real.at[first].add(pulled[0]).at[second].add(pulled[0]),
                imaginary.at[first].add(pulled[1]).at[second].add(-pulled[1]),
            ]
        )
    return total


def _multiply(left: Any, right: Any) -> Any:
    return jnp.stack([left[0] * right[0] - left[1] * right[1], left[0] * right[1] + left[1] * right[0]])


def make_batches(fit: Fit) -> list[tuple[int, int, list[int]]]:
    """Divide baselines into batches of similar numbers of vectors: first, one past the last, and basis of each."""
    of_baseline = np.repeat(np.arange(len(fit.sizes)), fit.sizes)
    widths = np.array([basis.shape[1] for basis in fit.bases])[of_baseline]
    cuts = [0]
    most = min(MODELS_AT_ONCE, max(-(-len(widths) // PARTS), 16))
    for number in range(1, len(widths)):
        if number - cuts[-1] >= most or widths[number] > WIDEST * widths[cuts[-1]]:
            cuts.append(number)
    return [(start, end, of_baseline[start:end].tolist()) for start, end in pairwise([*cuts, len(widths)])]


def normal_problem(fit: Fit, dtype: str) -> tuple[Any, Any]:
    """Return a random eta, and the data of `normal_product` at unity gains.

    There D is the weight, and S the overlap A^T Q over its root, because A is orthonormal.
    """
    data = []
    model = np.concatenate(
        [part @ basis.T for part, basis in zip(fit.coefficients, fit.bases, strict=True)], axis=1
    ).astype(dtype)
    for start, end, numbers in make_batches(fit):
        kinds, index = np.unique(numbers, return_inverse=True)
        span = span_of([fit.bases[kind] for kind in kinds], dtype)
        widest = max(fit.bases[kind].shape[1] for kind in kinds)
        overlaps = np.zeros((len(kinds), widest, span.shape[1]))
        for overlap, kind in zip(overlaps, kinds, strict=True):
            overlap[: fit.bases[kind].shape[1]] = fit.bases[kind].T @ span
        overlaps /= np.sqrt(fit.weights[0, 0])
        ends = (jnp.asarray(fit.first[start:end], jnp.int32), jnp.asarray(fit.second[start:end], jnp.int32))
        curvature, values = jnp.asarray(fit.weights[start:end]), jnp.asarray(model[:, start:end])
        roots = jnp.take(jnp.asarray(overlaps, dtype), index, axis=0)
        data.append((ends, curvature, values, jnp.asarray(span, dtype), roots))
    eta = np.random.default_rng(3).standard_normal((2, fit.antennas, fit.visibilities.shape[2]))
    return jnp.asarray(eta, dtype), data


def span_of(bases: Sequence[np.ndarray], dtype: str) -> np.ndarray:
    """Return an orthonormal basis of the joint span of bases, (Nfreqs, rank)."""
    triangle = np.linalg.qr(np.concatenate(bases, axis=1).T, mode="r")
    left, singular, _ = np.linalg.svd(triangle.T, full_matrices=False)
    return left[:, singular > SPAN_CUTOFF[dtype] * singular[0]]


def normal_loop(steps: int) -> Loop:
    """Return a function that takes some products, each of the result of the one before."""

    def body(now: Any, data: Any) -> Any:
        image = normal_product(now, data)
        return image / jnp.max(jnp.abs(image))

    return lambda eta, data: lax.fori_loop(0, steps, lambda _, now: body(now, data), eta)


def prepare(kernel: str, fit: Fit, dtype: str, steps: int) -> tuple[Loop, Any, Any]:
    """Return the loop of a kernel, what it starts from, and its data."""
    if kernel == "normal":
        return normal_loop(steps), *normal_problem(fit, dtype)
    padded = kernel == "padded"
    parameters, data = (padded_problem if padded else bucket_problem)(fit, dtype)
    loop = descent_loop(padded_step if padded else bucket_step, not padded, steps)
    return loop, descent_start(parameters, not padded), data


def time_loop(loop: Loop, state: Any, data: Any, steps: int) -> dict[str, Any]:
    """Return milliseconds for each step: medians of elapsed and processor time, and the range that holds 80 %."""
    began = time.perf_counter()
    compiled = jax.jit(loop, donate_argnums=0).lower(state, data).compile()
    compilation = time.perf_counter() - began
    for _ in range(2):
        state = jax.block_until_ready(compiled(state, data))
    elapsed, processor, end = [], [], time.perf_counter() + ENOUGH
    while len(elapsed) < FEWEST or (len(elapsed) < MOST and time.perf_counter() < end):
        start, used = time.perf_counter(), time.process_time()
        state = jax.block_until_ready(compiled(state, data))
        elapsed.append(1e3 * (time.perf_counter() - start) / steps)
        processor.append(1e3 * (time.process_time() - used) / steps)
    low, median, high = (float(value) for value in np.quantile(elapsed, [0.1, 0.5, 0.9]))
    finite = all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(state) if leaf.size > 1)
    return {
        "ms": median,
        "ms_10": low,
        "ms_90": high,
        "processor_ms": float(np.median(processor)),
        "calls": len(elapsed),
        "steps_of_call": steps,
        "compilation_s": compilation,
        "finite": finite,
    }


def accuracy(fit: Fit, kernel: str) -> dict[str, float]:
    """Return how far loss and gradient, or the product, in float32 are from those in float64."""
    found = []
    for dtype in ("float32", "float64"):
        typed = fit._replace(visibilities=fit.visibilities.astype(dtype), weights=fit.weights.astype(dtype))
        if kernel == "normal":
            function, problem = normal_product, normal_problem(typed, dtype)
        else:
            make = padded_problem if kernel == "padded" else bucket_problem
            function = padded_step if kernel == "padded" else bucket_step
            (gains, coefficients), data = make(typed, dtype)
            # At the start, coefficients are the best ones and their gradient is nearly zero.
            change = np.random.default_rng(4).standard_normal(gains.shape).astype(dtype)
            problem = (gains + jnp.asarray(0.1 * change, dtype), coefficients), data
        values = jax.tree.leaves(jax.jit(function)(*problem))
        found.append([np.asarray(value, float) for value in values])
    names = ["product"] if kernel == "normal" else ["loss", "gains", *["coefficients"] * (len(found[0]) - 2)]
    errors: dict[str, float] = {}
    for name, one, other in zip(names, *found, strict=True):
        error = float(np.linalg.norm(one - other) / np.linalg.norm(other))
        errors[name] = max(errors.get(name, 0.0), error)
    return errors


def describe() -> dict[str, Any]:
    """Return device, processor and versions."""
    cpu = next((row.split(":")[1].strip() for row in _lines("/proc/cpuinfo") if row.startswith("model name")), "?")
    return {
        "device": jax.devices()[0].device_kind,
        "platform": jax.devices()[0].platform,
        "processor": cpu,
        "cores": len(os.sched_getaffinity(0)),
        "jax": jax.__version__,
        "python": platform.python_version(),
    }


def _lines(path: str) -> list[str]:
    return Path(path).read_text().splitlines() if Path(path).exists() else []


def make_array(name: str) -> Array:
    """Return the array of a name such as ``disc-36``."""
    kind, number = name.split("-")
    return {"disc": disc, "rows": rows, "line": line}[kind](int(number))


def measure(cases: Sequence[str], seconds: float, out: Path) -> None:
    """Time cases until the time is up, and write the results after each.

    A case is array, kernel and precision, such as ``disc-36:buckets:float32``, and the steps of a call if not `STEPS`.
    """
    began = time.perf_counter()
    results: dict[str, Any] = {"machine": describe(), "times": [], "errors": {}, "left_out": []}
    print(results["machine"], flush=True)
    fits: dict[tuple[str, str], Fit] = {}
    for case in cases:
        name, kernel, dtype, *given = case.split(":")
        steps = int(given[0]) if given else STEPS
        if time.perf_counter() - began > seconds:
            results["left_out"].append(case)
            continue
        if (name, dtype) not in fits:
            fits[name, dtype] = make_fit(make_array(name), dtype)
        fit = fits[name, dtype]
        try:
            row: dict[str, Any] = time_loop(*prepare(kernel, fit, dtype, steps), steps)
        except jax.errors.JaxRuntimeError as error:  # a case that is too large for the memory leaves the others
            row = {"failed": str(error)[:300]}
        row = {"array": name, "kernel": kernel, "dtype": dtype, **row}
        row.update(baselines=len(fit.first), vectors=max(basis.shape[1] for basis in fit.bases), bases=len(fit.bases))
        results["times"].append(row)
        print({key: round(value, 4) if isinstance(value, float) else value for key, value in row.items()}, flush=True)
        out.write_text(json.dumps(results, indent=1))
    small = make_fit(make_array("disc-12"), "float32")
    results["errors"] = {kernel: accuracy(small, kernel) for kernel in KERNELS}
    print(results["errors"], "left out:", results["left_out"])
    out.write_text(json.dumps(results, indent=1))


KERNELS = ("padded", "normal", "buckets")
DISCS = ("disc-36", "disc-128", "disc-350", "disc-200")
FIGURES = ("rows-96", "rows-128", "line-20", "line-200")
CASES = [
    *(f"{name}:padded:float32" for name in (*DISCS, *FIGURES)),
    *(f"{name}:{kernel}:float32" for kernel in ("normal", "buckets") for name in DISCS),
    *(f"{name}:{kernel}:float64" for kernel in KERNELS for name in DISCS),
]


def main() -> None:
    """Parse the command line and measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="JSON file of results")
    parser.add_argument("--seconds", type=float, default=600, help="no case starts after this time")
    parser.add_argument(
        "--cases",
        nargs="*",
        default=CASES,
        help="such as disc-36:buckets:float32, or disc-36:buckets:float32:1 for calls of one step",
    )
    arguments = parser.parse_args()
    measure(arguments.cases, arguments.seconds, arguments.out)


# True float32, not TF32, and float64 where it is asked for.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_default_matmul_precision", "highest")

if __name__ == "__main__":
    main()
