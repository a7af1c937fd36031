"""Folders that exchange data and gains with another calibration program.

A folder of one experiment has `MANIFEST`, data sets ``data-1``, ``data-2``, ... and, once they are calibrated, a file
of gains for each, and optionally a model. Data sets are identified by their digests in the manifest; their names and
order have no meaning. Worlds that differ only in their assumptions have the same data, and are identified by the sky
model.
"""

from __future__ import annotations

import hmac
from dataclasses import dataclass
from pathlib import Path

from pydantic import Field, ValidationError

from calstudy.base.errors import InputError
from calstudy.base.foreign_files import FileName, require_inside
from calstudy.base.schema import Section

MANIFEST = "manifest.json"
GAINS_SUFFIXES = (".calh5", ".calfits", ".cal")
"""CalH5, calfits, and a CASA table."""
MODEL_SUFFIXES = (".model.uvh5", ".model.uvfits", ".model.ms")


class DataSet(Section):
    """One data set, its file and the digest that identifies it."""

    name: FileName
    file: FileName
    digest: str = Field(description="Of all that the data were made from.")


class Manifest(Section):
    """The content of a folder of exported data, without any information on the experiment.

    Attributes
    ----------
    calstudy
        Version of calstudy that wrote it.
    digest
        Digest of all data sets and the sky model; it links the folder to the experiment.
    sky_model
        File of the assumed visibilities of the foregrounds; None if nothing is assumed.
    sky_model_digest
        Digest of all inputs of the sky model.
    noise
        Standard deviation of the complex noise of a sample, Jy; None if the data have none.
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


@dataclass(frozen=True)
class Returned:
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

    The folder is that of one experiment, or has several such folders, one for each world of a comparison. Digests are
    those of the manifest.

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
