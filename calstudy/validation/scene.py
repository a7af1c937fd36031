"""One integration to calibrate: foregrounds, gains and noise, put together from products."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pyuvdata import UVCal, UVData

from calstudy.calibrate.calamity import calibrate
from calstudy.calibrate.problem import FitStructure, gain_products
from calstudy.calibrate.records import CalibrationResult
from calstudy.calibrate.settings import CalibrationSettings
from calstudy.calibrate.structure import make_structure
from calstudy.gains import make_uvcal
from calstudy.stages.files import read_visibilities
from calstudy.validation.evidence import Evidence
from calstudy.visibilities import from_cube, to_cube


def first_integrations(uvd: UVData, count: int = 1) -> UVData:
    """Return the first integrations of a rectangular data set."""
    return uvd.select(blt_inds=np.arange(count * uvd.Nbls), inplace=False, run_check=False)


@dataclass(frozen=True)
class Scene:
    """One integration of one polarization, and what it consists of.

    Attributes
    ----------
    foregrounds
        As simulated.
    structure, numbers
        Of the fit, and the antenna numbers its indices stand for.
    settings
        Of the calibration.
    noise_std
        Of the complex noise of one sample, Jy.
    """

    foregrounds: UVData
    structure: FitStructure
    numbers: np.ndarray
    settings: CalibrationSettings
    noise_std: float

    @classmethod
    def of(cls, evidence: Evidence, experiment: str) -> Scene:
        """Return the first integration of an experiment, of the first `antennas` and `channels` of the parameters."""
        product = evidence.folder(experiment, "foregrounds") / "visibilities.uvh5"
        foregrounds = first_integrations(read_visibilities(product))
        settings = evidence.calibration(experiment)
        structure, numbers = make_structure(foregrounds, settings)
        whole = cls(foregrounds, structure, numbers, settings, evidence.levels(experiment).noise_std)
        return whole.first(evidence.parameters.get("antennas"), evidence.parameters.get("channels"))

    def first(self, antennas: int | None, channels: int | None) -> Scene:
        """Return the scene of the first antennas and channels only; all if None."""
        if antennas is None and channels is None:
            return self
        numbers = self.numbers[:antennas]
        cut = self.foregrounds.select(
            antenna_nums=numbers,
            freq_chans=np.arange(self.foregrounds.Nfreqs)[:channels],
            inplace=False,
            run_check=False,
        )
        structure, kept = make_structure(cut, self.settings)
        return replace(self, foregrounds=cut, structure=structure, numbers=kept)

    @property
    def modelled(self) -> np.ndarray:
        """The foregrounds' projection on the basis of the fit, (Nbls, Nfreqs): foregrounds that it holds exactly."""
        cube = to_cube(self.foregrounds)[0, :, :, 0]
        projected = np.empty_like(cube)
        for bucket in self.structure.basis.buckets:
            projected[bucket.members] = cube[bucket.members] @ bucket.vectors @ bucket.vectors.T
        return projected

    def true_gains(self, evidence: Evidence, experiment: str) -> np.ndarray:
        """Return the gains of the product, (Nants, Nfreqs), in the order of the fit's antennas."""
        cal = UVCal.from_file(evidence.folder(experiment, "gains") / "gains.calh5")
        rows = np.searchsorted(cal.ant_array, self.numbers)
        return cal.gain_array[rows, : self.structure.n_frequencies, 0, 0]

    def data(self, visibilities: np.ndarray) -> UVData:
        """Return visibilities, (Nbls, Nfreqs), as a data set."""
        return from_cube(self.foregrounds, visibilities[None, :, :, None])

    def products(self, gains: np.ndarray) -> np.ndarray:
        """Return g_a g_b* of each baseline, (Nbls, Nfreqs)."""
        return gain_products(gains, self.structure.antennas)

    def uvcal(self, gains: np.ndarray) -> UVCal:
        """Return gains, (Nants, Nfreqs), as a set of solutions to start from."""
        telescope = self.foregrounds.telescope
        values = np.ones((telescope.Nants, gains.shape[1], 1, 1), complex)
        values[np.searchsorted(telescope.antenna_numbers, self.numbers), :, 0, 0] = gains
        return make_uvcal(self.foregrounds, values)

    def calibrate(
        self, visibilities: np.ndarray, settings: CalibrationSettings | None = None, start: np.ndarray | None = None
    ) -> CalibrationResult:
        """Calibrate visibilities, (Nbls, Nfreqs), with the foregrounds fixing the scale."""
        gains = None if start is None else self.uvcal(start)
        return calibrate(self.data(visibilities), settings or self.settings, self.foregrounds, gains)

    def misfit(self, result: CalibrationResult, visibilities: np.ndarray) -> np.ndarray:
        """Return V - g_a g_b* F of a result, (Nbls, Nfreqs): the residual in the unit and gauge of the data."""
        gains = result.gains.gain_array[np.searchsorted(result.gains.ant_array, self.numbers), :, 0, 0]
        return visibilities - self.products(gains) * to_cube(result.model)[0, :, :, 0]


def rms(values: np.ndarray) -> float:
    """Return sqrt(mean |x|^2)."""
    return float(np.sqrt(np.mean(np.abs(values) ** 2)))
