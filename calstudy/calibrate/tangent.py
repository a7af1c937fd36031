"""The directions into which a fit can follow the data, whitened, and the delay modes they are told by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calstudy.calibrate.basis import channel_grid
from calstudy.calibrate.problem import CalibrationProblem, gain_products
from calstudy.power.delay import make_taper

TAPER = "blackman-harris"
# Singular values of weighted sequences below this, relative to the largest, belong to what flags left undetermined; the
# solvers' ridge on their squares is the square of it.
SPAN_CUTOFF = 1e-6


class DelayModes:
    """Tapered delay modes of a band, with or without gaps.

    Parameters
    ----------
    frequency
        Channel centres on an even grid, Hz, (Nfreqs,).
    taper
        See `calstudy.power.delay.TAPERS`.
    """

    def __init__(self, frequency: np.ndarray, taper: str = TAPER) -> None:
        grid = channel_grid(np.asarray(frequency, float))
        self._grid = grid
        self.delay = np.fft.fftshift(np.fft.fftfreq(grid.n_channels, grid.width))
        self.weights = make_taper(taper, grid.n_channels)[grid.positions]

    def amplitudes(self, values: np.ndarray) -> np.ndarray:
        """Return f* values for every delay: frequency is the last axis, (..., Nfreqs) to (..., Ndelays)."""
        padded = np.zeros((*values.shape[:-1], self._grid.n_channels), complex)
        padded[..., self._grid.positions] = values * self.weights
        transformed = np.fft.ifft(padded, axis=-1, norm="forward")
        return np.fft.fftshift(transformed, axes=-1)


@dataclass(frozen=True, eq=False)
class Tangent:
    """The tangent space of a fit, whitened.

    Attributes
    ----------
    roots
        Square root of D, (Nbls, Nfreqs).
    slope
        sqrt(D) F: what a relative change of a gain does to the baseline, (Nbls, Nfreqs), complex.
    conjugated
        Baselines that see the conjugate of their model, (Nbls,) bool.
    sequences
        For each model, or joint bucket of models, its baselines, and orthonormal sequences on all of them,
        (Nmembers, Nfreqs, Nkept), real.
    """

    roots: np.ndarray
    slope: np.ndarray
    conjugated: np.ndarray
    sequences: tuple[tuple[np.ndarray, np.ndarray], ...]

    @classmethod
    def at(cls, problem: CalibrationProblem, gains: np.ndarray, model: np.ndarray) -> Tangent:
        """Return the tangent space at gains (Nants, Nfreqs) and model (Nbls, Nfreqs)."""
        structure = problem.structure
        curvature = problem.weights * np.abs(gain_products(gains, structure.antennas)) ** 2
        roots = np.sqrt(curvature)
        sequences = []
        if not problem.frozen:
            for bucket in structure.basis.buckets:
                if bucket.joint:
                    row, members = np.nonzero(structure.groups == bucket.members[:, None])
                    sequences.append((members, _orthonormal(roots[members], bucket.vectors[row])))
                    continue
                for index in bucket.members:
                    members = np.flatnonzero(structure.groups == index)
                    sequences.append((members, _orthonormal(roots[members], bucket.vectors)))
        return cls(roots, roots * model, structure.conjugated, tuple(sequences))

    def free_of_foregrounds(self, values: np.ndarray) -> np.ndarray:
        """Return what foregrounds cannot follow of whitened changes (Nbls, Nfreqs, ...), complex."""
        result = values.copy()
        result[self.conjugated] = result[self.conjugated].conj()
        for members, vectors in self.sequences:
            stacked = vectors.reshape(vectors.shape[0] * vectors.shape[1], vectors.shape[2])
            rows = result[members].reshape(len(stacked), -1)
            result[members] = (rows - stacked @ (stacked.T @ rows)).reshape(result[members].shape)
        result[self.conjugated] = result[self.conjugated].conj()
        return result

    def absorbed(self, modes: DelayModes) -> np.ndarray:
        """Return <f|P_F|f>, what the foregrounds absorb of unnormalized modes, (Nbls, Ndelays)."""
        found = np.zeros((len(self.roots), modes.delay.size))
        for members, vectors in self.sequences:
            spectra = modes.amplitudes(np.moveaxis(vectors, 2, 1))
            found[members] = np.sum(np.abs(spectra) ** 2, axis=1)
        return found


def _orthonormal(roots: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the sequences, weighted by `roots` (Nmembers, Nfreqs).

    The sequences are (Nfreqs, Nvec), the same on all members, or (Nmembers, Nfreqs, Nvec).
    """
    weighted = (roots[:, :, None] * vectors).reshape(-1, vectors.shape[-1])
    left, singular, _ = np.linalg.svd(weighted, full_matrices=False)
    kept = singular > SPAN_CUTOFF * max(singular[0], np.finfo(float).tiny)
    return left[:, kept].reshape(*roots.shape, -1)
