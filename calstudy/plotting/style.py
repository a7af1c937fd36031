"""The style of every figure: sizes, colours, fonts, axis labels, and the note on stand-ins; and its files."""

from __future__ import annotations

import dataclasses
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from threading import RLock
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.base.files import replacing

if TYPE_CHECKING:
    # Modules that draw name these types as `style.Axes` and `style.Figure`.
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D


ONE_COLUMN = 3.5
"""Width of a figure in one journal column, in inches."""
TWO_COLUMNS = 7.1
"""Width of a figure across both journal columns, in inches."""

# Okabe & Ito (2008): distinguishable with every common kind of colour blindness.
BLACK = "#000000"
ORANGE = "#E69F00"
CYAN = "#56B4E9"
GREEN = "#009E73"
BLUE = "#0072B2"
RED = "#D55E00"
MAGENTA = "#CC79A7"
GREY = "#6E6E6E"
BAND = "#C9C9C9"

SERIES = (("o", BLUE), ("s", ORANGE), ("D", GREEN), ("^", MAGENTA), ("v", RED), ("P", CYAN), ("X", BLACK))
"""Marker and colour of several series of points."""
OPEN_MARKER: dict[str, Any] = {"marker": "o", "markerfacecolor": "white", "color": GREY, "markersize": 4}
"""The entry of a legend for negative points, which are drawn open."""

FREQUENCY = "frequency (MHz)"
DELAY = "delay (ns)"
WAVENUMBER = r"$k$ ($h\,\mathrm{Mpc}^{-1}$)"
K_PERPENDICULAR = r"$k_\perp$ ($h\,\mathrm{Mpc}^{-1}$)"
K_PARALLEL = r"$k_\parallel$ ($h\,\mathrm{Mpc}^{-1}$)"
BASELINE_LENGTH = r"$|\mathbf{b}|$ (m)"
POWER_UNIT = r"$\mathrm{mK}^2\,h^{-3}\,\mathrm{Mpc}^3$"

NOTE_SIZE = 6.0
SMALL_SIZE = 6.5
_PARAMETERS = {
    "font.family": "STIXGeneral",
    "mathtext.fontset": "stix",
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.5,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.fontsize": 7.0,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "legend.borderaxespad": 0.3,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.0,
    "lines.markersize": 3.0,
    "lines.markeredgewidth": 0.7,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "xtick.top": True,
    "ytick.right": True,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "xtick.major.size": 3.0,
    "ytick.major.size": 3.0,
    "xtick.minor.size": 1.6,
    "ytick.minor.size": 1.6,
    "figure.dpi": 100,
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "path.simplify": True,
}
_LOCK = RLock()


@contextmanager
def journal_style() -> Iterator[None]:
    """Draw or save with the settings of this module, regardless of the user's; also a decorator.

    All figures of a study, also those of plug-ins, are drawn in it.

    Matplotlib's settings are global to the process: they are restored on exit, and a lock keeps two threads of a study
    from drawing at once.
    """
    import matplotlib.style

    with _LOCK, matplotlib.style.context(["default", _PARAMETERS]):
        yield


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of `width` × `height` inches that is not registered with pyplot."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def label_one_two_five(axis: Axis) -> None:
    """Label 1, 2 and 5 of each decade of a logarithmic axis, and nothing between them."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    # Matplotlib labels minor ticks as well where few major ones are in view.
    axis.set_minor_formatter(NullFormatter())


def band_name(low: float, high: float) -> str:
    """Return a band of k, h/Mpc, as a title or label."""
    return rf"$k = {low:g}$–${high:g}$ $h\,\mathrm{{Mpc}}^{{-1}}$"


def error_bars(axes: Axes, x: np.ndarray, values: np.ndarray, error: np.ndarray, **look: Any) -> None:
    """Draw values with bars of 95 %, from standard deviations; a value whose error is not known has no bar."""
    axes.errorbar(x, values, yerr=SIGMAS_95 * np.nan_to_num(error), **{"elinewidth": 0.7, **look})


def entry(**look: Any) -> Line2D:
    """Return a line that is drawn in a legend alone."""
    from matplotlib.lines import Line2D

    return Line2D([], [], **look)


def note_stand_ins(figure: Figure, stand_ins: Sequence[str]) -> None:
    """Print the substitutes for the paper's inputs as one small grey line below the axes, and return the text.

    Each is a sentence or phrase, such as ``"synthetic faint sources"``. Without any, nothing is printed, and None is
    returned.
    """
    if not stand_ins:
        return
    text = "stand-in: " + "; ".join(item.strip().rstrip(".") for item in stand_ins)
    # About 28 characters of this font and size are one inch wide.
    lines = textwrap.fill(text, width=int(28 * figure.get_figwidth()))
    figure.supxlabel(lines, x=0.01, ha="left", fontsize=NOTE_SIZE, color=GREY)


DOTS_PER_INCH = 200
RASTER_DOTS_PER_INCH = 600
"""Resolution of the parts of the vector graphics that are pixels, such as the cells of the wedge."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def figure_arrays(data: Any, path: str = "") -> dict[str, np.ndarray]:
    """Return every array of nested dataclasses, mappings and sequences by its path, ``"excised.residual.power"``.

    None means absent; raises ValueError for other values than arrays, numbers and strings. A field of a dataclass may
    have another name there, under ``array`` in its metadata, so that published arrays keep their names.
    """
    if data is None:
        return {}
    if dataclasses.is_dataclass(data):
        fields = dataclasses.fields(data)
        items: Any = [(field.metadata.get("array", field.name), getattr(data, field.name)) for field in fields]
    elif isinstance(data, Mapping):
        items = data.items()
    elif isinstance(data, list | tuple) and not all(map(np.isscalar, data)):
        items = enumerate(data)
    else:
        return {path: _plain_array(path, data)}
    prefix = f"{path}." if path else ""
    return {key: array for name, item in items for key, array in figure_arrays(item, f"{prefix}{name}").items()}


def _plain_array(name: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "biufcU":
        raise ValueError(f"array '{name}' has dtype {array.dtype}: only numbers, booleans and strings are saved")
    return array


def save_figure(figure: Figure, arrays: Mapping[str, np.ndarray], directory: Path | str, name: str) -> list[Path]:
    """Write ``name.npz``, ``name.pdf`` and ``name.png`` (200 dpi) into `directory`, and return the three paths.

    Each file is written completely or not at all, and replaces an older one. The same figure and arrays give the same
    bytes: no dates are written. Raises ValueError if the name has other characters than letters, digits, ``.``, ``_``
    and ``-``, or an array (`figure_arrays`) is not plain, and OSError if the directory cannot be made or written.
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
    layout = figure.get_layout_engine() if figure.axes else None
    with journal_style():
        if layout is not None:
            # Matplotlib would lay it out again for each file.
            layout.execute(figure)
            figure.set_layout_engine(None)
        for path, write in zip(paths, writers.values(), strict=True):
            with replacing(path) as stream:
                write(stream)
    if layout is not None:
        figure.set_layout_engine(layout)
    return paths
