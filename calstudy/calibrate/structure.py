"""From visibilities and settings to the structure of a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pyuvdata import UVData

from calstudy.calibrate.basis import Bucket, ForegroundBasis, make_basis
from calstudy.calibrate.gain_space import gain_vectors
from calstudy.calibrate.problem import FitStructure
from calstudy.calibrate.settings import CalibrationSettings
from calstudy.instrument.layouts import redundant_groups
from calstudy.visibilities import antenna_pairs, baseline_vectors


def make_structure(data: UVData, settings: CalibrationSettings) -> tuple[FitStructure, np.ndarray]:
    """Return the structure of the fit of one integration, and the antenna numbers that its indices stand for.

    A redundant group is modelled with the basis of its longest baseline.

    Raises
    ------
    ValueError
        If the basis does not fit into the channels (see `calstudy.calibrate.basis.make_basis`).
    """
    numbers, antennas = np.unique(antenna_pairs(data), return_inverse=True)
    antennas = antennas.reshape(-1, 2)
    frequencies = np.asarray(data.freq_array, float)
    if settings.calibrator == "sky-based":
        structure = FitStructure.per_baseline(antennas, len(numbers), _no_basis(len(antennas), frequencies.size))
    else:
        structure = _modelled(antennas, len(numbers), baseline_vectors(data), frequencies, settings)
    if settings.gain_delay is not None:
        vectors = gain_vectors(frequencies, settings.gain_delay, settings.basis.eigenvalue_cutoff)
        structure = replace(structure, gain_vectors=vectors)
    return replace(structure, models_at_once=settings.models_at_once), numbers


def _modelled(
    antennas: np.ndarray, n_antennas: int, vectors: np.ndarray, frequencies: np.ndarray, settings: CalibrationSettings
) -> FitStructure:
    lengths = np.linalg.norm(vectors, axis=1)
    if settings.calibrator == "calamity":
        return FitStructure.per_baseline(antennas, n_antennas, make_basis(lengths, frequencies, settings.basis))
    groups = redundant_groups(vectors, settings.redundancy_tolerance)
    longest = np.zeros(groups.index.max() + 1)
    np.maximum.at(longest, groups.index, lengths)
    basis = make_basis(longest, frequencies, settings.basis)
    return FitStructure(antennas, n_antennas, basis, groups.index, groups.conjugated)


def _no_basis(n_models: int, n_frequencies: int) -> ForegroundBasis:
    """Return a basis for frozen foregrounds, which have no coefficients to fit: a constant, never used."""
    constant = np.full((n_frequencies, 1), n_frequencies**-0.5)
    return ForegroundBasis((Bucket(0.0, np.arange(n_models), constant),), n_models, n_frequencies)


def repeat_structure(structure: FitStructure, count: int) -> FitStructure:
    """Return the structure of `count` integrations that share their gains, and each have foregrounds of their own.

    Baselines and models of the first integration come first, then those of the second, and so on.
    """
    if count == 1:
        return structure
    n_models = structure.basis.n_models
    offsets = n_models * np.arange(count)[:, None]
    buckets = tuple(replace(bucket, members=(bucket.members + offsets).ravel()) for bucket in structure.basis.buckets)
    return replace(
        structure,
        antennas=np.tile(structure.antennas, (count, 1)),
        basis=ForegroundBasis(buckets, count * n_models, structure.n_frequencies),
        groups=(structure.groups + offsets).ravel(),
        conjugated=np.tile(structure.conjugated, count),
    )
