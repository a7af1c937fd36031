"""From worlds of growing severity to the severity at which a bias is no longer tolerated."""

import numpy as np
import pytest

from calstudy.base.errors import InputError
from calstudy.products.tolerances import Tolerance, faults, tolerance
from calstudy.verdicts.standing import LIMIT

SEVERITIES = (0.0, 0.1, 1.0, 10.0)


def test_worlds_are_grouped_by_fault_and_ordered_by_severity():
    worlds = ["ideal", "positions: 2 cm", "flux: 1e-3", "positions: 0.5 cm", "a world apart: no number", "another"]
    found = faults(worlds)
    assert [(fault.name, fault.unit) for fault in found] == [("positions", "cm"), ("flux", "")]
    assert found[0].worlds == ("ideal", "positions: 0.5 cm", "positions: 2 cm")
    assert found[0].severities == (0.0, 0.5, 2.0)


def test_a_severity_of_zero_of_its_own_takes_the_place_of_the_ideal_world():
    [found] = faults(["ideal", "drift: 0 %", "drift: 1 %"])
    assert (found.worlds, found.severities) == (("drift: 0 %", "drift: 1 %"), (0.0, 1.0))
    assert faults(["ideal", "drift: 0 %"]) == []


def test_levels_are_no_severities_and_hyphens_no_signs():
    assert faults(["ideal", "coupling: -40 dB", "coupling: -30 dB"]) == []
    [found] = faults(["ideal", "cable: delay-50 ns"])
    assert found.severities == (0.0, 50.0)


@pytest.mark.parametrize(
    ("severity", "told"),
    [
        (".5 cm", [(0.5, "cm")]),
        ("up to .5e-1 cm", [(0.05, "cm")]),
        ("+5 cm", [(5.0, "cm")]),
        ("no.5 cm", [(5.0, "cm")]),
        ("2. cm", [(2.0, "cm")]),
        ("level -40 dB", []),
        ("level -.5 dB", []),
        ("level +40 dB", [(40.0, "dB")]),
    ],
)
def test_severities_are_read_as_they_are_written(severity, told):
    assert [(fault.severities[-1], fault.unit) for fault in faults(["ideal", f"rfi: {severity}"])] == told


def test_an_error_that_is_not_known_tells_nothing():
    assert tolerance(SEVERITIES, np.array([0, 3, 5, 9]), np.full(4, np.nan)).relation == "?"


def test_severities_are_compared_in_one_unit():
    [found] = faults(["ideal", "positions: 5 mm", "positions: 2 cm", "positions: 0.1 cm"])
    assert found.severities == pytest.approx((0.0, 1.0, 5.0, 20.0))
    assert found.unit == "mm"
    with pytest.raises(InputError, match=r"'positions: 2 tiles' has the unit 'tiles', and others .* have 'mm'"):
        faults(["positions: 5 mm", "positions: 2 tiles"])


@pytest.mark.parametrize("power", [1, 2, 4])
def test_of_a_bias_that_is_a_power_of_the_severity_the_crossing_is_exact(power):
    wanted = 0.37
    bias = LIMIT * (np.array(SEVERITIES) / wanted) ** power
    found = tolerance(SEVERITIES, bias, np.full(4, 1e-9))
    assert found.relation == "="
    assert found.severity == pytest.approx(wanted, rel=1e-6)


def test_limits_where_the_bias_does_not_cross():
    small = np.full(4, 1e-4)
    assert tolerance(SEVERITIES, np.array([0, 1e-4, 1e-3, 1e-2]), small) == Tolerance(10.0, ">")
    assert tolerance(SEVERITIES, np.array([0, 1, 10, 100]), small) == Tolerance(0.1, "<")


def test_noise_that_hides_the_limit_is_said():
    noisy = np.full(4, 0.2)
    assert tolerance(SEVERITIES, np.array([0.1, 0.2, -0.1, 0.3]), noisy).relation == "?"
    found = tolerance(SEVERITIES, np.array([0.1, 0.2, -0.1, 30.0]), noisy)
    assert (found.relation, found.severity) == ("<", 10.0)
    assert tolerance(SEVERITIES, np.full(4, np.nan), noisy).relation == "?"
