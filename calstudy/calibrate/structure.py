"""Build the structure of a fit from baselines and settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calstudy.base.observation import Frame
from calstudy.calibrate.basis import Bucket, ForegroundBasis, gain_vectors, make_basis
from calstudy.calibrate.problem import FitStructure
from calstudy.calibrate.settings import ForegroundFit, GainFit
from calstudy.instrument.layouts import redundant_groups


def make_structure(frame: Frame, settings: GainFit) -> FitStructure:
    """Return the structure of the fit of one integration; its antennas are those of the frame.

    A redundant group is modelled with the basis of its longest baseline. Raises InputError if the basis does not fit
    into the channels (see `calstudy.calibrate.basis.make_basis`).
    """
    if isinstance(settings, ForegroundFit) and not settings.frozen:
        structure = _foregrounds(frame, settings)
    else:
        basis = _no_basis(frame.n_baselines, frame.n_channels)
        structure = FitStructure.per_baseline(frame.antennas, frame.n_antennas, basis)
    if settings.gain_delay is not None:
        vectors = gain_vectors(frame.frequencies, settings.gain_delay)
        structure = replace(structure, gain_vectors=vectors)
    return replace(structure, models_at_once=settings.models_at_once)


def _foregrounds(frame: Frame, settings: ForegroundFit) -> FitStructure:
    prior = settings.foreground_prior
    if not settings.grouped:
        basis = make_basis(frame.lengths, frame.frequencies, settings.basis, prior.finite)
        structure = FitStructure.per_baseline(frame.antennas, frame.n_antennas, basis)
        return replace(structure, prior="own") if prior.finite else structure
    groups = redundant_groups(frame.vectors, settings.redundancy_tolerance)
    longest = np.zeros(groups.index.max() + 1)
    np.maximum.at(longest, groups.index, frame.lengths)
    basis = make_basis(longest, frame.frequencies, settings.basis, prior.finite)
    structure = FitStructure(frame.antennas, frame.n_antennas, basis, groups.index, groups.conjugated)
    if not prior.finite:
        return structure
    return replace(structure, prior="shared" if prior.deviation == 0 else "both")


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
    buckets = [replace(bucket, members=(bucket.members + offsets).ravel()) for bucket in structure.basis.buckets]
    return replace(
        structure,
        antennas=np.tile(structure.antennas, (count, 1)),
        basis=ForegroundBasis(tuple(buckets), count * n_models, structure.n_frequencies),
        groups=(structure.groups + offsets).ravel(),
        conjugated=np.tile(structure.conjugated, count),
    )
