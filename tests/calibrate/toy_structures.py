"""Structures of fits of the toy array, and dense counterparts of what solvers do with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from toy import BASIS, FREQUENCIES

from calstudy.calibrate.basis import make_basis
from calstudy.calibrate.problem import FitStructure, gain_products
from calstudy.instrument.layouts import redundant_groups

OWN, SHARED = 0.7, 1.9


def redundant_structure(toy):
    # Turning some baselines around makes conjugated members, which a list with a < b on a hexagon may lack.
    antennas = np.where(np.arange(len(toy.antennas))[:, None] % 2, toy.antennas[:, ::-1], toy.antennas)
    vectors = toy.positions[antennas[:, 1]] - toy.positions[antennas[:, 0]]
    groups = redundant_groups(vectors, 0.1)
    lengths = [np.linalg.norm(vectors[groups.index == group], axis=1).max() for group in range(groups.index.max() + 1)]
    basis = make_basis(np.array(lengths), FREQUENCIES, BASIS)
    assert groups.conjugated.any()
    assert basis.n_models < len(antennas)
    return FitStructure(antennas, len(toy.positions), basis, groups.index, groups.conjugated)


def prior_structure(toy, prior):
    """The toy's baselines, some of them turned around, by redundant groups unless all coefficients are their own."""
    structure = redundant_structure(toy)
    lengths = np.linalg.norm(toy.positions[structure.antennas[:, 1]] - toy.positions[structure.antennas[:, 0]], axis=1)
    if prior == "own":
        basis = make_basis(lengths, FREQUENCIES, BASIS, prior=True)
        return replace(FitStructure.per_baseline(structure.antennas, len(toy.positions), basis), prior=prior)
    longest = np.zeros(structure.basis.n_models)
    np.maximum.at(longest, structure.groups, lengths)
    return replace(structure, basis=make_basis(longest, FREQUENCIES, BASIS, prior=True), prior=prior)


def dense_covariance(structure, own=OWN, shared=SHARED):
    """C of all samples, (Nbls Nfreqs) squared, for visibilities of which conjugated ones are turned back."""
    vectors = [None] * structure.basis.n_models
    for bucket in structure.basis.buckets:
        for index in bucket.members:
            vectors[index] = bucket.vectors
    n = structure.n_frequencies
    result = np.zeros((structure.n_baselines, n, structure.n_baselines, n))
    for p, group in enumerate(structure.groups):
        covariance = vectors[group] @ vectors[group].T
        if structure.prior in ("own", "both"):
            result[p, :, p] += own**2 * covariance
        if structure.prior in ("shared", "both"):
            for q in np.flatnonzero(structure.groups == group):
                result[p, :, q] += shared**2 * covariance
    return result.reshape(structure.n_baselines * n, -1)


def turned(structure, values):
    return np.where(structure.conjugated[:, None], values.conj(), values)


def free_structure(toy):
    """The toy's own baselines, each with a prior of its own."""
    basis = make_basis(np.linalg.norm(toy.vectors, axis=1), FREQUENCIES, BASIS, prior=True)
    return replace(FitStructure.per_baseline(toy.antennas, len(toy.positions), basis), prior="own")


def in_the_span(toy):
    """The foregrounds as the basis can hold them exactly."""
    foregrounds = toy.foregrounds.copy()
    for bucket in toy.basis.buckets:
        foregrounds[bucket.members] = foregrounds[bucket.members] @ bucket.vectors @ bucket.vectors.T
    return foregrounds


def product_error(problem, solution):
    """Largest difference between g g* F and the data where they are used, relative to the data's rms."""
    used = problem.weights > 0
    data = problem.visibilities[used]
    fitted = (gain_products(solution.gains, problem.structure.antennas) * solution.model)[used]
    return np.abs(fitted - data).max() / np.sqrt(np.mean(np.abs(data) ** 2))
