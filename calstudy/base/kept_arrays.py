"""Arrays that are slow to compute, stored on this machine for later processes."""

from __future__ import annotations

import logging
import os
import zipfile
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from calstudy.base.files import digest_json, replacing
from calstudy.base.package_files import default_directory

logger = logging.getLogger(__name__)

MOST = 16
"""Number of files of one name that are kept: the most recently used ones."""
DAMAGE = (OSError, ValueError, LookupError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""Errors that numpy raises for an .npz file that was changed or truncated."""


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of an npz file; raises one of `DAMAGE` if it cannot be read."""
    # numpy does not close a damaged file that it opens itself.
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        return dict(file)


def kept_arrays(
    name: str, identity: Mapping[str, Any], compute: Callable[[], Mapping[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """Read arrays that an earlier process stored under a name or, if there are none, compute and store them.

    `identity` are all values on which the arrays depend, JSON-able. Strings and numbers are returned as arrays without
    axes. If the folder cannot be written, only time is lost.
    """
    path = default_directory() / f"{name}-{digest_json(identity)}.npz"
    try:
        arrays = read_arrays(path)
        with suppress(OSError):
            os.utime(path)
        return arrays
    except FileNotFoundError:
        logger.info("%s: computed, for %s is not there", name, path)
    except DAMAGE as error:
        logger.warning("%s: computed, for %s cannot be read (%s)", name, path, error)
    arrays = {key: np.asarray(value) for key, value in compute().items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as target:
            np.savez(target, allow_pickle=False, **arrays)
        _remove_oldest(path.parent, name)
    except OSError as error:
        logger.warning("%s: not kept in %s (%s)", name, path.parent, error)
    return arrays


def _remove_oldest(folder: Path, name: str) -> None:
    """Remove the files of a name beyond `MOST`; a process that reads one of them keeps it open."""
    kept = sorted(folder.glob(f"{name}-*.npz"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in kept[MOST:]:
        path.unlink(missing_ok=True)
