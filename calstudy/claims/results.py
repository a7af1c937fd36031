"""A finished run for statements of papers: its experiment and its tables."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from calstudy.calibrate.agreement import Statistic, from_json
from calstudy.experiment.assumed import assumed_changes
from calstudy.experiment.model import Experiment
from calstudy.power.score import Score
from calstudy.power.spectra import CylindricalSpectrum, SphericalSpectrum
from calstudy.power.tables import load_spectrum
from calstudy.power.transfer import TransferFunction
from calstudy.products import sky_model
from calstudy.products.agreement import AGREEMENT
from calstudy.products.files import spectrum_file
from calstudy.products.score import BINS
from calstudy.products.signal_loss import TRANSFER
from calstudy.verdicts.statement import Unevaluated

Spectrum = TypeVar("Spectrum", SphericalSpectrum, CylindricalSpectrum)


@dataclass(frozen=True)
class RunResults:
    """One finished run.

    Attributes
    ----------
    experiment
        The experiment of the run.
    folders
        Folders of tables: spectra as ``<variant>.<kind>.h5``, ``transfer.<region>.h5``, score-bins.h5,
        agreement.json and sky-model.json.
    """

    experiment: Experiment
    folders: tuple[Path, ...]

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return self.experiment.name

    @property
    def redundant_fraction(self) -> float | None:
        """Part of the baselines that have a redundant partner; None if nothing was calibrated."""
        try:
            return float(self.agreement["redundant_fraction"])
        except Unevaluated:
            return None

    @property
    def sky_model_error(self) -> float:
        """Rms of the error of the calibrator's sky model over that of the true foregrounds; zero if it is perfect."""
        experiment = self.experiment
        if not assumed_changes(experiment.calibration.assumed) and experiment.instrument.as_built.note is None:
            return 0.0
        path = self._find(sky_model.ERROR)
        if path is None:
            raise Unevaluated("the run does not say how far its sky model is from the truth")
        return float(json.loads(path.read_text(encoding="utf-8"))["relative_error"])

    def spherical(self, variant: str, modes: str) -> SphericalSpectrum:
        """Return the spherical spectrum of a variant, over "all-modes" or "outside-wedge"."""
        return self._spectrum(variant, modes, SphericalSpectrum)

    def wedge(self, variant: str) -> CylindricalSpectrum:
        """Return the cylindrical spectrum of a variant."""
        return self._spectrum(variant, "wedge", CylindricalSpectrum)

    def transfer(self, region: str) -> TransferFunction:
        """Return the transfer function of the calibration, "outside-wedge" or "inside-wedge"."""
        path = self._find(spectrum_file(TRANSFER, region))
        if path is None:
            raise Unevaluated("the run does not calibrate the same data with the EoR and without")
        return load_spectrum(path, TransferFunction)

    @property
    def score(self) -> Score:
        """The scores of the calibration in bins of k, with errors from leaving out antennas."""
        path = self._find(BINS)
        if path is None:
            raise Unevaluated("the run has no scores of its calibration, or is of a version that wrote none")
        return load_spectrum(path, Score)

    def measured(self, name: str) -> Statistic:
        """Return a comparison of the calibration with the truth (`calstudy.calibrate.agreement`)."""
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
        path = self._find(spectrum_file(variant, kind))
        if path is None:
            raise Unevaluated(f"the run has no variant {variant!r}")
        return load_spectrum(path, cls)
