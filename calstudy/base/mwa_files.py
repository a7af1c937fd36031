"""The three data files of the package mwa_pb that calstudy reads: in the package, or downloaded from elsewhere."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from calstudy.base.downloads import default_directory, download
from calstudy.base.errors import InputError
from calstudy.base.package_files import PackageFile

REPOSITORY = (
    "https://raw.githubusercontent.com/MWATelescope/mwa_pb/9fe85fd505277c1b7bb9201dcfcb8d6438a16b5c/mwa_pb/data"
)


@dataclass(frozen=True)
class MwaFile:
    """A data file of mwa_pb 1.1.

    Attributes
    ----------
    packaged : the file in the package
    content : what it is, for messages
    fetched_as : its name for ``calstudy data fetch``
    url : a source besides the package
    sha256 : of the file in mwa_pb 1.1, which that at the source must have
    instead : what can be done without it, for messages
    """

    packaged: PackageFile
    content: str
    fetched_as: str
    url: str
    sha256: str
    instead: str

    @property
    def name(self) -> str:
        """The name of the file."""
        return Path(self.packaged.name).name

    def fetch(self, directory: Path | None = None, progress: bool = True) -> Path:
        """Download the file, or verify an existing copy.

        Raises InputError if the download fails or is not the file.

        Parameters
        ----------
        directory : where to put it, `calstudy.base.downloads.default_directory` by default; made if need be
        progress : whether to show a progress bar
        """
        path = (default_directory() if directory is None else directory) / self.name
        download(self.url, path, f"install mwa_pb 1.1, or {self.instead}", known_hash=self.sha256, progress=progress)
        return path

    def find(self) -> Path:
        """Return the path of the file in the mwa_pb package or, if that is not there, of the downloaded file.

        Raises InputError if there is neither.
        """
        with suppress(InputError):
            if (packaged := self.packaged.path).is_file():
                return packaged
        found = default_directory() / self.name
        if not found.is_file():
            raise InputError(
                f"{self.content} is missing: the package mwa_pb, which has it, is not installed or is without it; "
                f"download it with 'calstudy data fetch {self.fetched_as}', install mwa_pb 1.1, or {self.instead}"
            )
        return found


BEAM = MwaFile(
    PackageFile("mwa_pb", "data/mwa_full_embedded_element_pattern.h5"),
    "instrument.beam: the MWA's beam (Sokolowski et al. 2017, 133 MB)",
    "beam",
    "http://ws.mwatelescope.org/static/mwa_full_embedded_element_pattern.h5",
    "a7649c6e03b8128a1de4614c2f363af5fa44f3890ae27bf893d56ca337bc48ee",
    "set instrument.beam.path to your own copy",
)
G4JY = MwaFile(
    PackageFile("mwa_pb", "data/G4Jy_catalogue_allEGCcolumns.fits"),
    "sky.foregrounds: the G4Jy catalogue (White et al. 2020)",
    "g4jy",
    f"{REPOSITORY}/G4Jy_catalogue_allEGCcolumns.fits",
    "956a76762624503afd79c19c75dcfe647ef231383f6c3a43fc1bd5d05d25c490",
    "use another kind of sky.foregrounds, such as gleam or file",
)
HASLAM = MwaFile(
    PackageFile("mwa_pb", "data/radio408.RaDec.fits"),
    "sky.diffuse: the 408 MHz map (Haslam et al. 1982)",
    "haslam",
    f"{REPOSITORY}/radio408.RaDec.fits",
    "745e5b405ccc27e1928d8f6e194c1a7d41498465c0ba7211cc8863f1fb31735e",
    "use sky.diffuse: synthetic",
)
MWA_FILES = {file.fetched_as: file for file in (BEAM, G4JY, HASLAM)}
