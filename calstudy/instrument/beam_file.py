"""The file of the MWA's full embedded element beam: where it is, and fetching it."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from calstudy.downloads import default_directory, download
from calstudy.errors import InputError

FILE = "mwa_full_embedded_element_pattern.h5"
URL = f"http://ws.mwatelescope.org/static/{FILE}"
SHA256 = "a7649c6e03b8128a1de4614c2f363af5fa44f3890ae27bf893d56ca337bc48ee"
"""Of the file that the mwa_pb package 1.1 carries, which was downloaded from the same address when it was built."""


def fetch_beam(directory: Path | None = None, progress: bool = True) -> Path:
    """Download the embedded element beam (Sokolowski et al. 2017, 133 MB), or check the copy that is there.

    Parameters
    ----------
    directory
        Where to put it, `calstudy.downloads.default_directory` by default; made if need be.
    progress
        Whether to show a progress bar.

    Raises
    ------
    InputError
        If the download fails or is not the file.
    """
    path = (default_directory() if directory is None else directory) / FILE
    instead = "give a copy of yours under instrument.beam.path, or use the one in the mwa_pb package (the default)"
    download(URL, path, instead, known_hash=SHA256, progress=progress)
    return path


def find_beam() -> Path:
    """Return the beam file of the mwa_pb package, or where that has none, the one that was fetched.

    Raises
    ------
    InputError
        If there is neither.
    """
    places = (Path(str(files("mwa_pb") / "data" / FILE)), default_directory() / FILE)
    found = next((path for path in places if path.is_file()), None)
    if found is None:
        raise InputError(
            "instrument.beam: the mwa_pb package was installed without its beam file; get it with "
            "'calstudy data fetch beam', or give a file under instrument.beam.path"
        )
    return found
