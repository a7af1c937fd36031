"""One integration to calibrate, assembled from products: foregrounds, gains, and the level of the noise.

TensorFlow is imported inside functions, because the steps of the ladder are read without it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydantic import Field
from pyuvdata import UVCal, UVData

from calstudy.base.errors import InputError
from calstudy.base.gains import make_uvcal
from calstudy.base.observation import Observation
from calstudy.base.visibilities import from_cube, to_cube
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.problem import FitStructure, gain_products, make_structure
from calstudy.calibrate.records import CalibrationResult
from calstudy.calibrate.settings import ForegroundFit
from calstudy.products import corruption, simulation
from calstudy.products.files import VISIBILITIES, read_visibilities
from calstudy.products.graph import Graph
from calstudy.products.selection import read_gains
from calstudy.run.task import Task
from calstudy.validation.step import MINREDUNDANT, Step, StepInput, only, required


def first_integrations(uvd: UVData, count: int = 1) -> UVData:
    """Return the first integrations of a rectangular data set."""
    return uvd.select(blt_inds=np.arange(count * uvd.Nbls), inplace=False, run_check=False)


@dataclass(frozen=True)
class SingleIntegration:
    """One integration of one polarization, and its parts.

    `numbers` are the antenna numbers of the indices in `structure`. `noise_std` is the standard deviation of the
    complex noise of one sample, Jy. `true_gains` are (Nants, Nfreqs), in the order of the fit's antennas.
    """

    foregrounds: UVData
    structure: FitStructure
    numbers: np.ndarray
    settings: ForegroundFit
    noise_std: float
    true_gains: np.ndarray

    @classmethod
    def of(cls, run: StepInput) -> SingleIntegration:
        """Return the first integration of an experiment, from its products "foregrounds", "gains" and "levels"."""
        foregrounds = first_integrations(read_visibilities(run.products["foregrounds"] / VISIBILITIES))
        settings, frame = run.experiment.calibration, Observation(foregrounds)
        if not isinstance(settings, ForegroundFit):
            raise InputError(f"{settings.label}: the measurement needs a calibrator with foregrounds, such as calamity")
        gains = read_gains(run.products["gains"])
        return cls(
            foregrounds=foregrounds,
            structure=make_structure(frame, settings),
            numbers=frame.numbers,
            settings=settings,
            noise_std=run.levels.noise_std,
            true_gains=gains.at(0, frame.numbers),
        )

    def first(self, antennas: int | None, channels: int | None) -> SingleIntegration:
        """Return the first antennas and channels only; all if None."""
        if antennas is None and channels is None:
            return self
        numbers = self.numbers[:antennas]
        cut = self.foregrounds.select(
            antenna_nums=numbers,
            freq_chans=np.arange(self.foregrounds.Nfreqs)[:channels],
            inplace=False,
            run_check=False,
        )
        frame = Observation(cut)
        structure = make_structure(frame, self.settings)
        gains = self.true_gains[np.searchsorted(self.numbers, frame.numbers), : structure.n_frequencies]
        return replace(self, foregrounds=cut, structure=structure, numbers=frame.numbers, true_gains=gains)

    @property
    def modelled(self) -> np.ndarray:
        """The projection of the foregrounds on the basis of the fit, (Nbls, Nfreqs), which can be fitted exactly."""
        cube = to_cube(self.foregrounds)[0, :, :, 0]
        projected = np.empty_like(cube)
        for bucket in self.structure.basis.buckets:
            projected[bucket.members] = cube[bucket.members] @ bucket.vectors @ bucket.vectors.T
        return projected

    def data(self, visibilities: np.ndarray) -> UVData:
        """Return visibilities, (Nbls, Nfreqs), as a data set."""
        return from_cube(self.foregrounds, visibilities[None, :, :, None])

    def products(self, gains: np.ndarray) -> np.ndarray:
        """Return g_a g_b* of each baseline, (Nbls, Nfreqs)."""
        return gain_products(gains, self.structure.antennas)

    def uvcal(self, gains: np.ndarray) -> UVCal:
        """Return gains, (Nants, Nfreqs), as initial gains for a fit."""
        telescope = self.foregrounds.telescope
        values = np.ones((telescope.Nants, gains.shape[1], 1, 1), complex)
        values[np.searchsorted(telescope.antenna_numbers, self.numbers), :, 0, 0] = gains
        return make_uvcal(self.foregrounds, values)

    def calibrate(
        self,
        visibilities: np.ndarray,
        settings: ForegroundFit | None = None,
        start: np.ndarray | None = None,
        sky_model: bool = True,
    ) -> CalibrationResult:
        """Calibrate visibilities, (Nbls, Nfreqs), Jy, with the foregrounds as sky model, which fixes the scale.

        `settings` are by default those of the experiment. The fit starts from the complex gains `start`, (Nants,
        Nfreqs), or according to the settings.
        """
        gains = None if start is None else self.uvcal(start)
        sky = self.foregrounds if sky_model else None
        return run_calibrator(settings or self.settings, self.data(visibilities), sky, gains)

    def misfit(self, result: CalibrationResult, visibilities: np.ndarray) -> np.ndarray:
        """Return V - g_a g_b* F of a result, (Nbls, Nfreqs): the residual in the unit and gauge of the data."""
        gains = result.gains.gain_array[np.searchsorted(result.gains.ant_array, self.numbers), :, 0, 0]
        return visibilities - self.products(gains) * to_cube(result.model)[0, :, :, 0]


class SingleIntegrationStep(Step):
    """Base class of steps that measure on the first integration of the step's single experiment."""

    experiments: ClassVar = {"minredundant": MINREDUNDANT}
    sections: ClassVar = ("calibration",)

    antennas: int | None = Field(None, ge=3, description="How many are used, the first ones; null: all.")
    channels: int | None = Field(None, ge=1, description="How many are used, the first ones; null: all.")

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the tasks of foregrounds, gains and levels."""
        return {
            "foregrounds": required(simulation.foregrounds(graph), "foregrounds"),
            "gains": corruption.gains(graph),
            "levels": corruption.levels(graph),
        }

    def integration(self, runs: Mapping[str, StepInput]) -> SingleIntegration:
        """Return the first integration of the experiment, with the first antennas and channels."""
        return SingleIntegration.of(only(runs)).first(self.antennas, self.channels)
