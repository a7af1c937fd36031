"""Read single antennas and baselines from products; of several polarizations, by default the first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyuvdata import UVCal, UVData

from calstudy.base.errors import InputError
from calstudy.base.visibilities import flag_cube, rows_of, to_cube
from calstudy.calibrate.degeneracy import align
from calstudy.instrument.layouts import Layout
from calstudy.products.files import GAINS


@dataclass(frozen=True)
class Gains:
    """Gains of all antennas.

    Antenna numbers are ascending, (Nants,), channel centres in Hz, (Nfreqs,). Values are complex, (Ntimes, Nants,
    Nfreqs), or (1, Nants, Nfreqs) for gains that are constant during the run; flags of the same shape mark missing
    solutions. Times are Julian dates, (Ntimes,), None for constant gains; `integration` is the duration of one, s.
    """

    numbers: np.ndarray
    frequency: np.ndarray
    values: np.ndarray
    flags: np.ndarray
    times: np.ndarray | None
    integration: float

    def at(self, integration: int, numbers: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return the gains of some antennas at one integration of the run, (len(numbers), Nfreqs)."""
        time = 0 if len(self.values) == 1 else integration
        return self.values[time, np.searchsorted(self.numbers, numbers)]

    def over(self, n_times: int, numbers: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return the gains of some antennas at all integrations of the run, (n_times, len(numbers), Nfreqs)."""
        return np.stack([self.at(integration, numbers) for integration in range(n_times)])


@dataclass(frozen=True)
class AlignedGains:
    """True and fitted gains of one integration for all antennas, and the fit aligned with the truth.

    Antenna numbers are (Nants,), channel centres (Nfreqs,) in Hz. Gains are complex, (Nants, Nfreqs), and zero where
    there is no solution. The aligned gains were multiplied by `scale`; divide the fitted model by its square.
    """

    numbers: np.ndarray
    frequency: np.ndarray
    true: np.ndarray
    fitted: np.ndarray
    aligned: np.ndarray
    scale: float

    def rows(self, numbers: Sequence[int]) -> np.ndarray:
        """Return the indices of antennas in the gains."""
        return np.searchsorted(self.numbers, numbers)


def read_gains(folder: Path, polarization: int = 0) -> Gains:
    """Read the gains of a product of stage `gains` or `calibrate`, of one polarization by its place."""
    cal = UVCal.from_file(folder / GAINS)
    order = np.argsort(cal.ant_array)
    values, flags = (np.moveaxis(array[order][..., polarization], 2, 0) for array in (cal.gain_array, cal.flag_array))
    integration = float(np.ravel(cal.integration_time)[0])
    return Gains(cal.ant_array[order], cal.freq_array, values, flags, cal.time_array, integration)


def true_of(true: Path | None, fitted: Gains, polarization: int = 0) -> np.ndarray:
    """Read the true gains of the antennas and integrations of fitted ones; unity without a product of such gains."""
    if true is None:
        return np.ones(fitted.values.shape)
    return read_gains(true, polarization).over(len(fitted.values), fitted.numbers)


def read_aligned_gains(true: Path, fitted: Path, integration: int) -> AlignedGains:
    """Read true and fitted gains, and align the fit with the truth; raises InputError without a solution."""
    truth, fit = read_gains(true), read_gains(fitted)
    used = ~fit.flags[integration]
    if not used.any():
        raise InputError(f"outputs.inspect.integration = {integration}: it was not calibrated; choose one that was")
    reference = np.where(used, truth.at(integration, fit.numbers), 0)
    as_fitted = np.where(used, fit.values[integration], 0)
    aligned, scale = align(as_fitted, reference)
    return AlignedGains(fit.numbers, fit.frequency, reference, as_fitted, aligned, scale)


def read_spectra(path: Path, pairs: Sequence[tuple[int, int]]) -> np.ndarray:
    """Read baselines (a, b), in the order of the product, in Jy, complex, (len(pairs), Ntimes, Nfreqs)."""
    return _of_pairs(path, pairs, to_cube)


def read_used(path: Path, pairs: Sequence[tuple[int, int]]) -> np.ndarray:
    """Read which samples of some baselines are unflagged, bool, (len(pairs), Ntimes, Nfreqs); see `read_spectra`."""
    return ~_of_pairs(path, pairs, flag_cube)


def _of_pairs(path: Path, pairs: Sequence[tuple[int, int]], cube_of: Callable[[UVData], np.ndarray]) -> np.ndarray:
    uvd = UVData.from_file(path, file_type="uvh5", bls=list(pairs), run_check=False)
    cube = cube_of(uvd)[..., 0]
    return np.stack([cube[:, row] for row in rows_of(uvd, np.array(pairs))])


def require_used(used: np.ndarray, numbers: Sequence[int], integration: int) -> None:
    """Raise InputError if no channel, bool (Nfreqs,), of an antenna or a baseline is used in an integration."""
    if not used.any():
        named = " or ".join(map(str, numbers))
        raise InputError(
            f"outputs.inspect: integration {integration} has no data or no solution of antenna {named}; choose another "
            "integration, or other antennas"
        )


def baseline(layout: Layout, places: Sequence[int]) -> tuple[tuple[int, int], float]:
    """Return antenna numbers (a, b), in the order of products, and length in m of the baseline between two places."""
    first, second = sorted(places)
    length = float(np.linalg.norm(layout.enu[second] - layout.enu[first]))
    return (int(layout.numbers[first]), int(layout.numbers[second])), length


def spread_in_length(layout: Layout, count: int) -> list[tuple[int, int]]:
    """Return the antenna places of `count` baselines, at equal steps in the list sorted by length."""
    first, second = np.triu_indices(len(layout.numbers), 1)
    lengths = np.linalg.norm(layout.enu[second] - layout.enu[first], axis=1)
    order = np.argsort(lengths, kind="stable")
    chosen = order[((np.arange(count) + 0.5) / count * lengths.size).astype(int)]
    return [(int(first[index]), int(second[index])) for index in dict.fromkeys(chosen.tolist())]
