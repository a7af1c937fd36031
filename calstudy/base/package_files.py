"""Files of packages: what calstudy publishes, data of other packages, and those of mwa_pb, which may be downloaded.

What calstudy publishes is in a checkout its folders ``experiments`` and ``figures``, to which ``calstudy/published``
links; an installed package has copies.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

from calstudy.base.errors import InputError, nearest

PUBLISHED = Path(__file__).resolve().parents[1] / "published"


class PackageFile(NamedTuple):
    """A data file that an installed package brings; products that depend on it have its SHA-256 in their record."""

    package: str
    name: str

    @property
    def path(self) -> Path:
        """Where it is; the package is not imported, which can take a second."""
        found = find_spec(self.package)
        if found is None or found.origin is None:
            raise InputError(f"the package {self.package} is not installed; it brings {self.name}")
        return Path(found.origin).parent / self.name


def published(kind: str) -> Path:
    """Return the folder of published files: "experiments", or "figures" for the reference results."""
    return (PUBLISHED / kind).resolve()


def experiment_names() -> list[str]:
    """Return the names of the published experiments."""
    return sorted(path.stem for path in published("experiments").glob("*.yaml"))


def find_experiment(path: Path) -> Path:
    """Return the path of an experiment file, given its path or the name of a published one, such as ``quickstart``.

    Raises InputError if it is a bare name of neither.
    """
    is_there = path.exists()
    if (is_there and not path.is_dir()) or path.name != str(path) or path.suffix:
        return path
    if path.name in (names := experiment_names()):
        return published("experiments") / f"{path.name}.yaml"
    if is_there:
        return path  # Its reader says that it is a folder.
    hint = nearest(path.name, names)
    raise InputError(f"{path}: neither a file nor a published experiment{hint} (there are: {', '.join(names)})")


def reference_folder() -> Path:
    """Return the folder of reference results: ``figures`` in the working directory, or the published ones.

    Raises InputError if neither exists.
    """
    for folder in (Path("figures"), published("figures")):
        if folder.is_dir():
            return folder
    raise InputError("there are no reference results here; give the folder of some: calstudy regress FOLDER")


def default_directory() -> Path:
    """Return the folder of downloads on this machine."""
    import pooch

    return Path(pooch.os_cache("calstudy"))


def download(url: str, path: Path, instead: str, known_hash: str | None = None, progress: bool = True) -> None:
    """Download a file, completely or not at all; an existing one is kept if its SHA-256 is `known_hash`.

    Raises InputError, with the alternative `instead`, if it cannot be had or written, or the hash differs.
    """
    import pooch
    import requests

    host = urlsplit(url).hostname
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if known_hash is None:
            # pooch accepts any existing file if no hash is known.
            path.unlink(missing_ok=True)
        pooch.retrieve(url, known_hash=known_hash, fname=path.name, path=path.parent, progressbar=progress)
    except (requests.ConnectionError, requests.Timeout):
        raise InputError(f"{path.name}: there is no connection to {host}; {instead}") from None
    except requests.HTTPError as error:
        raise InputError(f"{path.name}: {host} refused it ({error.response.status_code}); {instead}") from None
    except ValueError:
        raise InputError(f"{path.name}: what {host} sent is not the file, its SHA-256 is another; {instead}") from None
    except OSError as error:
        raise InputError(f"{path.name} cannot be downloaded to {path.parent} ({error.strerror or error})") from None


REPOSITORY = (
    "https://raw.githubusercontent.com/MWATelescope/mwa_pb/9fe85fd505277c1b7bb9201dcfcb8d6438a16b5c/mwa_pb/data"
)


@dataclass(frozen=True)
class MwaFile:
    """A data file of mwa_pb 1.1, `packaged` or from `url`; messages say its `content`, and what to do `instead`.

    `fetched_as` is its name for ``calstudy data fetch``.
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
        """Download the file, by default to `default_directory`, or verify an existing copy; errors of `download`."""
        path = (default_directory() if directory is None else directory) / self.name
        download(self.url, path, f"install mwa_pb 1.1, or {self.instead}", known_hash=self.sha256, progress=progress)
        return path

    def find(self) -> Path:
        """Return the path of the file in mwa_pb, or else of the downloaded one; raises InputError without either."""
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
