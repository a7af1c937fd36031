"""Build the structure of a fit from baselines and settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calstudy.base.observation import Frame
from calstudy.calibrate.basis import Bucket, ForegroundBasis, gain_vectors, make_basis
from calstudy.calibrate.joint import PlacedGroup, other_baselines, place_groups, read_joint_groups
from calstudy.calibrate.problem import FitStructure
from calstudy.calibrate.settings import BasisSettings, ForegroundFit, GainFit
from calstudy.instrument.layouts import redundant_groups


def make_structure(frame: Frame, settings: GainFit) -> FitStructure:
    """Return the structure of the fit of one integration; its antennas are those of the frame.

    A redundant group is modelled with the basis of its longest baseline; baselines of a joint group belong to no other.
    Raises InputError if the basis does not fit into the channels (see `calstudy.calibrate.basis.make_basis`), or if
    joint groups cannot be read or do not fit the data (see `calstudy.calibrate.joint.place_groups`).
    """
    if isinstance(settings, ForegroundFit) and not settings.frozen:
        structure = _foregrounds(frame, settings)
        cutoff = settings.basis.eigenvalue_cutoff
    else:
        basis = _no_basis(frame.n_baselines, frame.n_channels)
        structure = FitStructure.per_baseline(frame.antennas, frame.n_antennas, basis)
        cutoff = BasisSettings().eigenvalue_cutoff
    if settings.gain_delay is not None:
        vectors = gain_vectors(frame.frequencies, settings.gain_delay, cutoff)
        structure = replace(structure, gain_vectors=vectors)
    return replace(structure, models_at_once=settings.models_at_once)


def _foregrounds(frame: Frame, settings: ForegroundFit) -> FitStructure:
    joint = () if settings.joint_basis is None else read_joint_groups(settings.joint_basis.path)
    placed = place_groups(joint, frame.pairs, frame.n_channels)
    others = other_baselines(placed, frame.n_baselines)
    if not placed:
        return _modelled(frame, others, settings)
    rest = _modelled(frame, others, settings) if others.size else None
    return _with_joint(frame, rest, others, placed)


def _modelled(frame: Frame, chosen: np.ndarray, settings: ForegroundFit) -> FitStructure:
    """Return the structure of the chosen baselines, in the DPSS basis."""
    antennas, vectors = frame.antennas[chosen], frame.vectors[chosen]
    lengths = np.linalg.norm(vectors, axis=1)
    prior = settings.foreground_prior
    if not settings.grouped:
        basis = make_basis(lengths, frame.frequencies, settings.basis, prior.finite)
        structure = FitStructure.per_baseline(antennas, frame.n_antennas, basis)
        return replace(structure, prior="own") if prior.finite else structure
    groups = redundant_groups(vectors, settings.redundancy_tolerance)
    longest = np.zeros(groups.index.max() + 1)
    np.maximum.at(longest, groups.index, lengths)
    basis = make_basis(longest, frame.frequencies, settings.basis, prior.finite)
    structure = FitStructure(antennas, frame.n_antennas, basis, groups.index, groups.conjugated)
    if not prior.finite:
        return structure
    return replace(structure, prior="shared" if prior.deviation == 0 else "both")


def _with_joint(
    frame: Frame, rest: FitStructure | None, others: np.ndarray, placed: Sequence[PlacedGroup]
) -> FitStructure:
    """Add joint groups to the structure of the other baselines, `rest`, which is None if there are none."""
    groups, conjugated = np.empty(frame.n_baselines, int), np.zeros(frame.n_baselines, bool)
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
    return FitStructure(frame.antennas, frame.n_antennas, basis, groups, conjugated)


def _no_basis(n_models: int, n_frequencies: int) -> ForegroundBasis:
    """Return a placeholder basis, a constant, for frozen foregrounds, which have no coefficients to fit."""
    constant = np.full((n_frequencies, 1), n_frequencies**-0.5)
    return ForegroundBasis((Bucket(0.0, np.arange(n_models), constant),), n_models, n_frequencies)


def repeat_structure(structure: FitStructure, count: int) -> FitStructure:
    """Return the structure of `count` integrations that share their gains, and have their own foregrounds each.

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
