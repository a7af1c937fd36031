"""The tangent space of a fit at its solution: the response of gains and foregrounds to a small change of the data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calstudy.calibrate.problem import CalibrationProblem, gain_products

# Singular values of weighted sequences below this, relative to the largest, are those that flags left undetermined; the
# solvers' ridge on their squares is the square of it.
SPAN_CUTOFF = 1e-6


@dataclass(frozen=True, eq=False)
class Response:
    """The part of a whitened change y that foregrounds of some baselines absorb: own own^T y + common common^T y.

    `members` are indices of the baselines. Common sequences on all of them together are real, (Nmembers, Nfreqs, Nvec),
    and orthonormal unless there is a finite prior; those of each baseline by itself are of the same kind, None if there
    are none.
    """

    members: np.ndarray
    common: np.ndarray
    own: np.ndarray | None = None

    @property
    def sequences(self) -> np.ndarray:
        """Sequences of each baseline by itself, then the common ones, (Nmembers, Nfreqs, Nall)."""
        return self.common if self.own is None else np.concatenate([self.own, self.common], axis=2)

    def absorb(self, rows: np.ndarray) -> np.ndarray:
        """Return the absorbed part of changes of the members, (Nmembers, Nfreqs, ...)."""
        flat = rows.reshape(*rows.shape[:2], -1)
        found = self.common @ np.einsum("pfv,pfc->vc", self.common, flat, optimize=True)
        if self.own is not None:
            found = found + self.own @ (np.swapaxes(self.own, 1, 2) @ flat)
        return found.reshape(rows.shape)


@dataclass(frozen=True, eq=False)
class TangentSpace:
    """The tangent space of a fitted problem, in units in which the noise of the likelihood is white.

    `roots` is the square root of D, (Nbls, Nfreqs), and `slope` is sqrt(D) F, the derivative of a baseline in a
    relative change of a gain, (Nbls, Nfreqs), complex.
    """

    problem: CalibrationProblem
    roots: np.ndarray
    slope: np.ndarray

    @classmethod
    def at(cls, problem: CalibrationProblem, gains: np.ndarray, model: np.ndarray) -> TangentSpace:
        """Return the tangent space at a solution, gains (Nants, Nfreqs) and model (Nbls, Nfreqs)."""
        curvature = problem.weights * np.abs(gain_products(gains, problem.structure.antennas)) ** 2
        roots = np.sqrt(curvature)
        return cls(problem, roots, roots * model)

    @property
    def conjugated(self) -> np.ndarray:
        """Baselines that have the conjugate of their model, bool, (Nbls,)."""
        return self.problem.structure.conjugated

    @property
    def finite(self) -> bool:
        """Whether the foregrounds have a finite prior."""
        return self.problem.structure.prior != "none"

    @cached_property
    def responses(self) -> tuple[Response, ...]:
        """Responses of the foregrounds, one for each model."""
        problem, found = self.problem, []
        for bucket in () if problem.frozen else problem.structure.basis.buckets:
            for index in bucket.members:
                members = np.flatnonzero(problem.structure.groups == index)
                found.append(_response(problem, members, self.roots[members], bucket.vectors))
        return tuple(found)

    @property
    def n_sequences(self) -> int:
        """Number of sequences of all foregrounds."""
        return sum(response.sequences.shape[2] for response in self.responses)

    def without_foregrounds(self, values: np.ndarray) -> np.ndarray:
        """Return W y of whitened changes y, (1 - P_F) y if foregrounds are free; complex, (Nbls, Nfreqs, ...)."""
        result = values.copy()
        result[self.conjugated] = result[self.conjugated].conj()
        for response in self.responses:
            rows = result[response.members]
            result[response.members] = rows - response.absorb(rows)
        result[self.conjugated] = result[self.conjugated].conj()
        return result


def _response(problem: CalibrationProblem, members: np.ndarray, roots: np.ndarray, vectors: np.ndarray) -> Response:
    """Return the response of one foreground model, with the sequences (Nfreqs, Nvec), on its baselines.

    `roots` is the square root of D on the members, (Nmembers, Nfreqs). With a finite prior, the vectors are for
    coefficients of unit variance, in units of the prior's deviation.
    """
    prior, (own, shared) = problem.structure.prior, problem.deviations
    if prior == "none":
        return Response(members, orthonormal(roots, vectors))
    weighted = roots[:, :, None] * vectors
    if prior != "both":
        weighted = weighted * (own if prior == "own" else shared)
        return Response(members, _smoothing(weighted, weighted))
    alone = np.stack([_smoothing(own * part[None], own * part[None])[0] for part in weighted])
    left = weighted - alone @ (np.swapaxes(alone, 1, 2) @ weighted)
    return Response(members, _smoothing(shared * weighted, shared * left), alone)


def _smoothing(sequences: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Return Q with Q Q^T = W B (1 + B^T W B)^-1 B^T W, for B and W B of shape (Nmembers, Nfreqs, Nvec)."""
    values, turned = np.linalg.eigh(np.einsum("pfv,pfu->vu", sequences, left, optimize=True))
    return left @ (turned / np.sqrt(1 + np.maximum(values, 0)))


def orthonormal(roots: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the sequences (Nfreqs, Nvec), weighted by `roots` (Nmembers, Nfreqs)."""
    weighted = (roots[:, :, None] * vectors).reshape(-1, vectors.shape[-1])
    left, singular, _ = np.linalg.svd(weighted, full_matrices=False)
    kept = singular > SPAN_CUTOFF * max(singular[0], np.finfo(float).tiny)
    return left[:, kept].reshape(*roots.shape, -1)
