"""Arrays of every kind are timed with the default solver."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from typer.testing import CliRunner

from calstudy.base.errors import InputError
from calstudy.bench import arrays
from calstudy.bench.calibration_case import Case
from calstudy.cli.bench import bench_app


def test_arrays_have_the_antennas_that_their_cases_say():
    for array in arrays.ARRAYS.values():
        positions = array.positions()
        assert positions is None or positions.shape == (array.case.antennas, 3)
    ruler = arrays.ARRAYS["golomb-15"].positions()
    assert np.ptp(ruler[:, 0]) == pytest.approx(453)


def test_an_array_is_solved_from_unity_and_then_warm(monkeypatch):
    small = arrays.Array(Case(antennas=7, channels=64), {"kind": "hex", "side": 2, "spacing": "14 m"})
    monkeypatch.setitem(arrays.ARRAYS, "hexagon-7", small)
    found = arrays.Timing(**arrays.run_array({"name": "hexagon-7", "integrations": 3, "device": "cpu"}))
    assert (found.baselines, found.channels) == (21, 64)
    assert found.converged
    # Compilation takes seconds, and the next integration is close to the one before.
    assert found.first > found.cold > 0
    assert found.warm > 0
    # How many steps a fit of so few baselines crawls is decided by rounding.
    assert min(found.warm_steps, found.cold_steps) > 0
    assert found.memory > 1e8


def test_an_unknown_array_is_refused():
    with pytest.raises(InputError, match="golom-15: not an array, did you mean 'golomb-15'"):
        arrays.require_arrays(["paper", "golom-15"])


def test_an_interrupted_benchmark_keeps_the_rows_that_it_has(monkeypatch, tmp_path):
    def stopped_at_the_second(name: str, *_: object) -> arrays.Timing:
        if name == "golomb-15":
            raise KeyboardInterrupt
        return arrays.Timing(630, 384, 3.5, 0.94, 0.19, 5, 1, True, 10**9)

    monkeypatch.setattr(arrays, "time_array", stopped_at_the_second)
    table = tmp_path / "table.csv"
    result = CliRunner().invoke(bench_app, ["arrays", "--arrays", "paper,golomb-15", "--output", str(table)])
    assert result.exit_code != 0
    assert "paper" in result.output
    with table.open(newline="") as file:
        heading, row = csv.reader(file)
    assert heading == list(arrays.HEADINGS)
    assert row[:4] == ["paper", "630", "384", "3.50"]
