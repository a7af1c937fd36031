"""What a calibration will need, before it starts, and how to make it fit."""

from __future__ import annotations

from dataclasses import dataclass

from calstudy.calibrate.problem import FitStructure
from calstudy.calibrate.settings import CalibrationSettings, GaussNewtonSettings, LbfgsSettings

SINGLE, DOUBLE = 4, 8
# Python with TensorFlow and pyuvdata, and the compiled graphs.
LIBRARIES = 1.2e9
# What the allocators keep besides what is in use, measured for 128 and 350 antennas.
RETAINED = 1.6
LEAST_MODELS = 32
# The common basis spans the edges of all bases besides the widest.
EXTRA_RANK = 14


@dataclass(frozen=True)
class Dimensions:
    """What the memory of a solve depends on.

    Attributes
    ----------
    antennas, baselines, models, channels
        Their numbers, of all integrations that are solved together.
    widest
        Vectors of the largest foreground basis.
    coefficients
        Vectors of all models together.
    """

    antennas: int
    baselines: int
    models: int
    channels: int
    widest: int
    coefficients: float

    @classmethod
    def of(cls, structure: FitStructure) -> Dimensions:
        """Return those of a fit structure."""
        basis = structure.basis
        widest = max(bucket.vectors.shape[-1] for bucket in basis.buckets)
        return cls(
            structure.n_antennas,
            structure.n_baselines,
            basis.n_models,
            structure.n_frequencies,
            widest,
            basis.n_coefficients,
        )

    @property
    def samples(self) -> int:
        """Number of visibilities."""
        return self.baselines * self.channels

    @property
    def rank(self) -> int:
        """Vectors of the common basis of all models, at most about."""
        return min(self.widest + EXTRA_RANK, self.channels)


def solve_memory(dimensions: Dimensions, settings: CalibrationSettings) -> float:
    """Return the bytes that one solve needs at its peak, libraries included, within about a factor of 1.5.

    Parameters
    ----------
    dimensions
        Of all integrations that are solved together.
    settings
        Whose solver, and how many models at a time, are meant.
    """
    d = dimensions
    # The problem's complex visibilities and weights, and the solver's pairs of them.
    data = (2 + 1) * 2 * DOUBLE * d.samples
    by_channel = 8 * SINGLE * d.channels * d.antennas**2
    # Smooth gains have coefficients in place of channels, hardly as many.
    by_antenna = 0.0 if settings.gain_delay is None else 6 * SINGLE * d.antennas * d.channels**2
    if settings.calibrator == "sky-based":
        return LIBRARIES + RETAINED * (data + 20 * SINGLE * d.samples + by_channel + by_antenna)
    # Model, curvature and model on the baselines; roots.
    projection = 2 * DOUBLE * d.models * d.channels + 3 * SINGLE * d.samples + SINGLE * d.models * d.widest * d.rank
    at_once = min(settings.models_at_once, d.models)
    pieces = 2 * DOUBLE * at_once * d.widest * d.channels
    # S times the model of each baseline of a stretch, in the common basis; products of all pairs of its vectors; the
    # blocks of all antennas, and their inversion in double precision.
    seen = at_once * d.baselines / d.models
    by_antenna += (12 * SINGLE * seen + SINGLE * d.channels + 10 * DOUBLE * d.antennas) * d.rank**2
    while_projecting = 2 * projection + 7 * SINGLE * d.samples
    while_preparing = projection + 2 * SINGLE * d.samples + max(by_antenna, by_channel)
    result = projection + 8 * DOUBLE * d.samples
    peak = data + max(while_projecting, while_preparing, result)
    return LIBRARIES + pieces + RETAINED * (peak + _unknowns(d, settings))


def _unknowns(dimensions: Dimensions, settings: CalibrationSettings) -> float:
    """Return the bytes of what a solver keeps of its unknowns and past steps."""
    solver = settings.solver
    gains = 2 * dimensions.antennas * dimensions.channels
    if isinstance(solver, GaussNewtonSettings):
        return 10 * SINGLE * gains
    if isinstance(solver, LbfgsSettings):
        return (2 * solver.memory + 10) * DOUBLE * gains
    word = SINGLE if solver.precision == "single" else DOUBLE
    # Parameters, moments, best and gradient; visibilities, model and residual.
    return 8 * word * (gains + 2 * dimensions.coefficients) + 10 * word * dimensions.samples


def fit_models_at_once(dimensions: Dimensions, settings: CalibrationSettings, budget: float) -> CalibrationSettings:
    """Return settings that work on as few models at a time as the memory demands, and as many as they say if it allows.

    What does not fit even with `LEAST_MODELS` at a time comes back with that number.

    Parameters
    ----------
    budget
        Bytes for one solve, libraries included.
    """
    while settings.models_at_once > LEAST_MODELS and solve_memory(dimensions, settings) > budget:
        fewer = max(settings.models_at_once // 2, LEAST_MODELS)
        settings = settings.model_copy(update={"models_at_once": fewer})
    return settings
