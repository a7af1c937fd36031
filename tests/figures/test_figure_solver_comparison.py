from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import same_color

from calstudy.figures.members import SOLVERS, draw_solver_comparison
from calstudy.plotting import style


@pytest.fixture
def arrays(make_column):
    """Two arrays; the paper's solver leaves 40 times the EoR in the lowest bin, with EoR and without."""
    found = {}
    for seed, title in enumerate(("first", "second"), start=1):
        minimum = make_column(seed)
        bias = np.where(np.arange(40) == 1, 40 * 3e7, 0)
        names = ("residual", "residual_without_eor")
        biased = {name: replace(getattr(minimum, name), power=getattr(minimum, name).power + bias) for name in names}
        found[title] = (replace(minimum, **biased), minimum)
    return found


def test_both_solvers_are_in_the_panel_of_their_array_with_eor_and_without(arrays):
    grid = np.array(draw_solver_comparison(arrays).axes).reshape(2, 2)
    assert [axes.get_title() for axes in grid[0]] == list(arrays)
    for column, solvers in zip(grid.T, arrays.values(), strict=True):
        for axes, name in zip(column, ("residual", "residual_without_eor"), strict=True):
            drawn = {container.get_label(): container for container in axes.containers}
            for marking, spectra in zip(SOLVERS, solvers, strict=True):
                spectrum = getattr(spectra, name)
                for sign, chosen in (("positive", spectrum.power.real > 0), ("negative", spectrum.power.real < 0)):
                    points, _, (bars,) = drawn[f"{name}, {marking.label}, {sign}"].lines
                    np.testing.assert_allclose(points.get_ydata(), np.abs(spectrum.power.real[chosen]))
                    assert same_color(points.get_markerfacecolor(), marking.colour if sign == "positive" else "white")
                    lengths = [np.ptp(segment[:, 1]) for segment in bars.get_segments()]
                    np.testing.assert_allclose(lengths, 2 * 1.96 * spectrum.error[chosen])
            (noise,) = (line for line in axes.lines if line.get_label() == "noise")
            np.testing.assert_allclose(noise.get_ydata(), 1.96 * getattr(solvers[0], name).noise_error)


def test_the_bias_and_the_noise_are_within_the_axes(arrays):
    for axes in draw_solver_comparison(arrays).axes:
        low, high = axes.get_ylim()
        assert low < 1.96 * 2e6
        assert high > 41 * 3e7
        first, last = axes.get_xlim()
        assert first < 0.02 - 0.12 * 0.04
        assert last == 1.0


def test_the_legend_names_both_solvers(arrays):
    figure = draw_solver_comparison(arrays)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[:2] == ["the paper's solver", "the default solver"]
    assert figure.get_figwidth() == style.TWO_COLUMNS
