"""Spectra without loss: means over realizations with their errors, and what the figures show of them."""

import numpy as np
import pytest

from calstudy.figures.unbiased import ROUTES, draw_recovered, draw_unbiased, recovered
from calstudy.power.windows import UnbiasedSpectrum, deconvolved

EDGES = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
WINDOW = np.array([[0.01, 0.3, 0, 0], [0, 0.5, 0.2, 0], [0, 0.1, 0.8, 0.1], [0, 0, 0.1, 0.9]])
TRUTH, ERROR = np.array([40.0, 20.0, 3.0, 1.0]), np.array([1.0, 0.5, 0.1, 0.05])


def spectra(count):
    rng, found = np.random.default_rng(1), []
    for _ in range(count):
        measured = WINDOW @ TRUTH + ERROR * rng.standard_normal(4)
        power, error = deconvolved(WINDOW, measured, ERROR)
        found.append(UnbiasedSpectrum(EDGES[:-1] + 0.05, EDGES, WINDOW, measured, ERROR, power, error, TRUTH))
    return found


def test_means_are_those_of_the_routes_and_errors_cover():
    found = recovered(spectra(400))
    assert np.isnan(found.unbiased[0])
    # The first bin has no result, and counts as the power of the second, which it does not leak into.
    assert found.unbiased[1:] == pytest.approx(1, abs=4 * found.unbiased_error[1:].max())
    assert found.by_flat[1] == pytest.approx((0.5 * 20 + 0.2 * 3) / 0.7 / 20, abs=4 * found.by_flat_error[1])
    # Of 1200 bins: 0.013 and 0.006.
    assert found.within == pytest.approx([0.683, 0.95], abs=0.04)


def test_all_routes_are_drawn_of_every_calibrator_and_signal():
    one = recovered(spectra(5))
    figure = draw_recovered({"flat": {"A": one, "B": one}, "steep": {"A": one, "B": one}})
    assert [axes.get_title() for axes in figure.axes] == ["A, flat", "B, flat", "A, steep", "B, steep"]
    for axes in figure.axes:
        assert len(axes.containers) == len(ROUTES)
        drawn = axes.containers[-1].lines[0].get_ydata()
        assert np.allclose(drawn, one.unbiased, equal_nan=True)


def test_a_run_shows_its_window_functions_each_with_a_sum_of_one():
    (found,) = spectra(1)
    left, right = draw_unbiased(found).axes
    assert len(left.containers) == 2
    # Three bins have a result.
    assert len(right.lines) == 3
    for line in right.lines:
        assert line.get_ydata().sum() == pytest.approx(1)
