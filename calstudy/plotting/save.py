"""Figures on disk: picture, vector graphics and the arrays that were drawn."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from calstudy.base.files import replacing
from calstudy.plotting.style import journal_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOTS_PER_INCH = 200
RASTER_DOTS_PER_INCH = 600
"""Resolution of the parts of the vector graphics that are pixels, such as the cells of the wedge."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def figure_arrays(data: Any) -> dict[str, np.ndarray]:
    """Return every array in a figure's data by name.

    Raises ValueError if a value is neither an array, a number, a string nor None.

    Parameters
    ----------
    data : dataclasses, mappings and sequences, nested, that contain arrays, numbers and strings; None means absent

    Returns
    -------
    Arrays by the path that leads to them, joined by dots: ``"excised.residual.power"``. A field of a dataclass may have
    another name there, under ``array`` in its metadata, so that published arrays keep their names.
    """
    arrays: dict[str, np.ndarray] = {}
    _collect("", data, arrays)
    return arrays


def _collect(path: str, value: Any, arrays: dict[str, np.ndarray]) -> None:
    prefix = f"{path}." if path else ""
    if value is None:
        return
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            name = field.metadata.get("array", field.name)
            _collect(prefix + name, getattr(value, field.name), arrays)
    elif isinstance(value, Mapping):
        for key, item in value.items():
            _collect(f"{prefix}{key}", item, arrays)
    elif isinstance(value, list | tuple) and any(not np.isscalar(item) for item in value):
        for index, item in enumerate(value):
            _collect(f"{prefix}{index}", item, arrays)
    else:
        arrays[path] = _plain_array(path, value)


def _plain_array(name: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "biufcU":
        raise ValueError(f"array '{name}' has dtype {array.dtype}: only numbers, booleans and strings are saved")
    return array


def save_figure(figure: Figure, arrays: Mapping[str, np.ndarray], directory: Path | str, name: str) -> list[Path]:
    """Write ``name.npz``, ``name.pdf`` and ``name.png`` (200 dpi) into `directory`, and return the three paths.

    Each file is written completely or not at all, and replaces an older one. The same figure and arrays give the same
    bytes: no dates are written. Raises ValueError if the name is not a plain file name, or an array is not plain, and
    OSError if the directory cannot be written.

    Parameters
    ----------
    arrays : plain arrays (numbers, booleans, strings) by name; see `figure_arrays`
    directory : created if it does not exist
    name : file name without extension: letters, digits, ``.``, ``_`` and ``-``
    """
    if not _NAME.fullmatch(name):
        raise ValueError(f"figure name '{name}' is not a file name: use letters, digits, '.', '_' and '-'")
    plain = {key: _plain_array(key, arrays[key]) for key in sorted(arrays)}
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    writers: dict[str, Callable[[IO[bytes]], None]] = {
        "npz": lambda stream: np.savez_compressed(stream, allow_pickle=False, **plain),
        "pdf": partial(figure.savefig, format="pdf", dpi=RASTER_DOTS_PER_INCH, metadata={"CreationDate": None}),
        "png": partial(figure.savefig, format="png", dpi=DOTS_PER_INCH, metadata={"Software": None}),
    }
    paths = [folder / f"{name}.{ending}" for ending in writers]
    with journal_style(), _laid_out(figure):
        for path, write in zip(paths, writers.values(), strict=True):
            with replacing(path) as stream:
                write(stream)
    return paths


@contextmanager
def _laid_out(figure: Figure) -> Iterator[None]:
    """Lay out a figure once; matplotlib would draw it an additional time for each file."""
    layout = figure.get_layout_engine()
    if layout is None or not figure.axes:
        yield
        return
    layout.execute(figure)
    figure.set_layout_engine(None)
    try:
        yield
    finally:
        figure.set_layout_engine(layout)
