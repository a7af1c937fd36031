"""The one reader of finished runs: for statements, figures, reports, notebooks and scripts.

`RunFolder` is the folder of a run, or of reference results, with manifest, experiment, figures and claims; `Tables` are
its spectra, T and scores, and `Results` the same with the experiment.

Spectra are ``<variant>.<kind>.h5``; the other files are those of the products `score`, `transfer`, `agreement` and
`sky_model`. A table that a run does not have is an `Unevaluated`, whose message says why.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.gains import read_gain_errors
from calstudy.base.kept_arrays import DAMAGE, read_arrays
from calstudy.base.table import Table, from_json
from calstudy.calibrate.agreement import Statistic
from calstudy.calibrate.agreement import from_json as statistics_from_json
from calstudy.experiment.assumed import assumed_changes
from calstudy.experiment.files import read_mapping, validate
from calstudy.experiment.model import Experiment
from calstudy.power.score import Score
from calstudy.power.spectra import CylindricalSpectrum, SphericalSpectrum
from calstudy.power.tables import Spectrum as Stored
from calstudy.power.tables import load_spectrum
from calstudy.power.transfer import ExpectedBins, TransferFunction, TransferMap
from calstudy.products.files import (
    AGREEMENT,
    COMPARISON,
    EXPECTED,
    SCORE,
    SCORE_BANDS,
    SCORE_BINS,
    SKY_MODEL_ERROR,
    TRANSFER,
    TRANSFER_BANDS,
    read_json,
    spectrum_file,
)
from calstudy.verdicts.criterion import Verdict
from calstudy.verdicts.standing import LIMIT, InBand, standings
from calstudy.verdicts.statement import Unevaluated
from calstudy.verdicts.tables import CLAIMS_JSON
from calstudy.verdicts.tables import from_json as verdicts_from_json

if TYPE_CHECKING:
    import xarray


Read = TypeVar("Read")
NO_SCORES = "the run has no scores of one calibration"
NO_TRANSFER = "the run does not calibrate the same data with the EoR and without"


AGAIN = "run the experiment again"


def undamaged(path: Path, read: Callable[[Path], Read], remedy: str = AGAIN) -> Read:
    """Read a file of a run; raises InputError, with what can be done, if its content is not that of a run."""
    try:
        return read(path)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        raise InputError(f"{path}: is damaged; {remedy}") from None


@dataclass(frozen=True)
class Tables:
    """Tables of one run, in one folder of all tables or in those of the products.

    `lost` are the names of those that the run wrote, and that are not there.
    """

    folders: tuple[Path, ...]
    lost: tuple[str, ...] = dataclasses.field(default=(), kw_only=True)

    def spherical(self, variant: str, modes: str) -> SphericalSpectrum:
        """Return the spherical spectrum of a variant, over "all-modes" or "outside-wedge"."""
        return self._spectrum(variant, modes, SphericalSpectrum)

    def wedge(self, variant: str) -> CylindricalSpectrum:
        """Return the cylindrical spectrum of a variant."""
        return self._spectrum(variant, "wedge", CylindricalSpectrum)

    def transfer(self, region: str) -> TransferFunction:
        """Return the transfer function of the calibration, "outside-wedge" or "inside-wedge"."""
        return self._loaded(spectrum_file(TRANSFER, region), NO_TRANSFER, TransferFunction)

    def transfer_in_bands(self, region: str) -> TransferFunction:
        """Return the transfer function in bands of k, "outside-wedge" or "inside-wedge"."""
        return self._loaded(spectrum_file(TRANSFER_BANDS, region), NO_TRANSFER, TransferFunction)

    @property
    def expected_transfer(self) -> ExpectedBins:
        """The transfer function that theory expects of the fit."""
        return self._loaded(EXPECTED, "the run has no expected transfer function", ExpectedBins)

    def transfer_map(self) -> TransferMap:
        """Return the transfer function by baseline length and delay."""
        return self._loaded(spectrum_file(TRANSFER, "wedge"), NO_TRANSFER, TransferMap)

    @property
    def score(self) -> Score:
        """The scores of the calibration in bins of k, with errors from leaving out antennas."""
        return self._loaded(SCORE_BINS, NO_SCORES, Score)

    @property
    def score_in_bands(self) -> Score:
        """The scores of the calibration in bands of k, likewise."""
        return self._loaded(SCORE_BANDS, NO_SCORES, Score)

    @property
    def summary(self) -> Mapping[str, Any]:
        """The content of score.json: scores in bands, flux scale, errors of gains, statuses and cost of the solves."""

        def read(path: Path) -> dict[str, Any]:
            found = read_json(path)
            if not isinstance(found, dict) or any(len(band["k"]) != 2 for band in found["bands"]):
                raise ValueError("not a score")
            return found

        return undamaged(self.path(SCORE, NO_SCORES), read)

    def measured(self, name: str) -> Statistic:
        """Return a comparison of the calibration with the truth (`calstudy.calibrate.agreement`)."""
        found = statistics_from_json(self.agreement["measurements"])
        if name not in found:
            raise Unevaluated(f"the run has no measurement {name!r}: no delays outside the wedge")
        return found[name]

    @property
    def agreement(self) -> Mapping[str, Any]:
        """The content of agreement.json."""
        missing = "the run has no calibrated variant 'residual' of foregrounds and noise to compare"
        return undamaged(self.path(AGREEMENT, missing), read_json)

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
            raise Unevaluated(f"{name}: is missing, and the run wrote it; {AGAIN}" if name in self.lost else missing)
        return found

    def _spectrum(self, variant: str, kind: str, cls: type[Stored]) -> Stored:
        return self._loaded(spectrum_file(variant, kind), f"the run has no variant {variant!r}", cls)

    def _loaded(self, name: str, missing: str, kind: type[Stored]) -> Stored:
        return undamaged(self.path(name, missing), lambda found: load_spectrum(found, kind))


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
        with suppress(Unevaluated):
            return float(self.agreement["redundant_fraction"])
        return None

    @property
    def sky_model_error(self) -> float:
        """Rms of the error of the calibrator's sky model over that of the true foregrounds; zero if it is perfect."""
        experiment = self.experiment
        if not assumed_changes(experiment.calibration.assumed) and experiment.instrument.as_built.note is None:
            return 0.0
        path = self.path(SKY_MODEL_ERROR, "the run does not say how far its sky model is from the truth")
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
    found = _dataset(spectrum, arrays, ("k", "k_from", "k_to"))
    if isinstance(spectrum, SphericalSpectrum):
        found["difference_error"] = (("k",), spectrum.difference_error, found.noise_error.attrs)
    return found


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
    found = xarray.Dataset(
        {
            name: (dims, values, {"units": fields.get(name, fields["bin_edges"]).metadata["unit"]})
            for name, (dims, values) in arrays.items()
        },
        attrs={
            name: value
            for name in fields
            if name not in (*arrays, "bin_edges") and np.ndim(value := getattr(spectrum, name)) == 0
        },
    )
    return found.set_coords([name for name in coordinates if name in found])


def gain_errors(path: Path) -> xarray.Dataset:
    """Return standard deviations `amplitude`, of |g|, and `phase`, rad, of a file of gains; raises InputError if none.

    Coordinates are `antenna` (number), `frequency` (Hz), `time` (JD) and `feed` (AIPS number of the Jones element).
    """
    import xarray
    from pyuvdata import UVCal

    errors = read_gain_errors(path)
    gains = UVCal.from_file(path)
    places = {"antenna": gains.ant_array, "frequency": gains.freq_array, "time": gains.time_array}
    coordinates = {**places, "feed": gains.jones_array}
    found = xarray.Dataset(
        {name: (tuple(coordinates), getattr(errors, name)) for name in ("amplitude", "phase")}, coordinates
    )
    for name, unit in (("phase", "rad"), ("frequency", "Hz"), ("time", "JD")):
        found[name].attrs["units"] = unit
    return found


MANIFEST, EXPERIMENT, SHOWN = "manifest.json", "experiment.yaml", "tables.json"
NO_RUN = "is not the folder of a finished run; give one that 'calstudy run' printed"


def arrays_of_figure(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a figure; raises InputError if the file is damaged or cannot be read."""
    try:
        return read_arrays(path)
    except DAMAGE as error:
        raise InputError(f"{path}: the arrays of the figure cannot be read ({error})") from None


class _Manifest(BaseModel):
    """What is read of a manifest; it has more, and those of earlier versions have less."""

    name: str
    finished: str | None = None
    points: list[dict[str, Any]] = []
    products: list[dict[str, Any]] = []
    tables: list[str] = []
    captions: dict[str, str] = {}
    parts: dict[str, str] = {}
    members: dict[str, str] = {}
    stand_ins: list[str] = []
    warnings: list[str] = []
    versions: dict[str, Any] = {}
    machine: dict[str, Any] = {}


@dataclass(frozen=True)
class RunFolder:
    """The folder of a finished run, or of a reference, whose figures are beside its manifest.

    Every property reads its file when it is first used, and raises InputError if the file is damaged.
    """

    path: Path

    @cached_property
    def manifest(self) -> Mapping[str, Any]:
        """The content of manifest.json; raises InputError if the folder is not that of a finished run."""
        path = self.path / MANIFEST
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(f"{self.path}: {NO_RUN} ({MANIFEST}: {error.strerror})") from None
        except ValueError:
            raise InputError(f"{path}: not valid JSON; the same run again writes it anew") from None
        try:
            _Manifest.model_validate(found)
        except ValidationError as error:
            field = ".".join(map(str, error.errors()[0]["loc"]))
            raise InputError(f"{path}: not the manifest of a run{f' ({field})' if field else ''}; {AGAIN}") from None
        return found

    @property
    def name(self) -> str:
        """Name of the study."""
        return str(self.manifest["name"])

    @property
    def products(self) -> Sequence[Mapping[str, Any]]:
        """The manifest's entries of all products."""
        return self.manifest.get("products", [])

    @property
    def keys(self) -> frozenset[str]:
        """The keys of all products."""
        return frozenset(entry["key"] for entry in self.products)

    @property
    def finished(self) -> datetime:
        """Time when the run finished."""
        return datetime.fromisoformat(self.manifest["finished"])

    @property
    def size(self) -> int:
        """Size of all files in bytes."""
        return sum(file.stat().st_size for file in self.path.rglob("*") if file.is_file())

    @property
    def members(self) -> Mapping[str, RunFolder]:
        """Folders of the members of a collection, by name."""
        beside = self.path.resolve().parent
        return {name: RunFolder(beside / place) for name, place in self.manifest.get("members", {}).items()}

    @property
    def parts(self) -> Mapping[str, RunFolder]:
        """Folders of the runs of which this one consists, such as members of a collection, by name."""
        # Runs of earlier versions have their points alone.
        points = {item["folder"].rpartition("/")[2]: item["folder"] for item in self.manifest.get("points", [])}
        places = self.manifest.get("parts", points)
        return {**{name: RunFolder(self.path / place) for name, place in places.items()}, **self.members}

    @cached_property
    def content(self) -> Mapping[str, Any]:
        """The content of experiment.yaml; raises InputError if there is none."""
        return read_mapping(self.path / EXPERIMENT)

    def experiment(self, without: Sequence[str] = ()) -> Experiment:
        """Return the validated experiment of a run of one experiment, without some of its sections."""
        try:
            return validate({key: value for key, value in self.content.items() if key not in without}, self.path)
        except ExperimentError as error:
            raise ExperimentError([f"{self.path / EXPERIMENT}: {fault}" for fault in error.faults]) from None

    @property
    def tables(self) -> Tables:
        """The tables of the run; raises InputError if there are none."""
        if not (self.path / "tables").is_dir():
            collected = self.manifest.get("members") if (self.path / MANIFEST).is_file() else None
            remedy = "give the folder of one of its members" if collected else AGAIN
            raise Unevaluated(f"{self.path}: has no tables; {remedy}")
        return Tables((self.path / "tables",), lost=tuple(self.lost))

    @property
    def lost(self) -> list[str]:
        """Names of the tables and figures that the run wrote, by its manifest, and that are not in its folder.

        Empty for references, which keep a part of them, and for runs of earlier versions: they do not list tables.
        """
        if "tables" not in self.manifest:
            return []
        drawn = [f"{entry['label']}.png" for entry in self.products if entry.get("stage") == "figure"]
        places = {self.path / "tables": self.manifest["tables"], self.figures: drawn}
        return [name for folder, names in places.items() for name in names if not (folder / name).is_file()]

    @property
    def shown(self) -> list[Table]:
        """The tables of a report that were made with the products; none in runs of earlier versions."""
        path = self.path / "tables" / SHOWN
        return undamaged(path, lambda file: from_json(file.read_text(encoding="utf-8"))) if path.is_file() else []

    @property
    def figures(self) -> Path:
        """The folder of the figures; that of a reference is the folder itself."""
        inside = self.path / "figures"
        return inside if inside.is_dir() else self.path

    def arrays(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the arrays of all figures, by figure and name."""
        return {path.stem: arrays_of_figure(path) for path in sorted(self.figures.glob("*.npz"))}

    def standings(self, limit: float = LIMIT, worlds: Sequence[str] | None = None) -> list[InBand]:
        """Return how calibrators stand against a limit of the bias, in all or some worlds; empty without comparison."""
        scores = self._scores
        for world in worlds or ():
            if world not in scores:
                raise InputError(f"{world!r}: no world of the comparison (there are: {', '.join(scores)})")
        chosen = {world: scores[world] for world in worlds or scores}
        return standings(chosen, self.manifest.get("refusals", ()), limit)

    @property
    def _scores(self) -> Mapping[str, Mapping[str, Any]]:
        """The scores of a comparison by world and calibrator; empty for other runs."""
        path = self.path / "tables" / COMPARISON

        def read(file: Path) -> dict[str, Any]:
            scores = read_json(file)
            # Verdicts need all that is read of it.
            standings(scores)
            return scores

        return undamaged(path, read, "run the comparison again") if path.is_file() else {}

    @property
    def has_claims(self) -> bool:
        """True if statements of papers were evaluated on the run."""
        return (self.path / CLAIMS_JSON).is_file()

    @property
    def claims(self) -> list[Verdict]:
        """Verdicts on the statements of papers; empty without claims.json."""
        return self.verdicts(self.path / CLAIMS_JSON, f"write it again: calstudy claims {self.path}")

    def verdicts(self, path: Path, remedy: str = AGAIN) -> list[Verdict]:
        """Return the verdicts of a JSON file; empty if it does not exist."""
        if not path.is_file():
            return []
        return undamaged(path, lambda file: verdicts_from_json(file.read_text(encoding="utf-8")), remedy)


def find_runs(folder: Path) -> list[RunFolder]:
    """Return the finished runs in a folder and its subfolders, the latest first; raises InputError without a folder."""
    return sorted(filter(_is_readable, _runs_in(folder)), key=lambda run: run.finished, reverse=True)


def keys_of_runs(folder: Path) -> set[str]:
    """Return the keys of the products of all runs in a folder and its subfolders.

    Raises InputError without a folder, and for a folder, or the manifest of a run, that cannot be read.
    """

    def stop(error: OSError) -> NoReturn:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror}), and may hold runs")

    found: set[str] = set()
    for run in _runs_in(folder, stop):
        try:
            content = json.loads((run.path / MANIFEST).read_text(encoding="utf-8"))
            # Exported data have another manifest, without a name.
            found |= run.keys if content.get("name") is not None else frozenset()
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            raise InputError(
                f"{run.path}: its {MANIFEST} cannot be read, so that its products are not known; run the study again, "
                "or remove the folder"
            ) from None
    return found


def _runs_in(folder: Path, on_error: Callable[[OSError], None] | None = None) -> list[RunFolder]:
    """Return all runs in a folder and its subfolders, which may be links; a folder that is found twice counts once.

    `on_error` is called with the error of a folder that cannot be read; by default it is left out.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of runs")
    found, seen = [], set()
    for place, inside, files in os.walk(folder, onerror=on_error, followlinks=True):
        # A link may lead to a folder above it.
        if (real := os.path.realpath(place)) in seen:
            inside.clear()
            continue
        seen.add(real)
        inside.sort()
        if MANIFEST in files:
            found.append(RunFolder(Path(place)))
    return found


def _is_readable(run: RunFolder) -> bool:
    try:
        return run.finished is not None and run.keys is not None
    except (InputError, ValueError, KeyError, TypeError):
        return False
