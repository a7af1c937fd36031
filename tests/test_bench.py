"""The comparison of engines: it measures what it says, and its tables can be read back."""

import csv

import pytest
from rich.console import Console
from typer.testing import CliRunner

from calstudy.bench import tables
from calstudy.bench.engines import Work, compare_engines
from calstudy.commands.bench import bench_app
from calstudy.errors import InputError


def test_engines_are_compared_with_pyuvsim_on_the_same_work():
    told = []
    timings = compare_engines(Work(sources=300, antennas=3, channels=1), ["dense", "pyuvsim"], told.append)
    assert told == ["dense (double)", "dense (single)", "pyuvsim (double)"]
    assert [t.seconds for t in timings] == sorted(t.seconds for t in timings)
    found = {(t.engine, t.precision): t for t in timings}
    reference = found["pyuvsim", "double"]
    assert reference.ratio == 1
    assert reference.error == 0
    assert found["dense", "double"].error < 1e-12
    assert 1e-9 < found["dense", "single"].error < 1e-5
    for timing in timings:
        assert timing.ratio == pytest.approx(reference.seconds / timing.seconds)
        assert 5e7 < timing.memory < 5e9


def test_an_unknown_engine_is_refused():
    with pytest.raises(InputError, match=r"--engines oskar: .*allowed: dense, matvis, fftvis, pyuvsim"):
        compare_engines(Work(), ["oskar"])


def test_a_table_reads_back(tmp_path):
    headings, rows = ("engine", "seconds"), [("dense, double", "0.1"), ("pyuvsim, double", "5")]
    for name in ("table.csv", "table.md"):
        tables.write(tmp_path / name, headings, rows)
    with (tmp_path / "table.csv").open(newline="") as file:
        assert [tuple(row) for row in csv.reader(file)] == [headings, *rows]
    lines = (tmp_path / "table.md").read_text().splitlines()
    assert lines[0] == "| engine | seconds |"
    assert lines[3] == "| pyuvsim, double | 5 |"
    console = Console(record=True, width=80)
    tables.show("title", headings, rows, console)
    assert "dense, double" in console.export_text()


@pytest.mark.parametrize(("path", "told"), [("table.txt", "must end in .csv or .md"), ("no/table.md", "no folder")])
def test_a_table_that_cannot_be_written_is_refused_before_measuring(tmp_path, path, told):
    result = CliRunner().invoke(bench_app, ["simulate", "--output", str(tmp_path / path)])
    assert isinstance(result.exception, InputError)
    assert told in str(result.exception)
