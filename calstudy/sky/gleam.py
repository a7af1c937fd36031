"""The GLEAM extragalactic catalogue: location, download, and verification."""

from __future__ import annotations

import logging
from pathlib import Path

from calstudy.base.downloads import default_directory, download
from calstudy.base.errors import InputError
from calstudy.base.files import sha256
from calstudy.sky.catalogue import read_gleam_table
from calstudy.sky.settings import GLEAM_FILE

LOG = logging.getLogger(__name__)

# Hurley-Walker et al. (2017), second release.
URL = (
    "https://vizier.cds.unistra.fr/viz-bin/votable?-source=VIII/100/gleamegc&-out.max=unlimited"
    "&-out=GLEAM&-out=RAJ2000&-out=DEJ2000&-out=Fintwide&-out=alpha"
)
SOURCES = 307_455


def default_path() -> Path:
    """Return the default path of the catalogue that `fetch_gleam` downloads."""
    return default_directory() / GLEAM_FILE


def fetch_gleam(directory: Path | None = None, progress: bool = True) -> Path:
    """Download the GLEAM extragalactic catalogue from VizieR, or verify an existing copy, and return its path.

    VizieR generates the table for every request and publishes no hash of it. The first download is accepted if it has
    the required columns and the published number of sources, 307,455. Its SHA-256 is then saved next to it, and
    checked at every later use. The directory is by default `default_directory`, and is created if necessary. Raises
    InputError if the download fails or is not the catalogue, or if the copy has changed since it was downloaded.
    """
    directory = default_directory() if directory is None else directory
    path = directory / GLEAM_FILE
    if path.is_file() and hash_file(path).is_file():
        verify(path)
        return path
    instead = "set sky.foregrounds.path to your own copy, or use 'g4jy-and-counts', which needs no download"
    download(URL, path, instead, progress=progress)
    try:
        found = len(read_gleam_table(path))
    except InputError:
        path.unlink()
        raise
    if found != SOURCES:
        path.unlink()
        raise InputError(f"the download from VizieR holds {found} sources, GLEAM has {SOURCES}: try again")
    hash_file(path).write_text(f"{sha256(path)}  {GLEAM_FILE}\n")
    return path


def verify(path: Path) -> None:
    """Raise InputError if a downloaded catalogue has changed; a user's own file has no hash and is not checked."""
    if hash_file(path).is_file() and hash_file(path).read_text().split()[:1] != [sha256(path)]:
        raise InputError(
            f"{path} has changed since it was downloaded: remove it and {hash_file(path).name}, "
            "and run `calstudy data fetch gleam`"
        )


def hash_file(path: Path) -> Path:
    """Return the path of the file next to a downloaded catalogue that holds its SHA-256."""
    return path.with_name(path.name + ".sha256")
