"""The bias of the members of a collection: what is drawn as measured, and what as an upper limit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calstudy.base.constants import SIGMAS_95
from calstudy.figures.members import draw_member_bias
from calstudy.power.score import Score
from calstudy.studies.load import load_study


def bias_of(k: np.ndarray, bias: np.ndarray, error: np.ndarray) -> Score:
    other = np.full(k.size, np.nan)
    edges = np.append(k - 0.05, k[-1] + 0.05)
    return Score(k, edges, other, other, bias, error, other, other, flux_scale=1.0)


EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def test_what_is_not_above_the_noise_is_an_open_upper_limit():
    member = bias_of(np.array([0.1, 0.2, 0.3]), np.array([50.0, 0.5, -3.0]), np.array([1.0, 1.0, 0.1]))
    figure = draw_member_bias({"one": member})
    [axes] = figure.axes
    [legend] = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["one", "open: 95 % upper limit"]
    open_points = [line for line in axes.lines if line.get_markerfacecolor() == "white"]
    assert [line.get_ydata().tolist() for line in open_points] == [[pytest.approx(0.5 + SIGMAS_95)]]
    [measured] = axes.containers
    # A negative bias is as large as a positive one: both come from errors of the gains.
    assert measured.lines[0].get_ydata().tolist() == [50.0, 3.0]


def test_members_with_the_same_values_do_not_hide_each_other():
    member = bias_of(np.array([0.1, 0.2]), np.array([5.0, 5.0]), np.array([1.0, 1.0]))
    [axes] = draw_member_bias({"one": member, "two": member}).axes
    first, second = (container.lines[0].get_xdata() for container in axes.containers)
    assert np.all(np.abs(first - second) > 0.01)
    assert np.all(np.abs(first - member.k) < 0.05)


def test_members_with_a_single_bin_are_drawn():
    member = bias_of(np.array([0.1]), np.array([5.0]), np.array([1.0]))
    [axes] = draw_member_bias({"one": member, "two": member}).axes
    assert [container.lines[0].get_xdata().tolist() for container in axes.containers] == [[0.1], [0.1]]


def test_a_figure_without_roles_has_all_members():
    study = load_study(EXPERIMENTS / "sky-errors.yaml")
    [figure] = study.figures
    assert {name.split(":")[1] for name in figure.inputs} == set(study.members)
