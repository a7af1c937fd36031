"""From visibilities and settings to the structure of a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pyuvdata import UVData

from calstudy.calibrate.basis import Bucket, ForegroundBasis, make_basis
from calstudy.calibrate.gain_space import gain_vectors
from calstudy.calibrate.joint import JointGroup, PlacedGroup, other_baselines, place_groups, read_joint_groups
from calstudy.calibrate.problem import FitStructure
from calstudy.calibrate.settings import CalibrationSettings
from calstudy.errors import InputError
from calstudy.instrument.layouts import redundant_groups
from calstudy.visibilities import antenna_pairs, baseline_vectors


def make_structure(
    data: UVData, settings: CalibrationSettings, joint: Sequence[JointGroup] = ()
) -> tuple[FitStructure, np.ndarray]:
    """Return the structure of the fit of one integration, and the antenna numbers that its indices stand for.

    A redundant group is modelled with the basis of its longest baseline; baselines of a joint group belong to no other.

    Parameters
    ----------
    data, settings
        Visibilities that are fitted, and how.
    joint
        Groups of baselines with common coefficients, before what `settings.joint_basis` says.

    Raises
    ------
    ValueError
        If the basis does not fit into the channels (see `calstudy.calibrate.basis.make_basis`).
    InputError
        If joint groups cannot be read, do not fit the data (see `calstudy.calibrate.joint.place_groups`), or
        foregrounds are frozen.
    """
    numbers, antennas = np.unique(antenna_pairs(data), return_inverse=True)
    antennas = antennas.reshape(-1, 2)
    frequencies = np.asarray(data.freq_array, float)
    if not joint and settings.joint_basis is not None:
        joint = read_joint_groups(settings.joint_basis.path)
    if settings.calibrator == "sky-based":
        if joint:
            raise InputError("calibration.calibrator: 'sky-based' has no foreground model, and joint groups are given")
        structure = FitStructure.per_baseline(antennas, len(numbers), _no_basis(len(antennas), frequencies.size))
    else:
        placed = place_groups(joint, numbers[antennas], frequencies.size)
        others = other_baselines(placed, len(antennas))
        structure = None
        if others.size:
            vectors = baseline_vectors(data)[others]
            structure = _modelled(antennas[others], len(numbers), vectors, frequencies, settings)
        if placed:
            structure = _with_joint(antennas, len(numbers), structure, others, placed)
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


def _with_joint(
    antennas: np.ndarray, n_antennas: int, rest: FitStructure | None, others: np.ndarray, placed: Sequence[PlacedGroup]
) -> FitStructure:
    """Return the structure of joint groups, and of the other baselines as they are in `rest`, None without any."""
    groups, conjugated = np.empty(len(antennas), int), np.zeros(len(antennas), bool)
    buckets: list[Bucket] = []
    n_models = 0
    if rest is not None:
        groups[others], conjugated[others] = rest.groups, rest.conjugated
        buckets, n_models = list(rest.basis.buckets), rest.basis.n_models
    for group in placed:
        members = n_models + np.arange(group.baselines.size)
        groups[group.baselines], conjugated[group.baselines] = members, group.conjugated
        buckets.append(Bucket(None, members, group.vectors))
        n_models += members.size
    basis = ForegroundBasis(tuple(buckets), n_models, placed[0].vectors.shape[1])
    return FitStructure(antennas, n_antennas, basis, groups, conjugated)


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
    buckets: list[Bucket] = []
    for bucket in structure.basis.buckets:
        members = bucket.members + offsets
        # Members of a joint bucket have one set of coefficients, of which every integration needs its own.
        parts = members if bucket.joint else [members.ravel()]
        buckets += [replace(bucket, members=part) for part in parts]
    return replace(
        structure,
        antennas=np.tile(structure.antennas, (count, 1)),
        basis=ForegroundBasis(tuple(buckets), count * n_models, structure.n_frequencies),
        groups=(structure.groups + offsets).ravel(),
        conjugated=np.tile(structure.conjugated, count),
    )
