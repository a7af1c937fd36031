"""Foreground models of several baselines at once: one set of coefficients for vectors that differ between baselines.

A joint model of baselines p and channels f is F_p(f) = sum_i u_i A_i(p, f), with real vectors A and complex
coefficients u, as the foreground components of a group of baselines in the authors' code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np

from calstudy.base.errors import InputError

FIELD = "calibration.joint_basis"
# Singular values of normalized vectors below this, relative to the largest, are rounding.
SPAN_CUTOFF = 1e-9


@dataclass(frozen=True, eq=False)
class JointGroup:
    """Baselines that share their coefficients.

    Attributes
    ----------
    antennas
        Antenna numbers (a, b) of each baseline, shape (Nmembers, 2), integer. Data that have (b, a) are modelled with
        the conjugate.
    vectors
        Vectors of each baseline over all channels of the data in their order, shape (Nmembers, Nfreqs, Nvec), real.
        They need be neither orthogonal nor normalized: only their span over all baselines together matters.
    name
        Name in messages.

    Raises
    ------
    InputError
        For wrong shapes, antennas that are not integers, and vectors that are complex, not finite or all zero.
    """

    antennas: np.ndarray
    vectors: np.ndarray
    name: str = ""

    def __post_init__(self) -> None:
        where = f"{FIELD}, group {self.name!r}"
        antennas, vectors = np.asarray(self.antennas), np.asarray(self.vectors)
        if antennas.ndim != 2 or antennas.shape[1] != 2 or not len(antennas) or antennas.dtype.kind not in "iu":
            raise InputError(
                f"{where}: antennas have shape {antennas.shape} and type {antennas.dtype}, expected integers of shape "
                "(baselines, 2)"
            )
        if vectors.ndim != 3 or len(vectors) != len(antennas) or not vectors.size:
            raise InputError(
                f"{where}: vectors have shape {vectors.shape}, expected ({len(antennas)}, channels, vectors) for "
                f"{len(antennas)} baselines"
            )
        if vectors.dtype.kind not in "fiu":
            raise InputError(
                f"{where}: vectors are of type {vectors.dtype}, expected real numbers; the coefficients are complex"
            )
        if not np.isfinite(vectors).all():
            raise InputError(f"{where}: vectors are not finite")
        if not vectors.any():
            raise InputError(f"{where}: vectors are zero everywhere")
        object.__setattr__(self, "antennas", antennas)
        object.__setattr__(self, "vectors", vectors.astype(np.float64))


class PlacedGroup(NamedTuple):
    """A group in terms of the data: baselines (Nmembers,), conjugated (Nmembers,), orthonormal vectors."""

    baselines: np.ndarray
    conjugated: np.ndarray
    vectors: np.ndarray


def read_joint_groups(path: Path) -> tuple[JointGroup, ...]:
    """Read groups from an .npz file of arrays ``antennas_NAME`` and ``vectors_NAME``, a pair for every group.

    Raises InputError if the file cannot be read, holds other arrays or half a pair, or a group is invalid.
    """
    try:
        # Opened here, because np.load leaves a file open that is not an archive.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    # np.load takes a file that is not an archive for a pickle; a single array has no names.
    except (OSError, EOFError, ValueError, BadZipFile, AttributeError, TypeError) as error:
        raise InputError(f"{FIELD}.path: {path} cannot be read as an .npz file of plain arrays ({error})") from None
    groups = []
    for name in sorted({key.partition("_")[2] for key in arrays}):
        antennas, vectors = arrays.get(f"antennas_{name}"), arrays.get(f"vectors_{name}")
        if antennas is None or vectors is None:
            break
        groups.append(JointGroup(antennas, vectors, name))
    if not groups or 2 * len(groups) != len(arrays):
        raise InputError(
            f"{FIELD}.path: {path} holds {', '.join(arrays) or 'nothing'}, expected arrays antennas_NAME and "
            "vectors_NAME, both for every group"
        )
    return tuple(groups)


def place_groups(groups: Sequence[JointGroup], antennas: np.ndarray, n_frequencies: int) -> list[PlacedGroup]:
    """Find the baselines of groups in the data, and orthonormalize their vectors.

    `antennas` are the antenna numbers of the data's baselines, (Nbls, 2). Raises InputError if a group has another
    number of channels, a baseline that the data lack or that occurs twice, or as many independent vectors as samples.
    """
    rows = {(int(a), int(b)): index for index, (a, b) in enumerate(antennas)}
    seen: set[int] = set()
    placed = []
    for group in groups:
        where = f"{FIELD}, group {group.name!r}"
        if group.vectors.shape[1] != n_frequencies:
            raise InputError(
                f"{where}: vectors have {group.vectors.shape[1]} channels, and the data have {n_frequencies}"
            )
        baselines, conjugated = [], []
        for a, b in group.antennas.tolist():
            index = rows.get((a, b), rows.get((b, a)))
            if index is None:
                raise InputError(f"{where}: baseline ({a}, {b}) is not among those that are calibrated")
            if index in seen:
                raise InputError(f"{where}: baseline ({a}, {b}) is there twice, in this group or in another")
            seen.add(index)
            baselines.append(index)
            conjugated.append((a, b) not in rows)
        vectors = orthonormal(group.vectors)
        if vectors.shape[2] >= len(baselines) * n_frequencies:
            raise InputError(
                f"{where}: {vectors.shape[2]} independent vectors fill all {len(baselines) * n_frequencies} samples of "
                f"its {len(baselines)} baselines, so that foregrounds would fit any data"
            )
        placed.append(PlacedGroup(np.array(baselines), np.array(conjugated), vectors))
    return placed


def other_baselines(placed: Sequence[PlacedGroup], n_baselines: int) -> np.ndarray:
    """Return the indices of the baselines that are in no group."""
    others = np.ones(n_baselines, bool)
    for group in placed:
        others[group.baselines] = False
    return np.flatnonzero(others)


def orthonormal(vectors: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis, over all baselines together, of the span of vectors (Nmembers, Nfreqs, Nvec)."""
    stacked = vectors.reshape(-1, vectors.shape[2])
    norms = np.linalg.norm(stacked, axis=0)
    left, singular, _ = np.linalg.svd(stacked[:, norms > 0] / norms[norms > 0], full_matrices=False)
    kept = left[:, singular > SPAN_CUTOFF * singular[0]]
    return np.ascontiguousarray(kept).reshape(*vectors.shape[:2], -1)
