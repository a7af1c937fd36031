"""What all figures owe the reader: units, legible text inside the page, stand-ins named, no global state touched."""

from __future__ import annotations

import re
from itertools import combinations
from threading import Event, Thread

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text

from calstudy.plotting import style

DIMENSIONLESS = {
    r"Re $g_{0}$",
    r"Re $g_{1}$",
    "Re residual,\nas fitted",
    "Re residual,\naligned",
    r"$|\widetilde{g}(\tau)|$",
    "number of antennas",
}


def all_axes(figure: Figure) -> list:
    return [*figure.axes, *(child for axes in figure.axes for child in axes.child_axes)]


def pixels(figure: Figure) -> np.ndarray:
    with style.journal_style():
        figure.canvas.draw()
        return np.asarray(figure.canvas.buffer_rgba()).copy()


STAND_INS = ("synthetic faint sources, " * 5 + "all of them.", "small scale")
"""More than one line of them."""


@pytest.fixture(scope="module")
def drawn(draw_all) -> tuple[dict[str, Figure], list[dict[str, object]]]:
    """All figures, and matplotlib's settings before and after they are drawn."""
    settings = [dict(matplotlib.rcParams)]
    figures = draw_all()
    return figures, [*settings, dict(matplotlib.rcParams)]


@pytest.fixture(scope="module")
def plain(drawn) -> dict[str, Figure]:
    return drawn[0]


@pytest.fixture(scope="module")
def noted(draw_all) -> dict[str, Figure]:
    """All figures with stand-ins, laid out."""
    figures = draw_all(STAND_INS)
    for figure in figures.values():
        with style.journal_style():
            figure.draw_without_rendering()
    return figures


def test_every_axis_label_has_its_unit(plain):
    for name, figure in plain.items():
        labels = {text for axes in all_axes(figure) for text in (axes.get_xlabel(), axes.get_ylabel())} - {""}
        assert len(labels) >= 2, name
        without = {label for label in labels if not re.search(r"\([^)]*(m|Hz|ns|Jy|s|Mpc.*)\)$", label)}
        assert without <= DIMENSIONLESS, name


def test_text_is_inside_the_page_and_large_enough_to_read(noted):
    for name, figure in noted.items():
        assert figure.get_figwidth() in (style.ONE_COLUMN, style.TWO_COLUMNS)
        with style.journal_style():
            used = figure.get_tightbbox()
        assert used.x0 >= 0, name
        assert used.y0 >= 0, name
        assert used.x1 <= figure.get_figwidth(), name
        assert used.y1 <= figure.get_figheight(), name
        texts = [text for text in figure.findobj(Text) if text.get_text()]
        assert min(text.get_fontsize() for text in texts) >= 5, name


@pytest.mark.chain
def test_stand_ins_are_printed_below_everything_and_only_when_there_are_any(plain, noted):
    for name, figure in noted.items():
        (note,) = [text for text in figure.findobj(Text) if "stand-in" in text.get_text()]
        assert note.get_text().replace("\n", " ") == f"stand-in: {STAND_INS[0].rstrip('.')}; {STAND_INS[1]}"
        box = note.get_window_extent()
        assert all(box.y1 <= axes.get_tightbbox().y0 + 0.5 for axes in figure.axes if axes.get_visible()), name
        assert not [text for text in plain[name].findobj(Text) if "stand-in" in text.get_text()]


def test_no_setting_and_no_pyplot_figure_is_left_behind(drawn):
    _, (before, after) = drawn
    assert after == before
    assert plt.get_fignums() == []


def test_settings_are_restored_after_an_error():
    before = dict(matplotlib.rcParams)
    with pytest.raises(RuntimeError), style.journal_style():
        raise RuntimeError
    assert dict(matplotlib.rcParams) == before


@pytest.mark.chain
def test_pictures_do_not_depend_on_the_users_settings(draw_all):
    some = ("layout", "wedge", "spherical one column", "gains", "runtime")
    expected = {name: pixels(figure) for name, figure in draw_all(only=some).items()}
    with matplotlib.rc_context({"font.size": 20, "lines.linewidth": 7, "axes.facecolor": "red", "figure.dpi": 50}):
        for name, figure in draw_all(only=some).items():
            np.testing.assert_array_equal(pixels(figure), expected[name], err_msg=name)


def test_threads_take_turns():
    entered = Event()

    def draw() -> None:
        with style.journal_style():
            entered.set()

    thread = Thread(target=draw)
    with style.journal_style():
        thread.start()
        assert not entered.wait(0.3)
    assert entered.wait(10)
    thread.join()


def deuteranopic(colour: str) -> np.ndarray:
    """Return what Viénot, Brettel & Mollon (1999) say a person without green cones sees, linear RGB."""
    linear = np.array(
        [value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4 for value in to_rgb(colour)]
    )
    to_cones = np.array([[17.8824, 43.5161, 4.11935], [3.45565, 27.1554, 3.86714], [0.0299566, 0.184309, 1.46709]])
    red, _, blue = to_cones @ linear
    return np.linalg.solve(to_cones, [red, 0.494207 * red + 1.24827 * blue, blue])


def test_colours_stay_apart_without_green_cones():
    colours = (style.BLACK, style.RED, style.ORANGE, style.CYAN, style.MAGENTA)
    for first, second in combinations(colours, 2):
        assert np.abs(deuteranopic(first) - deuteranopic(second)).max() > 0.1, (first, second)
