"""Errors of the gains of any calibrator, from fits to realizations of the noise.

The fitted visibilities g_a g_b* F take the part of the truth. To these noise is added, with the variance of the
residual, one for all baselines and channels of a solve and the inverse of the number of measurements of a sample, and
they are calibrated again. The gains scatter by their errors.

A fit takes some noise out of the data, most of it on baselines with strong foregrounds. The residual has less than
there is, and the same realizations, in which the noise is known, tell how much: they leave a fraction l of its power,
and the true noise has 1 / l of that of the measured residual. Errors are enlarged by the root of this. A variance of
each baseline would be too small where foregrounds are strong, and errors with it, by 8 % for 8 antennas.

What does not change with the noise has no part in the errors. What a sky model lacks is in the residual, and counts as
noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from calstudy.base.gains import gain_products
from calstudy.base.visibilities import antenna_pairs, flag_cube, from_cube, rows_of, to_cube
from calstudy.calibrate.degeneracy import fix_phase
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.interface import Calibrator
from calstudy.calibrate.records import CalibrationResult

if TYPE_CHECKING:
    from pyuvdata import UVData


@dataclass(frozen=True, eq=False)
class GainRealizations:
    """Data that are calibrated, what a calibrator takes from them, and the result.

    Sky and noise are as for `run_calibrator`; `count` is the number of realizations, 2 or more.
    """

    calibrator: Calibrator
    data: UVData
    sky: UVData | None
    noise: float | None
    result: CalibrationResult
    count: int

    def errors(self) -> np.ndarray:
        """Return standard deviations of |g| and of the phase, (2, Nants, Nfreqs, Ntimes, Npols); NaN where flagged.

        One phase in every channel of an integration, which no data determine, has no part in them.
        """
        gains, used = self.result.gains.gain_array, ~self.result.gains.flag_array
        known = ~flag_cube(self.result.residual)
        sigma = self._noise(known)
        left, changes = 0.0, []
        for drawn in self._drawn(sigma):
            found = run_calibrator(self.calibrator, drawn, self.sky, noise=self.noise)
            of_both = known & ~flag_cube(found.residual)
            ratio = np.divide(np.abs(self._as_measured(found)), sigma, out=np.zeros(sigma.shape), where=sigma > 0)
            left += np.mean(ratio**2, where=of_both & (sigma > 0)) / self.count
            changes.append(_logarithm(found.gains.gain_array, gains, used & ~found.gains.flag_array))
        scatter = [np.std(part, axis=0, ddof=1) / np.sqrt(left) for part in (np.real(changes), np.imag(changes))]
        return np.stack([np.abs(gains) * scatter[0], scatter[1]])

    def _noise(self, known: np.ndarray) -> np.ndarray:
        """Return sigma of the noise of every sample that the residual tells, (Ntimes, Nbls, Nfreqs, Npols)."""
        counts = self.result.residual.nsample_array.reshape(known.shape)
        counts = np.where(counts > 0, counts, 1)
        power, sigma = counts * np.abs(self._as_measured(self.result)) ** 2, np.zeros(known.shape)
        for times in self.calibrator.solves(len(known)):
            number = np.maximum(known[times].sum(axis=(0, 1, 2)), 1)
            sigma[times] = np.sqrt(np.sum(power[times], axis=(0, 1, 2), where=known[times]) / number / counts[times])
        return sigma

    def _as_measured(self, result: CalibrationResult) -> np.ndarray:
        """Return V - g_a g_b* F, (Ntimes, Nbls, Nfreqs, Npols), zero where flagged."""
        products, _ = gain_products(result.gains, antenna_pairs(result.residual))
        return products * to_cube(result.residual)

    def _drawn(self, sigma: np.ndarray) -> Iterator[UVData]:
        """Yield the fitted visibilities with noise; baselines that have no model stay as they are."""
        model = self.result.model
        # Other data have other noise.
        rng = np.random.default_rng(crc32(self.data.data_array.tobytes()))
        rows = rows_of(self.data, antenna_pairs(model))
        fitted = gain_products(self.result.gains, antenna_pairs(model))[0] * to_cube(model)
        for _ in range(self.count):
            real, imaginary = rng.standard_normal((2, *fitted.shape))
            cube = to_cube(self.data).astype(complex)
            cube[:, rows] = fitted + sigma * (real + 1j * imaginary) / np.sqrt(2)
            yield from_cube(self.data, cube)


def _logarithm(gains: np.ndarray, reference: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return ln (g / reference), phases aligned, (Nants, Nfreqs, Ntimes, Npols); NaN where not used."""
    kept, true = np.where(used, gains, 0), np.where(used, reference, 0)
    found = np.full(gains.shape, np.nan + 0j)
    for t, p in np.ndindex(gains.shape[2:]):
        aligned, at = fix_phase(kept[..., t, p], true[..., t, p]), used[..., t, p]
        found[..., t, p][at] = np.log(aligned[at] / true[..., t, p][at])
    return found
