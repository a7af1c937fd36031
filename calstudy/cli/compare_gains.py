"""``calstudy compare-gains``: differences of the gains of two files, after alignment of the degenerate terms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calstudy.calibrate.gain_comparison import GainDifference

NAME = "gain-comparison"
MOST_NAMES = 40
"""Largest number of antennas that are named on the axis."""

First = Annotated[Path, typer.Argument(help="Gains, a CalH5 or calfits file.", show_default=False)]
Second = Annotated[Path, typer.Argument(help="Gains that they are compared with, such as the true ones.")]
Redundant = Annotated[
    bool,
    typer.Option(
        "--redundant", help="Also leave out an amplitude and a phase gradient in every channel, as redundancy does."
    ),
]
Feed = Annotated[int, typer.Option(min=0, help="Which of the feeds that both files have, counted from 0.")]
Folder = Annotated[Path, typer.Option("--output", help="Folder for figure, arrays and numbers.")]


def compare_gains(
    first: First, second: Second, redundant: Redundant = False, feed: Feed = 0, folder: Folder = Path("checks")
) -> None:
    """Compare two files of gains by antenna, channel and delay.

    Antennas, feeds and channels that are in one file only are left out. One phase in every channel and one real
    scale are removed in every integration, because no data determine them.
    """
    from calstudy.base.gains import at_common_channels, read_gains
    from calstudy.calibrate.gain_comparison import compare_gains, pair_gains
    from calstudy.plotting import style
    from calstudy.plotting.save import figure_arrays, save_figure
    from calstudy.products.files import quiet_libraries

    with quiet_libraries():
        files = read_gains(first, "the first file"), read_gains(second, "the second file")
        found = compare_gains(pair_gains(*at_common_channels(*files), feed), redundant)
    numbers = _numbers(found)
    for name, value in numbers.items():
        typer.echo(f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value}")
    with style.journal_style():
        figure = _draw(found)
    for path in save_figure(figure, figure_arrays(found), folder, NAME):
        typer.echo(f"{path}")
    path = folder / f"{NAME}.json"
    path.write_text(json.dumps(numbers, indent=1), encoding="utf-8")
    typer.echo(f"{path}")


def _numbers(found: GainDifference) -> dict[str, float | int | str]:
    import numpy as np

    worst = int(np.nanargmax(found.of_antenna))
    return {
        "antennas": int(np.isfinite(found.of_antenna).sum()),
        "channels": int(np.isfinite(found.of_channel).sum()),
        "difference": found.together,
        "difference as given": found.as_given,
        "median over antennas": float(np.nanmedian(found.of_antenna)),
        "worst antenna": str(found.pair.antennas[worst]),
        "difference of the worst antenna": float(found.of_antenna[worst]),
        "worst channel [MHz]": float(found.pair.frequency[np.nanargmax(found.of_channel)] / 1e6),
        "difference of the worst channel": float(np.nanmax(found.of_channel)),
        "worst delay [ns]": float(1e9 * found.delay[np.argmax(found.of_delay)]),
        "difference at the worst delay": float(found.of_delay.max()),
    }


def _draw(found: GainDifference) -> Figure:
    """Draw the relative difference by antenna, by channel and by delay, on logarithmic axes."""
    import numpy as np

    from calstudy.plotting import style

    figure = style.new_figure(style.TWO_COLUMNS, 2.4)
    by_antenna, by_channel, by_delay = figure.subplots(1, 3)
    place = np.arange(found.of_antenna.size)
    by_antenna.plot(place, found.of_antenna, "o", color=style.BLUE)
    if place.size <= MOST_NAMES:
        by_antenna.set_xticks(place, found.pair.antennas, rotation=90, fontsize=style.NOTE_SIZE)
    by_antenna.set_xlabel("antenna")
    by_antenna.set_ylabel("rms difference / rms")
    by_channel.plot(found.pair.frequency / 1e6, found.of_channel, color=style.BLUE)
    by_channel.set_xlabel(style.FREQUENCY)
    by_delay.plot(1e9 * found.delay, found.of_delay, color=style.BLUE)
    by_delay.set_xlabel(style.DELAY)
    for axes in (by_antenna, by_channel, by_delay):
        if np.nanmax(axes.lines[0].get_ydata()) > 0:
            axes.set_yscale("log")
    by_channel.set_title(f"feed {found.pair.polarization}; together {found.together:.3g}")
    return figure
