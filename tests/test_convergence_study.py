"""The figures of convergence and of the expected signal loss, at the smallest size."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from tiny import tiny

from calstudy.base.errors import InputError
from calstudy.experiment.files import override, validate
from calstudy.figures.convergence import ConvergencePath, draw_convergence
from calstudy.run.execution import Budget
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.study import run_study

pytestmark = pytest.mark.chain

DRAWN = True

VARIANTS = {
    "residual": {"components": ["foregrounds", "eor", "noise"], "effects": True, "calibrate": True},
    "residual_without_eor": {"components": ["foregrounds", "noise"], "effects": True, "calibrate": True},
    "eor": {"components": ["eor"]},
}
STUDY = {
    "integrations": 2,
    "steps": [1, 2, 50, 200],
    "solvers": {"default": "gauss-newton", "Adamax": {"name": "adamax", "tolerance": 0.0, "max_steps": 200}},
}


@pytest.fixture(scope="module")
def figures(tmp_path_factory, shared_store):
    folder = tmp_path_factory.mktemp("convergence")
    (folder / "store").symlink_to(shared_store)
    # Weights that stay as they are, so that losses of all steps compare.
    data = override({**tiny(folder), "variants": VARIANTS}, "calibration.weights", "flags")
    data = override(data, "outputs.figures", ["convergence", "expected-loss"])
    data = override(data, "outputs.convergence", STUDY)
    return run_study(ExperimentStudy(validate(data, folder)), Budget(workers=1)).folder / "figures"


def test_the_bias_falls_with_the_steps_and_stays_below_what_is_predicted(figures):
    with (figures / "convergence.csv").open() as file:
        rows = list(csv.DictReader(file))
    paths = {name: [row for row in rows if row["solver"] == name] for name in STUDY["solvers"]}
    assert [int(row["steps"]) for row in paths["Adamax"]] == [50, 200]
    assert [int(row["steps"]) for row in paths["default"]][:2] == [1, 2]
    for path in paths.values():
        bias, error = (np.array([float(row[name]) for row in path]) for name in ("bias", "bias error"))
        predicted = np.array([float(row["predicted"]) for row in path])
        assert bias[0] > 10 * abs(bias[-1])
        assert (bias[1:] - 3 * error[1:] < 2 * predicted[1:]).all()
    assert (figures / "convergence.png").exists()


def test_negative_powers_are_drawn_as_open_symbols_in_both_panels():
    power = np.array([10.0, 1.5, -0.2, -0.3])
    path = ConvergencePath("fit", np.array([1, 10, 100, 1000]), power, 0.1 * abs(power), power, 0.1 * abs(power), power)
    for axes in draw_convergence([path], [0]).axes:
        low, high = axes.get_ylim()
        drawn = [y for container in axes.containers for y in container.lines[0].get_ydata()]
        assert sorted(drawn) == [0.2, 0.3, 1.5, 10.0]
        assert low < 0.2 < 10 < high
        hollow = [container for container in axes.containers if container.lines[0].get_markerfacecolor() == "white"]
        assert [list(container.lines[0].get_ydata()) for container in hollow] == [[0.2, 0.3]]


def test_expected_and_measured_loss_are_drawn_from_the_same_bins(figures):
    with np.load(figures / "expected-loss.npz") as arrays:
        assert np.array_equal(arrays["expected.bin_edges"], arrays["measured.bin_edges"])
        expected, lengths = arrays["expected.outside"], arrays["expected.by_length"]
        assert np.array_equal(np.isfinite(expected), np.isfinite(arrays["measured.transfer"]))
    known = np.isfinite(expected)
    assert (expected[known] > 0).all()
    assert (expected[known] < 1).all()
    assert lengths[:, 0].max() < 0.1 < lengths[:, -1].min()


def expecting(folder, **calibration) -> ExperimentStudy:
    """A study that draws the expected loss only."""
    data = override({**tiny(folder), "variants": VARIANTS}, "outputs.figures", ["expected-loss"])
    for name, value in calibration.items():
        data = override(data, f"calibration.{name}", value)
    return ExperimentStudy(validate(data, folder))


def test_gains_of_two_integrations_together_are_expected_to_take_half(figures, tmp_path, shared_store):
    """Far from the foregrounds they take their share of the degrees of freedom, of which there are twice as many."""
    (tmp_path / "store").symlink_to(shared_store)
    run = run_study(expecting(tmp_path, integrations_per_solve=2), Budget(workers=1))
    taken = []
    for folder in (figures, run.folder / "figures"):
        with np.load(folder / "expected-loss.npz") as arrays:
            taken.append(1 - arrays["expected.by_length"][0, -3:].mean())
    assert taken[1] == pytest.approx(taken[0] / 2, rel=0.2)


@pytest.mark.parametrize(
    ("field", "value"),
    [("smooth_gains", {"kind": "polynomial", "frequency_degree": 2}), ("baselines", {"shortest": "30 m"})],
)
def test_a_loss_of_smoothed_gains_or_of_a_range_of_baselines_is_not_expected(field, value, tmp_path):
    study = expecting(tmp_path, calibrator="sky-based", **{field: value})
    with pytest.raises(InputError, match=rf"'expected-loss': needs a fit without calibration\.{field}"):
        _ = study.figures
