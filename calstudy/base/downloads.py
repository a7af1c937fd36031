"""Files that are downloaded once and kept for later runs."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlsplit

from calstudy.base.errors import InputError


def default_directory() -> Path:
    """Return the folder of downloads on this machine."""
    import pooch

    return Path(pooch.os_cache("calstudy"))


def download(url: str, path: Path, instead: str, known_hash: str | None = None, progress: bool = True) -> None:
    """Download a file, completely or not at all, and create its folder.

    An existing file is kept if its SHA-256 is `known_hash`, otherwise it is replaced. `instead` is the alternative for
    the user in the error message. Raises InputError if the server cannot be reached or has no such file, the folder
    cannot be written, or the hash differs.
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
