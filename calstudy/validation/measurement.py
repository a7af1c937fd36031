"""Measurements of the steps of the validation ladder: the interface, its inputs, and its findings.

A measurement is a `Measurement`: its fields are the parameters of the step's file. The built-in ones are the modules of
`calstudy.validation.measurements`, named as their files; a step may name a user's file instead.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.plugins import Plugin, Registry
from calstudy.corrupt.levels import Levels
from calstudy.power.drawn import input_power
from calstudy.power.settings import PowerSettings
from calstudy.power.spectra import CylindricalSpectrum, DelaySpectra, SphericalSpectrum
from calstudy.power.tables import load_spectrum
from calstudy.power.transfer import TransferFunction
from calstudy.products.corruption import LEVELS
from calstudy.products.files import read_json, spectrum_file
from calstudy.products.graph import Graph
from calstudy.products.signal_loss import TRANSFER
from calstudy.products.spectra import read_delay_spectra
from calstudy.run.task import Task
from calstudy.verdicts.criterion import Finding

if TYPE_CHECKING:
    from calstudy.calibrate.interface import Calibrator
    from calstudy.corrupt.settings import CorruptionSettings
    from calstudy.instrument.settings import InstrumentSettings
    from calstudy.sky.settings import Eor

MEASUREMENTS: Registry[Measurement] = Registry(
    "measurement", "calstudy.validation.measurements", "calstudy.validation.measurement:Measurement"
)


@dataclass(frozen=True)
class Findings:
    """Numbers with their uncertainties, by the names in the criteria of the step, and remarks on them."""

    values: Mapping[str, Finding]
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Inputs:
    """The inputs of a measurement.

    Attributes
    ----------
    experiments
        The sections of each experiment that the measurement reads, by the experiment's name in the step.
    folders
        Folders of products by ``experiment:product``.
    output
        Folder for figures and tables.
    """

    experiments: Mapping[str, Mapping[str, Any]]
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
        return self.experiments[experiment]["power"]

    def calibration(self, experiment: str) -> Calibrator:
        """Return the `calibration` section of an experiment."""
        return self.experiments[experiment]["calibration"]

    def instrument(self, experiment: str) -> InstrumentSettings:
        """Return the `instrument` section of an experiment."""
        return self.experiments[experiment]["instrument"]

    def levels(self, experiment: str) -> Levels:
        """Return the levels of the components of an experiment."""
        return Levels(**read_json(self.folder(experiment, "levels") / LEVELS))

    def corruption(self, experiment: str) -> CorruptionSettings:
        """Return the `corruption` section of an experiment."""
        return self.experiments[experiment]["corruption"]

    def eor(self, experiment: str) -> Eor:
        """Return the `sky.eor` section of an experiment."""
        return self.experiments[experiment]["sky"].eor

    def input_power(self, experiment: str, k: np.ndarray) -> np.ndarray:
        """Return the input P(k), scaled as the data are, mK^2 h^-3 Mpc^3, at `k` in h/Mpc."""
        power = input_power(self.eor(experiment), k, self.power(experiment).cosmology)
        return self.levels(experiment).eor_factor ** 2 * power

    def delay_spectra(self, experiment: str, product: str) -> DelaySpectra:
        """Return the delay spectra of a `power` product."""
        return read_delay_spectra(self.folder(experiment, product))

    def spherical(self, experiment: str, variant: str) -> SphericalSpectrum:
        """Return the spherical spectrum of a variant outside the wedge, from the product "spectra"."""
        file = self.folder(experiment, "spectra") / spectrum_file(variant, "outside-wedge")
        return load_spectrum(file, SphericalSpectrum)

    def flux_scale(self, experiment: str) -> float | None:
        """Return the flux scale of the calibration, from the product "transfer"; None if it is not known."""
        if f"{experiment}:transfer" not in self.folders:
            return None
        file = self.folder(experiment, "transfer") / spectrum_file(TRANSFER, "outside-wedge")
        scale = load_spectrum(file, TransferFunction).flux_scale
        return scale if np.isfinite(scale) else None

    def cylindrical(self, experiment: str, variant: str) -> CylindricalSpectrum:
        """Return the cylindrical spectrum of a variant, from the product "spectra"."""
        return load_spectrum(self.folder(experiment, "spectra") / spectrum_file(variant, "wedge"), CylindricalSpectrum)


def required(task: Task | None, what: str) -> Task:
    """Return a task, or raise InputError if the experiment does not have it."""
    if task is None:
        raise InputError(f"the measurement needs {what}, which the experiment does not have")
    return task


class Measurement(Plugin):
    """Base class of all measurements; fields of subclasses are the parameters that a step may give.

    Attributes
    ----------
    version
        Increased when the results change.
    sections
        The sections of the experiments that are read. Sections that affect only the products need not be named.
    """

    registry: ClassVar = MEASUREMENTS
    version: ClassVar[int] = 1
    sections: ClassVar[tuple[str, ...]] = ()

    kind: str

    def products(self, graph: Graph) -> Mapping[str, Task]:
        """Return the products of one experiment that the measurement reads, by names of its own."""
        del graph
        return {}

    @abstractmethod
    def measure(self, inputs: Inputs) -> Findings:
        """Measure, and write figures and tables, if any, to ``inputs.output``."""
