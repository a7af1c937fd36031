"""Estimate memory and time of a calibration before it starts, and reduce the memory of one that does not fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.resources import Cost
from calstudy.calibrate.settings import (
    MOST_COUPLED,
    BasisSettings,
    ForegroundFit,
    GainFit,
    GainWeights,
    GaussNewtonSettings,
)
from calstudy.instrument.settings import Channels, Size

if TYPE_CHECKING:
    from calstudy.calibrate.problem import FitStructure

SINGLE, DOUBLE = 4, 8
# Python with TensorFlow and pyuvdata, and the compiled graphs.
TENSORFLOW_MEMORY = 1.2e9
# Memory that allocators hold over memory in use, measured for 128 and 350 antennas.
RETAINED = 1.6
LEAST_MODELS = 32
# The common basis spans the edges of all bases besides the widest.
EXTRA_RANK = 14
# Vectors of a basis beyond its time-bandwidth product, for the default eigenvalue cutoff.
EXTRA_VECTORS = 14
PAPER_SAMPLES = 630 * 384
# Seconds of one core for the paper's samples with Gauss-Newton, where foregrounds are the sky model, free, or have a
# finite prior: a first solve, and one from the solution before. Free ones take more the lower the tolerance, 0.4 s at
# 1e-3 and 6 s at 1e-5; those with a prior the wider it is: 1 s at 0.1, 10 at 1.
FROZEN_COLD, FREE_COLD, FINITE_COLD = 0.25, 1.5, 4.0
FROZEN_SECONDS, FREE_SECONDS, FINITE_SECONDS = 0.1, 0.4, 1.0
FREE_TOLERANCE, FREE_POWER = 1e-3, -0.6
FINITE_DEVIATION = 0.1
# With its passes and probes.
ESTIMATED_SECONDS = 6.0
# Compilation takes 3 s and more; pieces with the same baselines in one process share it, so that most have none.
START_SECONDS = 1.5
# With weights from the gains, or an estimated prior, a first solve is repeated, and every solve has calls that do not
# depend on its size.
PASSES, PASSES_SECONDS, SEARCH_SECONDS = 2.0, 0.4, 1.2
ADAMAX_STEP = 4e-3


@dataclass(frozen=True)
class Dimensions:
    """Quantities that determine the memory of a solve, counted over all integrations that are solved together.

    `widest` is the number of vectors of the largest foreground basis, `coefficients` that of all models together.
    """

    antennas: int
    baselines: int
    models: int
    channels: int
    widest: int
    coefficients: float

    @classmethod
    def of(cls, structure: FitStructure) -> Dimensions:
        """Return the dimensions of a fit structure."""
        basis = structure.basis
        counts = structure.n_antennas, structure.n_baselines, basis.n_models, structure.n_frequencies
        return cls(*counts, max(bucket.vectors.shape[-1] for bucket in basis.buckets), basis.n_coefficients)

    @property
    def samples(self) -> int:
        """Number of visibilities."""
        return self.baselines * self.channels

    @property
    def rank(self) -> int:
        """Approximate upper limit of the rank of the common basis of all models."""
        return min(self.widest + EXTRA_RANK, self.channels)


def solve_memory(dimensions: Dimensions, settings: GainFit) -> float:
    """Return the peak memory of one solve in bytes, libraries included, within about a factor of 1.5."""
    d = dimensions
    # The problem's complex visibilities and weights, and the solver's pairs of them.
    data = (2 + 1) * 2 * DOUBLE * d.samples
    by_channel = 8 * SINGLE * d.channels * d.antennas**2
    # Smooth gains have coefficients in place of channels, and at most as many.
    by_antenna = 0.0 if settings.gain_delay is None else 6 * SINGLE * d.antennas * d.channels**2
    if not isinstance(settings, ForegroundFit):
        return TENSORFLOW_MEMORY + RETAINED * (data + 20 * SINGLE * d.samples + by_channel + by_antenna)
    # Model, curvature and model on the baselines; roots.
    projection = 2 * DOUBLE * d.models * d.channels + 3 * SINGLE * d.samples + SINGLE * d.coefficients * d.rank
    at_once = min(settings.models_at_once, d.models)
    # Of one batch: vectors times D, or S times the model of each baseline in the common basis and its squares.
    squares = 12 * SINGLE * at_once * d.baselines / d.models * d.rank**2
    pieces = max(2 * DOUBLE * at_once * d.widest * d.channels, squares)
    # Products of all pairs of vectors; the blocks of all antennas, and their inversion in double precision.
    by_antenna += (SINGLE * d.channels + 10 * DOUBLE * d.antennas) * d.rank**2
    while_projecting = 2 * projection + 7 * SINGLE * d.samples
    while_preparing = projection + 2 * SINGLE * d.samples + max(by_antenna, by_channel)
    result = projection + 8 * DOUBLE * d.samples
    peak = data + max(while_projecting, while_preparing, result)
    return TENSORFLOW_MEMORY + pieces + RETAINED * (peak + _unknowns(d, settings))


def _unknowns(dimensions: Dimensions, settings: GainFit) -> float:
    """Return the memory of a solver's unknowns and past steps, in bytes."""
    solver = settings.solver
    gains = 2 * dimensions.antennas * dimensions.channels
    if isinstance(solver, GaussNewtonSettings):
        rows = 2 * dimensions.antennas * dimensions.rank
        # The matrix that couples smooth gains of all antennas, its factor, and a copy.
        coupled = solver.precision == "double" and isinstance(settings, ForegroundFit) and rows <= MOST_COUPLED
        return 10 * SINGLE * gains + (3 * DOUBLE * rows**2 if coupled else 0)
    word = SINGLE if solver.precision == "single" else DOUBLE
    # Parameters, moments, best and gradient; visibilities, model and residual.
    return 8 * word * (gains + 2 * dimensions.coefficients) + 10 * word * dimensions.samples


def basis_vectors(length: float, channels: Channels, basis: BasisSettings) -> int:
    """Return the approximate number of foreground vectors of a baseline of this length (m)."""
    delay = max(basis.horizon * length / SPEED_OF_LIGHT, basis.min_delay) + basis.buffer
    return int(min(2 * channels.count * channels.width * delay + EXTRA_VECTORS, channels.count))


def dimensions_of(size: Size, settings: GainFit) -> Dimensions:
    """Return the dimensions of one solve, as if no baselines shared a model."""
    baselines = min(settings.integrations_per_solve, size.times) * size.baselines
    basis = settings.basis if isinstance(settings, ForegroundFit) else BasisSettings()
    coefficients = baselines * basis_vectors(size.mean, size.channels, basis)
    widest = basis_vectors(size.longest, size.channels, basis)
    return Dimensions(size.antennas, baselines, baselines, size.channels.count, widest, coefficients)


def solve_cost(settings: GainFit, size: Size) -> Cost:
    """Return the cost of consecutive solves of data of this size, compilation included: seconds of one core, and bytes.

    The constants were measured on one core of a 2020s server; they serve to plan, within a factor of about two.
    """
    together = settings.integrations_per_solve
    solves = size.times * size.polarizations / together
    seconds = _seconds(settings, solves, size.baselines * size.channels.count * together)
    return Cost(seconds, solve_memory(dimensions_of(size, settings), settings))


def _seconds(settings: GainFit, solves: float, samples: int) -> float:
    work, solver = samples / PAPER_SAMPLES, settings.solver
    if isinstance(solver, GaussNewtonSettings):
        warm = max(solves - 1, 0) if solver.warm_start else 0
        passes, each = (PASSES, PASSES_SECONDS) if isinstance(settings.weights, GainWeights) else (1.0, 0.0)
        if settings.estimates_deviation:
            passes, each = PASSES, SEARCH_SECONDS
        cold, seconds = _solve_seconds(settings, solver.tolerance)
        # Cost of the normal matrices, baselines x channels x vectors^2, dominates.
        return START_SECONDS + each * solves + ((solves - warm) * max(cold * passes, seconds) + warm * seconds) * work
    return 6 + ADAMAX_STEP * work * solves * solver.max_steps


def _solve_seconds(settings: GainFit, tolerance: float) -> tuple[float, float]:
    """Return the seconds of Gauss-Newton solves of the paper's samples: a first one, in one pass, and a later one."""
    if not isinstance(settings, ForegroundFit) or settings.frozen:
        return FROZEN_COLD, FROZEN_SECONDS
    prior = settings.foreground_prior
    if not prior.finite:
        # No solve takes more than some hundred steps.
        return FREE_COLD, FREE_SECONDS * max(1.0, (max(tolerance, 1e-6) / FREE_TOLERANCE) ** FREE_POWER)
    if prior.estimated:
        return FINITE_COLD, ESTIMATED_SECONDS
    widest = max(float(prior.deviation), float(prior.shared_deviation))
    return FINITE_COLD, FINITE_SECONDS * max(1.0, widest / FINITE_DEVIATION)
