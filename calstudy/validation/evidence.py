"""What a rung is given, and what it gives back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.calibrate.settings import CalibrationSettings
from calstudy.claims.statement import Finding
from calstudy.claims.study import Study
from calstudy.corrupt.levels import Levels
from calstudy.power.drawn import input_power
from calstudy.power.settings import PowerSettings
from calstudy.sky.settings import Eor
from calstudy.stages.files import read_json

if TYPE_CHECKING:
    from calstudy.power.spectra import DelaySpectra


@dataclass(frozen=True)
class Measurement:
    """What a rung found.

    Attributes
    ----------
    findings
        Numbers with their uncertainties, by name.
    remarks
        Sentences that belong to the numbers.
    """

    findings: Mapping[str, Finding]
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Evidence:
    """What a rung measures on.

    Attributes
    ----------
    experiments
        The sections of each experiment, JSON-able, by the experiment's name in the step.
    parameters
        What the step tells the rung.
    folders
        Folders of products by ``experiment:product``.
    output
        Folder for figures and tables.
    """

    experiments: Mapping[str, Mapping[str, Any]]
    parameters: Mapping[str, Any]
    folders: Mapping[str, Path] = field(default_factory=dict)
    output: Path = Path()

    @property
    def only(self) -> str:
        """The name of the single experiment."""
        (name,) = self.experiments
        return name

    def folder(self, experiment: str, product: str) -> Path:
        """Return the folder of a product of an experiment."""
        return self.folders[f"{experiment}:{product}"]

    def power(self, experiment: str) -> PowerSettings:
        """Return the `power` section of an experiment."""
        return PowerSettings.model_validate(self.experiments[experiment]["power"])

    def calibration(self, experiment: str) -> CalibrationSettings:
        """Return the `calibration` section of an experiment."""
        return CalibrationSettings.model_validate(self.experiments[experiment]["calibration"])

    def levels(self, experiment: str) -> Levels:
        """Return how the components of an experiment are scaled."""
        return Levels(**read_json(self.folder(experiment, "levels") / "levels.json"))

    def input_power(self, experiment: str, k: np.ndarray) -> np.ndarray:
        """Return the P(k) that was put in, scaled as the data were, mK^2 h^-3 Mpc^3, at `k` in h/Mpc."""
        eor = Eor.model_validate(self.experiments[experiment]["sky"]["eor"])
        return self.levels(experiment).eor_factor ** 2 * input_power(eor, k, self.power(experiment).cosmology)

    def spectra(self, experiment: str, product: str) -> DelaySpectra:
        """Return the delay spectra of a `power` product."""
        from hera_pspec import UVPSpec

        from calstudy.power.spectra import delay_spectra

        uvp = UVPSpec()
        uvp.read_hdf5(str(self.folder(experiment, product) / "pspec.h5"))
        return delay_spectra(uvp, self.power(experiment))

    def study(self, experiment: str, *products: str) -> Study:
        """Return an experiment as the claims see it, its tables in these products."""
        facts = {"name": experiment, **self.experiments[experiment]}
        return Study.of(facts, [self.folder(experiment, product) for product in products])
