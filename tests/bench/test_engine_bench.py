"""The comparison of engines: it measures what it says."""

import pytest
from typer.testing import CliRunner

from calstudy.base.errors import InputError
from calstudy.bench.engines import Work, time_engines
from calstudy.cli.bench import bench_app


def test_engines_are_compared_with_pyuvsim_on_the_same_work():
    announced = []
    timings = time_engines(Work(sources=300, antennas=3, channels=1), ["dense", "pyuvsim"], announced.append)
    assert announced == ["dense (double)", "dense (single)", "pyuvsim (double)"]
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
        time_engines(Work(), ["oskar"])


@pytest.mark.parametrize(("path", "reason"), [("table.txt", "must end in .csv or .md"), ("no/table.md", "no folder")])
def test_a_table_that_cannot_be_written_is_refused_before_measuring(tmp_path, path, reason):
    result = CliRunner().invoke(bench_app, ["simulate", "--output", str(tmp_path / path)])
    assert isinstance(result.exception, InputError)
    assert reason in str(result.exception)
