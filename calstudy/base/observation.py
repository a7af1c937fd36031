"""Visibilities and the metadata of their array as plain arrays, extracted once from a UVData.

`Frame` has the metadata that are known before there are data: antennas, baselines, channels. `Observation` adds the
visibilities.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from calstudy.base.visibilities import antenna_pairs, flag_cube, positions, require_rectangular, to_cube

if TYPE_CHECKING:
    from pyuvdata import UVData


class Frame:
    """Antennas, baselines and channels. All arrays are read-only.

    Parameters
    ----------
    numbers : number of each antenna that is in a baseline, ascending, (Nants,) int
    positions : antenna positions, east, north, up, m, (Nants, 3)
    antennas : the two antennas (a, b) of each baseline as indices into `numbers`, (Nbls, 2) int
    frequencies : channel centres, Hz, (Nfreqs,)
    n_times, n_polarizations : numbers of integrations and polarizations
    """

    def __init__(
        self,
        numbers: np.ndarray,
        positions: np.ndarray,
        antennas: np.ndarray,
        frequencies: np.ndarray,
        n_times: int = 1,
        n_polarizations: int = 1,
    ) -> None:
        self.numbers, self.positions = read_only(numbers), read_only(positions)
        self.antennas, self.frequencies = read_only(antennas), read_only(frequencies)
        self.n_times, self.n_polarizations = n_times, n_polarizations

    @property
    def n_antennas(self) -> int:
        """Number of antennas that are in a baseline."""
        return len(self.numbers)

    @property
    def n_baselines(self) -> int:
        """Number of baselines, including autocorrelations if there are any."""
        return len(self.antennas)

    @property
    def n_channels(self) -> int:
        """Number of channels."""
        return len(self.frequencies)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of the visibilities, (Ntimes, Nbls, Nfreqs, Npols)."""
        return self.n_times, self.n_baselines, self.n_channels, self.n_polarizations

    @cached_property
    def pairs(self) -> np.ndarray:
        """Antenna numbers (a, b) of each baseline, (Nbls, 2)."""
        return read_only(self.numbers[self.antennas])

    @cached_property
    def autos(self) -> np.ndarray:
        """Whether each baseline is an autocorrelation, bool, (Nbls,)."""
        return read_only(self.antennas[:, 0] == self.antennas[:, 1])

    @cached_property
    def vectors(self) -> np.ndarray:
        """Baseline vectors x_b - x_a, east, north, up, m, (Nbls, 3)."""
        return read_only(self.positions[self.antennas[:, 1]] - self.positions[self.antennas[:, 0]])

    @cached_property
    def lengths(self) -> np.ndarray:
        """Baseline lengths, m, (Nbls,)."""
        return read_only(np.linalg.norm(self.vectors, axis=1))

    def antennas_of(self, used: np.ndarray) -> np.ndarray:
        """Return which antennas are in any of the used baselines: bool, (Nants, ...), of a mask (Nbls, ...)."""
        return np.stack([used[(self.antennas == row).any(axis=1)].any(axis=0) for row in range(self.n_antennas)])

    def baselines(self, chosen: np.ndarray) -> Frame:
        """Return the same with some of the baselines, selected by a bool array (Nbls,)."""
        kept, antennas = np.unique(self.antennas[chosen], return_inverse=True)
        numbers, places, sizes = self.numbers[kept], self.positions[kept], (self.n_times, self.n_polarizations)
        return Frame(numbers, places, antennas.reshape(-1, 2), self.frequencies, *sizes)


class Observation(Frame):
    """Visibilities of every baseline at every time, with their antennas, baselines and channels.

    They are of a UVData, rectangular and time-major: all baselines of the first integration, then of the second, and so
    on. It is not copied, and must not be changed afterwards. It may be without data; then there are no visibilities.
    Raises InputError if it is not rectangular.

    Attributes
    ----------
    times : Julian date of each integration, (Ntimes,)
    polarizations : AIPS numbers, such as -5 for XX, (Npols,)
    """

    def __init__(self, uvd: UVData) -> None:
        require_rectangular(uvd)
        numbers, antennas = np.unique(antenna_pairs(uvd), return_inverse=True)
        rows = positions(uvd.telescope.antenna_numbers, numbers)
        super().__init__(
            numbers,
            uvd.telescope.get_enu_antpos()[rows],
            antennas.reshape(-1, 2),
            np.array(uvd.freq_array, float).ravel(),
            int(uvd.Ntimes),
            int(uvd.Npols),
        )
        self._uvd = uvd
        self.times = read_only(np.array(uvd.time_array[:: uvd.Nbls]))
        self.polarizations = read_only(np.array(uvd.polarization_array))

    @cached_property
    def visibilities(self) -> np.ndarray:
        """Visibilities in the unit of the data, complex, (Ntimes, Nbls, Nfreqs, Npols)."""
        return read_only(to_cube(self._uvd))

    @cached_property
    def flags(self) -> np.ndarray:
        """Flags of the samples, bool, (Ntimes, Nbls, Nfreqs, Npols)."""
        return read_only(flag_cube(self._uvd))

    @cached_property
    def nsamples(self) -> np.ndarray:
        """Number of measurements of each sample, float64, (Ntimes, Nbls, Nfreqs, Npols)."""
        return read_only(np.asarray(self._uvd.nsample_array, float).reshape(self.shape))

    @cached_property
    def uvd(self) -> UVData:
        """The same as a UVData with read-only arrays of samples; ``uvd.copy()`` can be changed."""
        shell = self._uvd.copy(metadata_only=True)
        for name in ("data_array", "flag_array", "nsample_array"):
            if (samples := getattr(self._uvd, name)) is not None:
                setattr(shell, name, read_only(samples))
        return shell

    def baselines(self, chosen: np.ndarray) -> Observation:
        """Return the same with some of the baselines, selected by a bool array (Nbls,)."""
        if chosen.all():
            return self
        rows = np.flatnonzero(np.tile(chosen, self.n_times))
        return Observation(self._uvd.select(blt_inds=rows, inplace=False))


def read_only(array: np.ndarray) -> np.ndarray:
    """Return a view of an array that cannot be written to."""
    view = np.asarray(array).view()
    view.flags.writeable = False
    return view
