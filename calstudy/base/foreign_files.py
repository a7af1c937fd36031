"""Files of others: what they name, and what they may not reach."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.error import URLError

from pydantic import StringConstraints

from calstudy.base.errors import InputError

if TYPE_CHECKING:
    import h5py

FileName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)]
"""The name of a file in the folder of what names it, and of nothing above or below."""


def reason_of(error: Exception) -> str:
    """Return why a library cannot read a file, in one line."""
    if isinstance(error, URLError):
        # From a list that astropy keeps once it has it.
        missing = "it lacks the location of its telescope, and the list of telescopes could not be fetched"
        return f"{missing}: {error.reason}"
    line, *_ = str(error).strip().splitlines() or [""]
    # The message of a missing key is the key alone.
    kind = f"{type(error).__name__}: " if isinstance(error, LookupError) or not line else ""
    return kind + (line or "no reason given")


def require_inside(path: Path, folder: Path) -> None:
    """Raise InputError if a file or folder, or what a folder holds, is a link that leads out of a folder."""
    root = folder.resolve()
    for found in (path, *(path.rglob("*") if path.is_dir() else ())):
        if not found.resolve().is_relative_to(root):
            raise InputError(f"{found}: is a link that leads out of {folder}; put the file itself there")


def require_self_contained(path: Path) -> None:
    """Raise InputError if an HDF5 file takes anything from other files; files of other formats pass.

    External links, external raw data and virtual data sets name files of the machine that reads them, such as the true
    gains that it keeps, and would be followed without a word.
    """
    import h5py

    try:
        if not (path.is_file() and h5py.is_hdf5(path)):
            return
        with h5py.File(path, "r") as file:
            found = _foreign(file)
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as HDF5 ({error})") from None
    if found is not None:
        raise InputError(f"{path}: {found}; write it again as one file that holds all of its data")


def _foreign(file: h5py.File) -> str | None:
    """Return in words what a file takes from other files, or None."""
    import h5py

    groups, seen = [file["/"]], {hash(file["/"].id)}
    while groups:
        group = groups.pop()
        for name in group:
            link = group.get(name, getlink=True)
            if isinstance(link, h5py.SoftLink):
                continue  # Its target is found as what it is.
            if not isinstance(link, h5py.HardLink):
                return f"{group.name.rstrip('/')}/{name} is an external link"
            item = group[name]
            if isinstance(item, h5py.Dataset) and (item.is_virtual or item.external):
                return f"{item.name} is {'a virtual data set' if item.is_virtual else 'external raw data'}"
            if isinstance(item, h5py.Group) and hash(item.id) not in seen:
                seen.add(hash(item.id))
                groups.append(item)
    return None
