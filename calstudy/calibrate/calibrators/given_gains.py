"""Calibrators that fit nothing: gains of one, and gains of another program, which come in files.

A folder that exchanges data and gains with another program has `MANIFEST`, data sets ``data-1``, ``data-2``, ... and,
once they are calibrated, a file of gains for each, and optionally a model. Data sets are identified by their digests in
the manifest; their names and order have no meaning. Worlds that differ only in their assumptions have the same data,
and are identified by the sky model.
"""

from __future__ import annotations

import hmac
import itertools
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from calstudy.base.constants import SECONDS_PER_DAY
from calstudy.base.errors import InputError
from calstudy.base.foreign_files import FileName, require_inside
from calstudy.base.gain_files import GainTable, read_gain_file, read_gains
from calstudy.base.gains import closest_solutions, require_solutions, solution_times, solutions
from calstudy.base.observation import Frame, Observation
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.schema import FOLDER, UNKEYED, Section, fault
from calstudy.base.visibilities import to_cube
from calstudy.calibrate.interface import NO_SKY_MODEL, Assumed, Calibration, Calibrator, Progress, Solve
from calstudy.calibrate.problem import fitted_baselines
from calstudy.calibrate.sky_model import read_sky_model
from calstudy.instrument.settings import Size

if TYPE_CHECKING:
    from pyuvdata import UVCal

MANIFEST = "manifest.json"
GAINS_SUFFIXES = (".calh5", ".calfits", ".cal", ".h5", ".fits", ".bin")
"""CalH5, calfits, a CASA table, H5Parm, and files of hyperdrive and calibrate."""
MODEL_SUFFIXES = (".model.uvh5", ".model.uvfits", ".model.ms")


class NoCalibration(Calibrator):
    """All gains are one, and the sky model is subtracted. Autocorrelations are left out."""

    version: ClassVar[int] = 2
    calibrator: str = "none"

    @property
    def on_sky_scale(self) -> bool:
        """False: gains are given."""
        return False

    def refusal(self, frame: Frame, has_sky_model: bool) -> str | None:
        """Return a sentence if there is no sky model to subtract."""
        return None if has_sky_model else NO_SKY_MODEL

    def cost(self, size: Size) -> Cost:
        """Return the cost of the subtraction."""
        return Cost(1 + 1e-7 * size.samples, LIBRARIES_MEMORY + 6 * COMPLEX128 * size.samples)

    def calibrate(self, observation: Observation, assumed: Assumed, progress: Progress | None = None) -> Calibration:
        """Return gains of one."""
        chosen = fitted_baselines(observation, autos=False)
        observation = observation.baselines(chosen)
        n_times, _, n_channels, n_polarizations = observation.shape
        gains = np.ones((observation.n_antennas, n_channels, n_times, n_polarizations), complex)
        count = n_polarizations * len(self.solves(n_times))
        if progress is not None:
            progress(count, count)
        found = Solve("converged", "gains of one: nothing is fitted")
        nothing = Solve("skipped", "every sample is flagged")
        solves = itertools.product(range(n_polarizations), self.solves(n_times))
        outcomes = [nothing if observation.flags[times, ..., p].all() else found for p, times in solves]
        return Calibration(gains=gains, outcomes=outcomes, baselines=chosen)


class ByFile(Calibrator):
    """Gains, and optionally models of the foregrounds, that another program found for data of `calstudy export`.

    Gains are for one time, which holds for all, or for every integration. Without a model in the files, the sky model
    is subtracted. Autocorrelations are left out.
    """

    version: ClassVar[int] = 3
    calibrator: str = "by-file"
    chunks: int = Field(1, ge=1, description="Pieces of consecutive integrations.")
    folder: Path | None = Field(
        None,
        description="Folder of gains with the manifest.json of the export, or of such folders for several worlds.",
        json_schema_extra=FOLDER,
    )
    gains: Path | None = Field(None, description="In place of a folder, a file of gains for all data.")
    model: Path | None = Field(
        None, description="Visibilities of the foregrounds, Jy, besides `gains`; null: the sky model."
    )

    salt: str = Field("", description="Of the blind challenge that the data are of.", json_schema_extra=UNKEYED)

    @property
    def on_sky_scale(self) -> bool:
        """False: gains are given."""
        return False

    @model_validator(mode="after")
    def _says_where(self) -> Self:
        if (self.folder is None) == (self.gains is None):
            raise fault("", "needs either a folder, or gains for all data")
        if self.folder is not None and self.model is not None:
            raise fault("model", "goes with gains; models for data of a folder are in the folder")
        return self

    def for_data(self, digest: str, sky_model: str | None = None) -> Self:
        """Return the calibrator with the files of one data set; raises InputError if the folder has none for it."""
        if self.folder is None:
            return self
        sky_model = sky_model and salted(sky_model, self.salt)
        found = find_returned(self.folder, salted(digest, self.salt), sky_model)
        return self.model_copy(update={"folder": None, "gains": found.gains, "model": found.model})

    def refusal(self, frame: Frame, has_sky_model: bool) -> str | None:
        """Return a sentence if gains are missing, or if there is no model."""
        if self.gains is None:
            return None
        if self.model is None and not has_sky_model:
            return f"{self.gains.name} comes without a model of the foregrounds, and there is no sky model in its place"
        cal = read_gain_file(self.gains, "by-file")
        try:
            if isinstance(cal, GainTable):  # What else it needs is known with the data.
                cal.require_channels(frame.n_channels)
                return None
            width = np.diff(frame.frequencies).min() if frame.n_channels > 1 else np.min(cal.channel_width)
            require_solutions(cal, frame.baselines(~frame.autos).numbers, frame.frequencies, width)
        except InputError as error:
            return f"{self.gains.name}: {str(error).removeprefix('gains: ')}"
        return None

    def calibrate(self, observation: Observation, assumed: Assumed, progress: Progress | None = None) -> Calibration:
        """Return the gains of the file at the integrations of the data."""
        if self.gains is None:
            raise InputError("by-file: needs 'gains' for data that were not exported")
        chosen = fitted_baselines(observation, autos=False)
        observation = observation.baselines(chosen)
        gains, flags = _gains_at(self.gains, observation)
        count = len(self.solves(observation.n_times)) * observation.n_polarizations
        if progress is not None:
            progress(count, count)
        outcome = Solve("by-file", f"gains of {self.gains.name}")
        model = None if self.model is None else to_cube(read_sky_model(self.model, observation.uvd))
        return Calibration(gains=gains, gain_flags=flags, model=model, outcomes=[outcome] * count, baselines=chosen)


def _gains_at(path: Path, observation: Observation) -> tuple[np.ndarray, np.ndarray]:
    """Return gains and flags, (Nants, Nfreqs, Ntimes, Npols); raises InputError if the file cannot be used."""
    cal = read_gains(path, "by-file", observation.uvd)
    try:
        gains, flags = solutions(cal, observation.numbers, observation.frequencies, observation.polarizations)
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix('gains: ')}") from None
    bad = ~flags & (~np.isfinite(gains) | (gains == 0))
    if bad.any():
        antenna = int(observation.numbers[np.argwhere(bad)[0][0]])
        raise InputError(
            f"{path}: {bad.sum()} gains are zero or not finite, and not flagged, the first of antenna {antenna}; flag "
            "gains that are not known"
        )
    if flags.all():
        raise InputError(f"{path}: all gains are flagged")
    places = _places(path, cal, observation)
    return gains[:, :, places], flags[:, :, places]


def _places(path: Path, cal: UVCal, observation: Observation) -> np.ndarray:
    """Return the index of the solution in time for each integration."""
    if cal.Ntimes == 1:
        return np.zeros(observation.n_times, int)
    half = np.full(cal.Ntimes, float(np.min(observation.uvd.integration_time)) / 2 / SECONDS_PER_DAY)
    if cal.time_array is None:
        half = np.maximum(np.diff(cal.time_range, axis=1)[:, 0] / 2, half)
    places = closest_solutions(cal, observation.times)
    lacking = np.flatnonzero(np.abs(solution_times(cal)[places] - observation.times) > half[places])
    if lacking.size:
        raise InputError(
            f"{path}: has no solution within half an integration of JD {observation.times[lacking[0]]:.6f} "
            f"({lacking.size} of {observation.n_times} integrations lack one); give gains for one time, which holds "
            "for all, or for every integration"
        )
    return places


class DataSet(Section):
    """One data set, its file and the digest that identifies it."""

    name: FileName
    file: FileName
    digest: str = Field(description="Of all that the data were made from.")


class Manifest(Section):
    """The content of a folder of exported data, without any information on the experiment.

    `calstudy` is the version that wrote it. `digest` is that of all data sets and the sky model, and links the folder
    to the experiment. `sky_model` is the file of the assumed foregrounds, None if nothing is assumed, and `noise` the
    standard deviation of the complex noise of a sample, Jy, None if the data have none.
    """

    calstudy: str
    digest: str
    data: tuple[DataSet, ...]
    sky_model: FileName | None = None
    sky_model_digest: str | None = None
    noise: float | None = None


def salted(digest: str, salt: str) -> str:
    """Return a digest as written in a manifest; with the salt of a blind challenge its input cannot be guessed."""
    return hmac.new(salt.encode(), digest.encode(), "sha256").hexdigest()[:32] if salt else digest


class Returned(NamedTuple):
    """The files of the gains and, if there is one, of the model that were returned for one data set."""

    gains: Path
    model: Path | None


def read_manifest(path: Path) -> Manifest:
    """Read a manifest; raises InputError if it is not one."""
    try:
        return Manifest.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "its content"
        raise InputError(
            f"{path}: is not a manifest of 'calstudy export' ({where}: {first['msg']}); copy it from the export"
        ) from None


def find_returned(folder: Path, digest: str, sky_model: str | None) -> Returned:
    """Find the gains and model that were returned for a data set, in the world with a sky model.

    The folder is that of one experiment, or has one for each world of a comparison. Digests are those of the manifest.

    Raises InputError if no manifest has these data and this sky model, if there are no gains for them or several files,
    or if a file is a link that leads out of the folder.
    """
    manifests = [folder / MANIFEST] if (folder / MANIFEST).exists() else sorted(folder.glob(f"*/{MANIFEST}"))
    if not manifests:
        raise InputError(f"{folder}: has no {MANIFEST}, nor has a folder in it; copy it from the export")
    others = []
    for path in manifests:
        require_inside(path, folder)
        manifest = read_manifest(path)
        for data in manifest.data:
            if data.digest == digest and manifest.sky_model_digest == sky_model:
                return _returned_for(folder, path.parent, data.name)
            if data.digest == digest:
                others.append(path)
    if others:
        raise InputError(
            f"{others[0].parent}: its gains are of these data, but of a world with another sky model ({MANIFEST} has "
            "another digest); each world that 'calstudy export' writes needs gains in its own folder"
        )
    raise InputError(
        f"{folder}: its gains are not of these data ({MANIFEST} has other digests); they must be of data that "
        "'calstudy export' wrote for the same experiment, with the same scale and --set, and the same version"
    )


def _returned_for(root: Path, folder: Path, name: str) -> Returned:
    gains = _only([folder / f"{name}{suffix}" for suffix in GAINS_SUFFIXES])
    if gains is None:
        allowed = ", ".join(f"{name}{suffix}" for suffix in GAINS_SUFFIXES)
        raise InputError(f"{folder}: there are no gains for {name} (allowed: {allowed})")
    model = _only([folder / f"{name}{suffix}" for suffix in MODEL_SUFFIXES])
    for path in (gains, model):
        if path is not None:
            require_inside(path, root)
    return Returned(gains, model)


def _only(paths: list[Path]) -> Path | None:
    found = [path for path in paths if path.exists()]
    if len(found) > 1:
        raise InputError(f"{found[0].parent}: has {' and '.join(path.name for path in found)}; keep one of them")
    return found[0] if found else None
