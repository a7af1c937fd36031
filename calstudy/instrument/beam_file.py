"""The file of the MWA full embedded element beam: location and download."""

from __future__ import annotations

from pathlib import Path

from calstudy.base.downloads import default_directory, download
from calstudy.base.errors import InputError
from calstudy.base.package_files import PackageFile

PACKAGED = PackageFile("mwa_pb", "data/mwa_full_embedded_element_pattern.h5")
FILE = PACKAGED.path.name
URL = f"http://ws.mwatelescope.org/static/{FILE}"
SHA256 = "a7649c6e03b8128a1de4614c2f363af5fa44f3890ae27bf893d56ca337bc48ee"
"""SHA-256 of the file in mwa_pb 1.1, which was downloaded from the same address when the package was built."""


def fetch_beam(directory: Path | None = None, progress: bool = True) -> Path:
    """Download the embedded element beam (Sokolowski et al. 2017, 133 MB), or verify an existing copy.

    Parameters
    ----------
    directory
        Where to put it, `calstudy.base.downloads.default_directory` by default; made if need be.
    progress
        Whether to show a progress bar.

    Raises
    ------
    InputError
        If the download fails or is not the file.
    """
    path = (default_directory() if directory is None else directory) / FILE
    instead = "set instrument.beam.path to your own copy, or use the file of the mwa_pb package (the default)"
    download(URL, path, instead, known_hash=SHA256, progress=progress)
    return path


def find_beam() -> Path:
    """Return the path of the beam file in the mwa_pb package or, if that has none, of the downloaded file.

    Raises
    ------
    InputError
        If there is neither.
    """
    packaged = PACKAGED.path
    if packaged.is_file():
        return packaged
    downloaded = default_directory() / FILE
    if not downloaded.is_file():
        raise InputError(
            "instrument.beam: the mwa_pb package was installed without its beam file; download it with "
            "'calstudy data fetch beam', or set instrument.beam.path to a file"
        )
    return downloaded
