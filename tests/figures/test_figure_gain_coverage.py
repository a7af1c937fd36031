"""The coverage of errors of gains: what is pooled and drawn, of a run and of a collection."""

from __future__ import annotations

import io
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from tiny import tiny

from calstudy.calibrate.agreement import ALLOWED, EXPECTED, GainCoverage, pooled
from calstudy.experiment.files import override, validate
from calstudy.figures.gain_coverage import GainCoverageFigure, draw_gain_coverage
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.load import load_study
from calstudy.studies.study import Budget, run_study
from calstudy.verdicts.tolerances import Drawn

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def coverage(seed: int, wrong: float = 1.0, antennas: int = 6) -> GainCoverage:
    return GainCoverage.of(list(wrong * np.random.default_rng(seed).standard_normal((5, 2, antennas, 200))))


def test_realizations_of_both_halves_are_pooled():
    even, odd = coverage(1), coverage(2)
    found = pooled([even, odd])
    assert found.realizations == 10
    assert found.observed == pytest.approx((even.observed.mean(axis=0) + odd.observed.mean(axis=0)) / 2)
    # Independent numbers: the scatter over realizations is that of a binomial distribution.
    assert found.error[:, 49] == pytest.approx(0.5 / np.sqrt(10 * 1200), rel=0.6)
    assert found.within == pytest.approx(np.array([[right for right, _ in ALLOWED]] * 2), abs=0.03)
    assert np.all(np.abs(found.worst - found.within) < 0.06)


def test_errors_that_are_too_small_are_below_the_diagonal():
    members = {"right": pooled([coverage(1)]), "wrong": pooled([coverage(2, wrong=2.0)])}
    figure = draw_gain_coverage(members)
    right, wrong, *_ = figure.axes
    assert [axes.get_title(loc="left") for axes in (right, wrong)] == ["right", "wrong"]
    assert np.abs(right.lines[1].get_ydata() - EXPECTED).max() < 0.05
    assert np.min(wrong.lines[1].get_ydata() - EXPECTED) < -0.2


def test_a_member_without_a_panel_beside_it_leaves_no_empty_axes():
    figure = draw_gain_coverage({str(place): pooled([coverage(place)]) for place in range(4)})
    assert sum(axes.get_visible() for axes in figure.axes) == 8


@pytest.mark.chain
def test_a_run_of_a_known_sky_is_covered(tmp_path):
    data = tiny(tmp_path)
    for path, value in {
        "calibration": {"calibrator": "sky-based", "weights": "flags", "chunks": 1},
        "corruption.noise": {"kind": "times-foregrounds", "factor": 0.01},
        "instrument.times.count": 4,
        # The gains of both feeds differ.
        "instrument.polarizations": ["xx", "yy"],
        "variants": {"residual": {"components": ["foregrounds", "noise"], "effects": True, "calibrate": True}},
        "outputs.figures": ["gain-coverage"],
    }.items():
        data = override(data, path, value)
    result = run_study(ExperimentStudy(validate(data, Path())), Budget(workers=1), Console(file=io.StringIO()))
    table = result.folder / "figures" / "gain-coverage.csv"
    head, *rows = (line.split(",") for line in table.read_text().splitlines())
    assert [row[:3] for row in rows] == [["", "amplitude", "16"], ["", "phase", "16"]]
    for name, (right, allowed) in zip(("within 1 sigma [%]", "within 1.96 sigma [%]"), ALLOWED, strict=True):
        assert [float(row[head.index(name)]) for row in rows] == pytest.approx([100 * right] * 2, abs=100 * allowed)


@pytest.mark.parametrize("prefix", ["", "calamity."])
def test_every_array_has_a_tolerance_of_its_shape(prefix):
    arrays = {f"{prefix}{name}": np.asarray(value) for name, value in asdict(pooled([coverage(1)])).items()}
    for name, values in arrays.items():
        rule = next(rule for pattern, rule in GainCoverageFigure.tolerances if re.fullmatch(pattern, name))
        if isinstance(rule, Drawn):
            assert rule.error(arrays, name).shape == values.shape


def test_gains_need_a_fit_and_noise():
    study = load_study(EXPERIMENTS / "gain-errors.yaml")
    [figure] = study.file.figures
    experiment = next(iter(study.members.values()))
    assert figure.refusal(experiment) is None
    other = override(experiment.model_dump(mode="json"), "calibration", {"calibrator": "none"})
    assert "least squares" in figure.refusal(validate(other, EXPERIMENTS))
    other = override(experiment.model_dump(mode="json"), "variants.residual.components", ["foregrounds"])
    assert "noise" in figure.refusal(validate(other, EXPERIMENTS))


def test_every_member_is_shown():
    study = load_study(EXPERIMENTS / "gain-errors.yaml")
    [figure] = study.figures
    assert {name.split(":")[1] for name in figure.inputs} == set(study.members)
