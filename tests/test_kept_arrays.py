"""Arrays that are kept for later processes: the same, whole, and never a reason to fail."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from calstudy.base import kept_arrays as module
from calstudy.base.kept_arrays import kept_arrays

ARRAYS = {
    "values": np.random.default_rng(1).standard_normal((40, 50)),
    "complex": np.asfortranarray([[1 + 2j, 3j], [0, -1]]),
    "feeds": np.array(["x", "y"]),
    "text": np.array("any text"),
}
IDENTITY = {"of": "these tests", "version": 1}


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "calstudy"


def refuse():
    raise AssertionError("it was kept")


def require_same(found):
    assert found.keys() == ARRAYS.keys()
    for name, expected in ARRAYS.items():
        np.testing.assert_array_equal(found[name], expected, strict=True)


def test_arrays_come_back_as_they_were(folder):
    require_same(kept_arrays("some", IDENTITY, lambda: ARRAYS))
    require_same(kept_arrays("some", IDENTITY, refuse))
    assert [path.suffix for path in folder.iterdir()] == [".npz"]


@pytest.mark.parametrize(("name", "identity"), [("others", IDENTITY), ("some", {**IDENTITY, "version": 2})])
def test_others_are_computed(name, identity):
    kept_arrays("some", IDENTITY, lambda: ARRAYS)
    assert kept_arrays(name, identity, lambda: {"one": np.ones(1)}).keys() == {"one"}


@pytest.mark.parametrize("damage", ["cut", "one byte", "another format", "objects"])
def test_a_damaged_file_is_made_again(folder, caplog, damage):
    kept_arrays("some", IDENTITY, lambda: ARRAYS)
    (path,) = folder.iterdir()
    content = bytearray(path.read_bytes())
    if damage == "objects":
        np.savez(path, values=np.array([{}], dtype=object))
    else:
        content[len(content) // 2] ^= 1
        cut = content[: len(content) // 2]
        path.write_bytes({"cut": cut, "one byte": content, "another format": b"text"}[damage])
    require_same(kept_arrays("some", IDENTITY, lambda: ARRAYS))
    assert "cannot be read" in caplog.text
    require_same(kept_arrays("some", IDENTITY, refuse))


def test_without_a_folder_they_are_computed_each_time(folder, caplog):
    folder.write_text("no folder")
    for _ in range(2):
        require_same(kept_arrays("some", IDENTITY, lambda: ARRAYS))
    assert caplog.text.count("not kept") == 2


def test_several_may_make_them_at_once(folder):
    with ThreadPoolExecutor(8) as pool:
        for found in pool.map(lambda _: kept_arrays("some", IDENTITY, lambda: ARRAYS), range(32)):
            require_same(found)
    assert len(list(folder.iterdir())) == 1


def test_those_used_last_are_kept(folder, monkeypatch):
    monkeypatch.setattr(module, "MOST", 2)
    for version in (1, 2):
        kept_arrays("some", {"version": version}, lambda: ARRAYS)
    for age, path in enumerate(sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)):
        os.utime(path, (1e9 - age, 1e9 - age))
    kept_arrays("others", {}, lambda: ARRAYS)
    kept_arrays("some", {"version": 2}, refuse)
    kept_arrays("some", {"version": 3}, lambda: ARRAYS)
    kept_arrays("some", {"version": 2}, refuse)
    kept_arrays("others", {}, refuse)
    assert len(list(folder.iterdir())) == 3
