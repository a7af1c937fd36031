from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from calstudy.figures.spherical import draw_spherical
from calstudy.figures.wedge import draw_wedge
from calstudy.plotting.style import figure_arrays, save_figure


@dataclass(frozen=True)
class Inner:
    power: np.ndarray
    title: str
    missing: np.ndarray | None = None


@dataclass(frozen=True)
class Outer:
    panels: tuple[Inner, ...]
    antennas: tuple[int, int]
    series: dict[str, np.ndarray]


def test_arrays_are_named_by_the_path_to_them():
    data = Outer((Inner(np.arange(3) * 1j, "left"), Inner(np.ones(2), "right")), (0, 1), {"noise": np.zeros(4)})
    arrays = figure_arrays(data)
    assert set(arrays) == {
        "panels.0.power", "panels.0.title", "panels.1.power", "panels.1.title", "antennas", "series.noise",
    }  # fmt: skip
    np.testing.assert_array_equal(arrays["panels.0.power"], [0, 1j, 2j])
    np.testing.assert_array_equal(arrays["antennas"], [0, 1])
    assert str(arrays["panels.1.title"]) == "right"


def test_saved_arrays_are_those_drawn_and_need_no_pickle(wedge_panels, tmp_path):
    arrays = figure_arrays(wedge_panels)
    paths = save_figure(draw_wedge(wedge_panels), arrays, tmp_path / "new" / "folder", "wedge")
    assert [path.name for path in paths] == ["wedge.npz", "wedge.pdf", "wedge.png"]
    with np.load(paths[0], allow_pickle=False) as stored:
        assert set(stored.files) == set(arrays)
        np.testing.assert_array_equal(stored["residual.power"], wedge_panels["residual"].power)
        np.testing.assert_array_equal(stored["eor.delay"], wedge_panels["eor"].delay)
    assert paths[1].read_bytes().startswith(b"%PDF")
    assert imread(paths[2]).shape[:2] == (700, 1420)


@pytest.mark.chain
def test_same_figure_gives_the_same_bytes_at_another_time(wedge_panels, make_column, tmp_path, monkeypatch):
    for draw, data in ((draw_wedge, wedge_panels), (draw_spherical, [make_column(1)])):
        contents = []
        for when, names in (("0", "ab"), ("1500000000", "ba")):
            monkeypatch.setenv("SOURCE_DATE_EPOCH", when)
            arrays = {name: np.full(3, ord(name)) for name in names}
            contents.append([path.read_bytes() for path in save_figure(draw(data), arrays, tmp_path / when, "figure")])
        assert contents[0] == contents[1]
        assert b"CreationDate" not in contents[0][1]


def test_failure_leaves_the_older_files_and_no_debris(tmp_path, monkeypatch):
    figure = Figure()
    save_figure(figure, {"x": np.ones(1)}, tmp_path, "wedge")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def fail_half_way(stream, **_):
        stream.write(b"%PDF half")
        raise OSError("disk full")

    monkeypatch.setattr(figure, "savefig", fail_half_way)
    with pytest.raises(OSError, match="disk full"):
        save_figure(figure, {"x": np.ones(1)}, tmp_path, "wedge")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_files_appear_whole(tmp_path, monkeypatch):
    """Whatever is under the final name is complete at the moment it gets that name."""
    sizes = {}
    replace = os.replace

    def record(source, target):
        assert not os.path.exists(target)  # noqa: PTH110
        sizes[os.path.basename(target)] = os.path.getsize(source)  # noqa: PTH119, PTH202
        replace(source, target)

    monkeypatch.setattr(os, "replace", record)
    paths = save_figure(Figure(), {"x": np.ones(1)}, tmp_path, "wedge")
    assert sizes == {path.name: path.stat().st_size for path in paths}


@pytest.mark.parametrize("name", ["", "../wedge", "a/b", ".hidden", "a b"])
def test_names_that_are_not_file_names_are_refused(tmp_path, name):
    with pytest.raises(ValueError, match="is not a file name"):
        save_figure(Figure(), {}, tmp_path, name)


def test_objects_are_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match="array 'x' has dtype object"):
        save_figure(Figure(), {"x": np.array([None])}, tmp_path, "wedge")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match=r"array 'panels\.0' has dtype object"):
        figure_arrays({"panels": [object()]})
