"""The style of every figure: sizes, colours, fonts, axis labels, and the note on stand-ins."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from threading import RLock
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.text import Text

ONE_COLUMN = 3.5
"""Width of a figure in one journal column, in inches."""
TWO_COLUMNS = 7.1
"""Width of a figure across both journal columns, in inches."""

# Okabe & Ito (2008): distinguishable with every common kind of colour blindness.
BLACK = "#000000"
ORANGE = "#E69F00"
CYAN = "#56B4E9"
GREEN = "#009E73"
YELLOW = "#F0E442"
BLUE = "#0072B2"
RED = "#D55E00"
MAGENTA = "#CC79A7"
GREY = "#6E6E6E"
BAND = "#C9C9C9"

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


def note_stand_ins(figure: Figure, stand_ins: Sequence[str]) -> Text | None:
    """Print the substitutes for the paper's inputs as one small grey line below the axes, and return the text.

    Each is a sentence or phrase, such as ``"synthetic faint sources"``. Without any, nothing is printed, and None is
    returned.
    """
    if not stand_ins:
        return None
    text = "stand-in: " + "; ".join(item.strip().rstrip(".") for item in stand_ins)
    # About 28 characters of this font and size are one inch wide.
    lines = textwrap.fill(text, width=int(28 * figure.get_figwidth()))
    return figure.supxlabel(lines, x=0.01, ha="left", fontsize=NOTE_SIZE, color=GREY)
