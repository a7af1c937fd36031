"""The one reader of the tables of runs: for statements, figures, reports, notebooks and scripts.

Spectra are ``<variant>.<kind>.h5``; the other files are those of the products `score`, `transfer`, `agreement` and
`sky_model`. A table that a run does not have is an `Unevaluated`, whose message says why.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from calstudy.calibrate.agreement import Statistic, from_json
from calstudy.experiment.assumed import assumed_changes
from calstudy.experiment.model import Experiment
from calstudy.power.expected import ExpectedBins
from calstudy.power.score import Score
from calstudy.power.spectra import CylindricalSpectrum, SphericalSpectrum
from calstudy.power.tables import load_spectrum
from calstudy.power.transfer import TransferFunction, TransferMap
from calstudy.products import sky_model
from calstudy.products.agreement import AGREEMENT
from calstudy.products.expected_loss import EXPECTED
from calstudy.products.files import read_json, spectrum_file
from calstudy.products.score import BANDS, BINS, SUMMARY
from calstudy.products.signal_loss import BAND, TRANSFER
from calstudy.verdicts.statement import Unevaluated

if TYPE_CHECKING:
    import xarray


Spectrum = TypeVar("Spectrum", SphericalSpectrum, CylindricalSpectrum)
NO_SCORES = "the run has no scores of its calibration, or is of a version that wrote none"


@dataclass(frozen=True)
class Tables:
    """Tables of one run, in one folder of all tables or in those of the products."""

    folders: tuple[Path, ...]

    def spherical(self, variant: str, modes: str) -> SphericalSpectrum:
        """Return the spherical spectrum of a variant, over "all-modes" or "outside-wedge"."""
        return self._spectrum(variant, modes, SphericalSpectrum)

    def wedge(self, variant: str) -> CylindricalSpectrum:
        """Return the cylindrical spectrum of a variant."""
        return self._spectrum(variant, "wedge", CylindricalSpectrum)

    def transfer(self, region: str) -> TransferFunction:
        """Return the transfer function of the calibration, "outside-wedge" or "inside-wedge"."""
        return load_spectrum(self._transfer(TRANSFER, region), TransferFunction)

    def transfer_in_bands(self, region: str) -> TransferFunction:
        """Return the transfer function in bands of k, "outside-wedge" or "inside-wedge"."""
        return load_spectrum(self._transfer(BAND, region), TransferFunction)

    @property
    def expected_transfer(self) -> ExpectedBins:
        """The transfer function that theory expects of the fit."""
        return load_spectrum(self.path(EXPECTED, "the run has no expected transfer function"), ExpectedBins)

    def transfer_map(self) -> TransferMap:
        """Return the transfer function by baseline length and delay."""
        return load_spectrum(self._transfer(TRANSFER, "wedge"), TransferMap)

    @property
    def score(self) -> Score:
        """The scores of the calibration in bins of k, with errors from leaving out antennas."""
        return load_spectrum(self.path(BINS, NO_SCORES), Score)

    @property
    def score_in_bands(self) -> Score:
        """The scores of the calibration in bands of k, likewise."""
        return load_spectrum(self.path(BANDS, NO_SCORES), Score)

    @property
    def summary(self) -> Mapping[str, Any]:
        """The content of score.json: scores in bands, flux scale, errors of gains, statuses and cost of the solves."""
        return read_json(self.path(SUMMARY, NO_SCORES))

    def measured(self, name: str) -> Statistic:
        """Return a comparison of the calibration with the truth (`calstudy.calibrate.agreement`)."""
        found = from_json(self.agreement["measurements"])
        if name not in found:
            raise Unevaluated(f"the run has no measurement {name!r}: no delays outside the wedge")
        return found[name]

    @property
    def agreement(self) -> Mapping[str, Any]:
        """The content of agreement.json."""
        missing = "the run has no calibrated variant 'residual' of foregrounds and noise to compare"
        return read_json(self.path(AGREEMENT, missing))

    @property
    def variants(self) -> list[str]:
        """Names of the variants with spectra."""
        ending = spectrum_file("", "all-modes")
        found = (path.name.removesuffix(ending) for folder in self.folders for path in folder.glob(f"*{ending}"))
        return sorted(dict.fromkeys(found))

    def has(self, name: str) -> bool:
        """Return whether one of the folders has a file of this name."""
        return any((folder / name).is_file() for folder in self.folders)

    def path(self, name: str, missing: str) -> Path:
        """Return the path of a table; raises Unevaluated with the sentence `missing` if no folder has it."""
        found = next((folder / name for folder in self.folders if (folder / name).is_file()), None)
        if found is None:
            raise Unevaluated(missing)
        return found

    def _transfer(self, name: str, kind: str) -> Path:
        return self.path(spectrum_file(name, kind), "the run does not calibrate the same data with the EoR and without")

    def _spectrum(self, variant: str, kind: str, cls: type[Spectrum]) -> Spectrum:
        return load_spectrum(self.path(spectrum_file(variant, kind), f"the run has no variant {variant!r}"), cls)


@dataclass(frozen=True)
class Results(Tables):
    """Tables of one run with its experiment."""

    experiment: Experiment

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
        path = self.path(sky_model.ERROR, "the run does not say how far its sky model is from the truth")
        return float(read_json(path)["relative_error"])


OF_DELAY = ("delay", "k_parallel")
"""Fields of spectra by baseline length and delay that have one value for each delay."""
COORDINATES = ("k", "baseline_length", "k_perp", *OF_DELAY, "horizon_delay")


def by_wavenumber(spectrum: SphericalSpectrum | TransferFunction | Score) -> xarray.Dataset:
    """Return quantities in bins of |k| with the coordinates `k`, `k_from` and `k_to`, h/Mpc.

    Numbers that hold for all bins, such as the flux scale, are attributes.
    """
    arrays = {item.name: (("k",), getattr(spectrum, item.name)) for item in _arrays(spectrum)}
    edges = spectrum.bin_edges
    arrays |= {"k_from": (("k",), edges[:-1]), "k_to": (("k",), edges[1:])}
    return _dataset(spectrum, arrays, ("k", "k_from", "k_to"))


def by_length_and_delay(spectrum: CylindricalSpectrum | TransferMap) -> xarray.Dataset:
    """Return quantities in bins of baseline length, m, and delay, s, with `k_perp` and `k_parallel`, h/Mpc."""
    arrays = {}
    for item in _arrays(spectrum):
        values = getattr(spectrum, item.name)
        two = ("baseline_length", "delay")
        arrays[item.name] = (two if values.ndim == 2 else (two[item.name in OF_DELAY],), values)
    edges = spectrum.bin_edges
    arrays |= {f"length_{end}": (("baseline_length",), edges[:, place]) for place, end in enumerate(("from", "to"))}
    return _dataset(spectrum, arrays, (*COORDINATES, "length_from", "length_to"))


def _arrays(spectrum: object) -> list[dataclasses.Field]:
    fields = dataclasses.fields(spectrum)  # type: ignore[arg-type]
    return [item for item in fields if item.name != "bin_edges" and np.ndim(getattr(spectrum, item.name)) > 0]


def _dataset(
    spectrum: object, arrays: Mapping[str, tuple[tuple[str, ...], np.ndarray]], coordinates: tuple[str, ...]
) -> xarray.Dataset:
    import xarray

    fields = {item.name: item for item in dataclasses.fields(spectrum)}  # type: ignore[arg-type]
    edges = fields["bin_edges"].metadata["unit"]
    units = {name: fields[name].metadata["unit"] if name in fields else edges for name in arrays}
    variables = {
        name: xarray.Variable(dims, values, {"units": units[name]} if units[name] else {})
        for name, (dims, values) in arrays.items()
    }
    single = {name: getattr(spectrum, name) for name in fields if name not in arrays and name != "bin_edges"}
    return xarray.Dataset(
        {name: value for name, value in variables.items() if name not in coordinates},
        {name: value for name, value in variables.items() if name in coordinates},
        {name: value for name, value in single.items() if np.ndim(value) == 0},
    )


def gain_errors(path: Path) -> xarray.Dataset:
    """Return standard deviations `amplitude`, of |g|, and `phase`, rad, of a file of gains; raises InputError if none.

    Coordinates are `antenna` (number), `frequency` (Hz), `time` (JD) and `feed` (AIPS number of the Jones element).
    """
    import xarray
    from pyuvdata import UVCal

    from calstudy.base.gains import read_gain_errors

    amplitude, phase = read_gain_errors(path)
    gains = UVCal.from_file(path)
    places = {"antenna": gains.ant_array, "frequency": gains.freq_array, "time": gains.time_array}
    coordinates = {**places, "feed": gains.jones_array}
    found = xarray.Dataset(
        {"amplitude": (tuple(coordinates), amplitude), "phase": (tuple(coordinates), phase)}, coordinates
    )
    for name, unit in (("phase", "rad"), ("frequency", "Hz"), ("time", "JD")):
        found[name].attrs["units"] = unit
    return found
