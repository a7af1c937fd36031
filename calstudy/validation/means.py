"""Means over modes of recovered spectra, with their errors."""

from __future__ import annotations

import numpy as np

from calstudy.verdicts.statement import Finding


def clustered_mean(values: np.ndarray, weights: np.ndarray | None = None) -> Finding:
    """Return the mean over (Nunits, Nmodes) and its standard error, with the modes of each unit as one sample.

    Modes that are NaN are left out. `weights` are those of the units, (Nunits,); equal by default.
    """
    used = np.isfinite(values)
    scale = np.ones(len(values)) if weights is None else np.asarray(weights, float)
    sums, counts = scale * np.where(used, values, 0).sum(axis=1), scale * used.sum(axis=1)
    filled = counts > 0
    if not filled.any():
        return Finding(np.nan, np.nan)
    mean = sums.sum() / counts.sum()
    deviations = (sums - mean * counts)[filled]
    error = np.sqrt(np.sum(deviations**2) * filled.sum() / max(filled.sum() - 1, 1)) / counts.sum()
    return Finding(float(mean), float(error))


def pooled(findings: list[Finding]) -> Finding:
    """Return the mean of independent measurements of one number, weighted by their inverse variances."""
    weights = np.array([finding.uncertainty**-2 for finding in findings])
    values = np.array([finding.value for finding in findings])
    return Finding(float(np.sum(weights * values) / weights.sum()), float(weights.sum() ** -0.5))
