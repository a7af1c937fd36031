"""The comparison of engines: it measures what it says."""

import sys

import pytest
from typer.testing import CliRunner

from calstudy.base.errors import InputError
from calstudy.bench import engines
from calstudy.bench.engines import Timing, Work, time_engines
from calstudy.cli.bench import bench_app

SMALL = Work(sources=300, antennas=3, channels=1)


def check(timings: list[Timing]) -> dict[tuple[str, str], Timing]:
    """Assert what holds of any engines compared with pyuvsim; return the timings by engine and precision."""
    assert [t.seconds for t in timings] == sorted(t.seconds for t in timings)
    found = {(t.engine, t.precision): t for t in timings}
    reference = found["pyuvsim", "double"]
    assert reference.ratio == 1
    assert reference.error == 0
    assert found["dense", "double"].error < 1e-12
    for timing in timings:
        assert timing.ratio == pytest.approx(reference.seconds / timing.seconds)
        assert 5e7 < timing.memory < 5e9
    return found


def test_an_engine_is_compared_with_pyuvsim_on_the_same_work(monkeypatch):
    # Every engine and precision is a process that reads the beam, most of what the comparison takes.
    monkeypatch.setattr(engines, "CANDIDATES", (("dense", "double"), ("pyuvsim", "double")))
    announced = []
    timings = time_engines(SMALL, ["dense", "pyuvsim"], announced.append)
    assert announced == ["dense (double)", "pyuvsim (double)"]
    assert len(check(timings)) == 2


@pytest.mark.slow
def test_engines_are_compared_in_their_precisions():
    announced = []
    found = check(time_engines(SMALL, ["dense", "pyuvsim"], announced.append))
    assert announced == ["dense (double)", "dense (single)", "pyuvsim (double)"]
    assert 1e-9 < found["dense", "single"].error < 1e-5


def test_an_unknown_engine_is_refused():
    with pytest.raises(InputError, match=r"--engines oskar: .*allowed: dense, matvis, fftvis, pyuvsim"):
        time_engines(Work(), ["oskar"])


def test_an_engine_without_its_package_is_refused_before_any_is_run(monkeypatch):
    monkeypatch.setitem(sys.modules, "matvis", None)
    announced = []
    with pytest.raises(InputError, match=r"'matvis': needs the package matvis, .* 'calstudy\[engines\]'"):
        time_engines(SMALL, ["dense", "matvis"], announced.append)
    assert announced == []


@pytest.mark.parametrize(("path", "reason"), [("table.txt", "must end in .csv or .md"), ("no/table.md", "no folder")])
def test_a_table_that_cannot_be_written_is_refused_before_measuring(tmp_path, path, reason):
    result = CliRunner().invoke(bench_app, ["simulate", "--output", str(tmp_path / path)])
    assert isinstance(result.exception, InputError)
    assert reason in str(result.exception)
