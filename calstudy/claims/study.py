"""A finished run as the claims see it: its tables, and the facts of its experiment that they need."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from calstudy.calibrate.agreement import Measurement, from_json
from calstudy.calibrate.settings import CalibrationSettings
from calstudy.corrupt.settings import CorruptionSettings
from calstudy.power.settings import PowerSettings
from calstudy.power.spherical import SphericalSpectrum
from calstudy.power.tables import load_spectrum
from calstudy.power.wedge import WedgeSpectrum

AGREEMENT = "agreement.json"

Spectrum = TypeVar("Spectrum", SphericalSpectrum, WedgeSpectrum)


class Unevaluated(Exception):
    """A claim cannot be evaluated on a run; the message says what is missing."""


@dataclass(frozen=True)
class Study:
    """One run.

    Attributes
    ----------
    name
        Of the experiment.
    calibration, corruption, power
        Sections of the experiment.
    folders
        Where tables are looked for: spectra as ``<variant>.<kind>.h5`` and agreement.json.
    """

    name: str
    calibration: CalibrationSettings
    corruption: CorruptionSettings
    power: PowerSettings
    folders: tuple[Path, ...]

    @classmethod
    def of(cls, experiment: Mapping[str, Any], folders: Sequence[Path]) -> Study:
        """Return the study of an experiment, as in its file: `name` and the sections of `calstudy.claims.facts`."""
        return cls(
            name=experiment["name"],
            calibration=CalibrationSettings.model_validate(experiment["calibration"]),
            corruption=CorruptionSettings.model_validate(experiment["corruption"]),
            power=PowerSettings.model_validate(experiment["power"]),
            folders=tuple(folders),
        )

    def spherical(self, variant: str, modes: str) -> SphericalSpectrum:
        """Return the spherical spectrum of a variant, over "all-modes" or "outside-wedge"."""
        return self._spectrum(variant, modes, SphericalSpectrum)

    def wedge(self, variant: str) -> WedgeSpectrum:
        """Return the cylindrical spectrum of a variant."""
        return self._spectrum(variant, "wedge", WedgeSpectrum)

    def measured(self, name: str) -> Measurement:
        """Return a measurement of the calibration against the truth (`calstudy.calibrate.agreement`)."""
        found = from_json(self.agreement["measurements"])
        if name not in found:
            raise Unevaluated(f"the run has no measurement {name!r}: no delays outside the wedge")
        return found[name]

    @property
    def agreement(self) -> Mapping[str, Any]:
        """The content of agreement.json."""
        path = self._find(AGREEMENT)
        if path is None:
            raise Unevaluated("the run has no calibrated variant 'residual' of foregrounds and noise to compare")
        return json.loads(path.read_text(encoding="utf-8"))

    def _find(self, name: str) -> Path | None:
        return next((folder / name for folder in self.folders if (folder / name).is_file()), None)

    def _spectrum(self, variant: str, kind: str, cls: type[Spectrum]) -> Spectrum:
        path = self._find(f"{variant}.{kind}.h5")
        if path is None:
            raise Unevaluated(f"the run has no variant {variant!r}")
        return load_spectrum(path, cls)
