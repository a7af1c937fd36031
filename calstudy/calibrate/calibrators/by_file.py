"""Read gains of another program from files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from pydantic import Field, model_validator

from calstudy.base.errors import InputError
from calstudy.base.gains import read_gains, require_solutions, solutions
from calstudy.base.observation import Frame, Observation
from calstudy.base.schema import FOLDER, UNKEYED, fault
from calstudy.calibrate.exchange import find_returned, salted
from calstudy.calibrate.interface import Assumed, Calibration, Calibrator, Progress, Solve

if TYPE_CHECKING:
    from pyuvdata import UVCal

SECONDS_PER_DAY = 86400.0


class ByFile(Calibrator):
    """Gains, and optionally models of the foregrounds, that another program found for data of `calstudy export`.

    Gains are for one time, which holds for all, or for every integration. Without a model in the files, the sky model
    is subtracted.
    """

    calibrator: str = "by-file"
    chunks: int = Field(1, ge=1, description="Pieces of consecutive integrations.")
    folder: Path | None = Field(
        None,
        strict=False,
        description="Folder of gains with the manifest.json of the export, or of such folders for several worlds.",
        json_schema_extra=FOLDER,
    )
    gains: Path | None = Field(
        None, strict=False, description="In place of a folder, gains for all data: a CalH5 or calfits file."
    )
    model: Path | None = Field(
        None, strict=False, description="Visibilities of the foregrounds, Jy, besides `gains`; null: the sky model."
    )

    salt: str = Field("", description="Of the blind challenge that the data are of.", json_schema_extra=UNKEYED)

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
        cal = read_gains(self.gains, "by-file")
        width = np.diff(frame.frequencies).min() if frame.n_channels > 1 else np.min(cal.channel_width)
        try:
            require_solutions(cal, frame.numbers, frame.frequencies, width)
        except InputError as error:
            return f"{self.gains.name}: {str(error).removeprefix('gains: ')}"
        return None

    def calibrate(self, observation: Observation, assumed: Assumed, progress: Progress | None = None) -> Calibration:
        """Return the gains of the file at the integrations of the data."""
        if self.gains is None:
            raise InputError("by-file: needs 'gains' for data that were not exported")
        gains, flags = _gains_at(self.gains, observation)
        count = len(self.solves(observation.n_times)) * observation.n_polarizations
        if progress is not None:
            progress(count, count)
        outcome = Solve(status="by-file", message=f"gains of {self.gains.name}")
        return Calibration(gains=gains, gain_flags=flags, model=self._model(observation), outcomes=[outcome] * count)

    def _model(self, observation: Observation) -> np.ndarray | None:
        if self.model is None:
            return None
        from calstudy.base.visibilities import to_cube
        from calstudy.calibrate.sky_model import read_sky_model

        return to_cube(read_sky_model(self.model, observation.uvd))


def _gains_at(path: Path, observation: Observation) -> tuple[np.ndarray, np.ndarray]:
    """Return gains and flags, (Nants, Nfreqs, Ntimes, Npols); raises InputError if the file cannot be used."""
    cal = read_gains(path, "by-file")
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
    times = cal.time_array
    if times is None:
        times, half = cal.time_range.mean(axis=1), np.maximum(np.diff(cal.time_range, axis=1)[:, 0] / 2, half)
    away = np.abs(times[None] - observation.times[:, None])
    places = away.argmin(axis=1)
    lacking = np.flatnonzero(away[np.arange(len(places)), places] > half[places])
    if lacking.size:
        raise InputError(
            f"{path}: has no solution within half an integration of JD {observation.times[lacking[0]]:.6f} "
            f"({lacking.size} of {observation.n_times} integrations lack one); give gains for one time, which holds "
            "for all, or for every integration"
        )
    return places
