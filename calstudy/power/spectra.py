"""Delay spectra as plain arrays, the input of the cylindrical and spherical averages.

A *unit* is one sample of the sky: a baseline crossed with itself, or a redundant group whose baselines are crossed with
each other. The pairs of a unit share the signal; their noise products are independent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calstudy.power.cosmology import k_parallel, k_perpendicular, make_cosmology

if TYPE_CHECKING:
    from hera_pspec import UVPSpec

    from calstudy.power.settings import PowerSettings


@dataclass(frozen=True)
class DelaySpectra:
    """Delay power spectra of Nu units at Nd delays, averaged over the pairs and polarizations of each unit.

    Attributes
    ----------
    power
        Even times odd, (Nu, Nd) complex, mK^2 h^-3 Mpc^3; its real part estimates P(k).
    vectors
        East, north, up in m, (Nu, 3): mean of the unit's baselines.
    n_pairs
        Baseline pairs in each unit, (Nu,).
    n_polarizations
        Polarizations averaged.
    delay
        s, ascending, (Nd,).
    k_perp, k_parallel
        h/Mpc, (Nu,) and (Nd,), at the band centre.
    frequency
        Band centre in Hz.
    omega_pp
        Integral of the squared power beam in sr, mean over band and polarizations.
    taper
        Name of the taper, see `calstudy.power.delay.TAPERS`.
    """

    power: np.ndarray
    vectors: np.ndarray
    n_pairs: np.ndarray
    n_polarizations: int
    delay: np.ndarray
    k_perp: np.ndarray
    k_parallel: np.ndarray
    frequency: float
    omega_pp: float
    taper: str

    @property
    def length(self) -> np.ndarray:
        """Baseline lengths in m, (Nu,)."""
        return np.linalg.norm(self.vectors, axis=1)


def delay_spectra(uvp: UVPSpec, settings: PowerSettings) -> DelaySpectra:
    """Gather the pairs of a `UVPSpec` into units.

    Parameters
    ----------
    uvp
        As `calstudy.power.estimate.estimate_power` makes it, one spectral window and one pair of times.
    settings
        Taper and cosmology with which `uvp` was made.

    Raises
    ------
    ValueError
        If `uvp` has several spectral windows or times.
    """
    if uvp.Nspws != 1 or uvp.Nbltpairs != uvp.Nblpairs:
        raise ValueError(f"the spectra have {uvp.Nspws} spectral windows and {uvp.Ntpairs} times, expected 1 and 1")
    pairs = np.column_stack(np.divmod(uvp.blpair_array, 10**6))
    unit, vectors = _units(uvp, pairs)
    power = np.zeros((len(vectors), uvp.Ndlys), dtype=complex)
    np.add.at(power, unit, uvp.data_array[0].mean(axis=2))
    n_pairs = np.bincount(unit)
    cosmology, frequency = make_cosmology(settings.cosmology), float(uvp.freq_array.mean())
    return DelaySpectra(
        power=power / n_pairs[:, None],
        vectors=vectors,
        n_pairs=n_pairs,
        n_polarizations=uvp.Npols,
        delay=uvp.dly_array.copy(),
        k_perp=k_perpendicular(cosmology, np.linalg.norm(vectors, axis=1), frequency),
        k_parallel=k_parallel(cosmology, uvp.dly_array, frequency),
        frequency=frequency,
        omega_pp=float(uvp.OmegaPP.mean()),
        taper=settings.taper,
    )


def _units(uvp: UVPSpec, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number the units, baselines connected by `pairs` (Npairs, 2): unit of each pair, mean vector of each unit."""
    baselines, positions = np.unique(pairs, return_inverse=True)
    first, second = positions.reshape(pairs.shape).T
    graph = coo_array((np.ones(first.size), (first, second)), shape=(baselines.size, baselines.size))
    _, label = connected_components(graph, directed=False)
    order = np.argsort(uvp.bl_array)
    rows = order[np.searchsorted(uvp.bl_array, baselines, sorter=order)]
    # hera_pspec stores x_a - x_b.
    vectors = -uvp.get_ENU_bl_vecs()[rows]
    mean = np.stack([np.bincount(label, vectors[:, axis]) for axis in range(3)], axis=1) / np.bincount(label)[:, None]
    return label[first], mean
