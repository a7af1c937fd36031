"""What a calibration will need, before it starts."""

from __future__ import annotations

from calstudy.calibrate.problem import FitStructure
from calstudy.calibrate.settings import CalibrationSettings, GaussNewtonSettings
from calstudy.calibrate.tensors import PIECE

SINGLE, DOUBLE = 4, 8
LIBRARIES = 0.8e9
# Pairs of double-precision visibilities that are alive at the same time: data, gain products, residuals, gradients.
PAIRS = 12


def solve_memory(structure: FitStructure, settings: CalibrationSettings) -> float:
    """Return the bytes that one solve needs at its peak, libraries included, within about a factor of 1.5.

    Parameters
    ----------
    structure
        Of all integrations that are solved together.
    settings
        Whose solver is meant.
    """
    samples = structure.n_baselines * structure.n_frequencies
    visibilities = PAIRS * 2 * DOUBLE * samples
    buckets = structure.basis.buckets
    rows = structure.basis.n_coefficients
    widest = max(bucket.vectors.shape[1] for bucket in buckets)
    temporaries = 3 * DOUBLE * min(PIECE, structure.basis.n_models) * widest * structure.n_frequencies
    if not isinstance(settings.solver, GaussNewtonSettings):
        history = getattr(settings.solver, "memory", 0)
        unknowns = 2 * (rows + structure.n_antennas * structure.n_frequencies)
        absorbers = 2 * SINGLE * structure.basis.n_models * widest**2
        return LIBRARIES + visibilities + temporaries + absorbers + (2 * history + 12) * DOUBLE * unknowns
    if settings.calibrator == "sky-based":
        return LIBRARIES + visibilities + 4 * SINGLE * structure.n_antennas**2 * structure.n_frequencies
    absorbers = 3 * SINGLE * structure.basis.n_models * widest**2
    sequences = 2 * SINGLE * rows * structure.n_frequencies
    blocks = 4 * 2 * SINGLE * structure.n_antennas * structure.n_frequencies**2
    return LIBRARIES + visibilities + temporaries + absorbers + sequences + blocks
