"""The figure of a calibration has room for its panels, whatever their axes span."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calstudy.figures.diagnostics import Diagnostics, draw_diagnostics
from calstudy.plotting.style import journal_style

DRAWN = True

CHANNELS, BASELINES, ANTENNAS = 61, 45, 10


def diagnostics(last_loss: float, lowest_chi2: float, strongest: float) -> Diagnostics:
    """Return what a calibration of noise might leave, with losses, chi^2 and gains that span the given factors."""
    random = np.random.default_rng(1)
    names = np.array([f"HH{number}" for number in range(ANTENNAS)])
    frequency = np.linspace(147e6, 153e6, CHANNELS)
    delay = np.fft.fftshift(np.fft.fftfreq(CHANNELS, frequency[1] - frequency[0]))
    rms = random.uniform(1e-3, 1e-2, (3, BASELINES, CHANNELS))
    gains = random.uniform(0.5, 2, (8, CHANNELS)) * np.exp(1j * random.uniform(-1, 1, (8, CHANNELS)))
    gains[:, CHANNELS // 2] *= strongest
    return Diagnostics(
        polarization="nn",
        unit="uncalib",
        delay=delay,
        lengths=np.linspace(14, 240, BASELINES),
        data=rms[0],
        model=rms[1],
        residual=rms[2],
        frequency=frequency,
        antennas=names[:8],
        gains=gains,
        errors=np.full((2, 8, CHANNELS), 0.05),
        losses=(np.geomspace(1, last_loss, 12),) * 3,
        converged=np.ones(3, bool),
        chi2_antennas=names,
        chi2_by_antenna=np.linspace(0.52, 0.65, ANTENNAS),
        chi2_by_channel=np.geomspace(lowest_chi2, 0.9, CHANNELS),
        chi2_by_integration=np.array([0.56, 0.58, 0.6]),
    )


@pytest.mark.parametrize(("last_loss", "lowest_chi2"), [(0.5, 0.08), (0.15, 1e-4), (1e-3, 0.5)])
def test_every_panel_has_room(last_loss, lowest_chi2):
    """Matplotlib warns, which is an error in tests, if labels leave no room for the axes."""
    with journal_style():
        figure = draw_diagnostics(diagnostics(last_loss, lowest_chi2, strongest=20.0))
    figure.canvas.draw()
    assert all(axes.bbox.height > 0.1 * figure.bbox.height for axes in figure.axes)


def test_an_axis_of_less_than_two_decades_has_labels_between_powers_of_ten():
    with journal_style():
        figure = draw_diagnostics(diagnostics(last_loss=0.15, lowest_chi2=0.5, strongest=20.0))
    figure.canvas.draw()
    losses = next(axes for axes in figure.axes if axes.get_ylabel() == "loss / first loss")
    assert {"0.2", "0.3", "0.5"} <= {label.get_text() for label in losses.get_yminorticklabels()}


def test_integrations_are_counted_in_whole_numbers_even_if_there_is_only_one():
    one = replace(diagnostics(0.15, 0.5, 20.0), chi2_by_integration=np.array([0.56]))
    figure = draw_diagnostics(one)
    axes = next(axes for axes in figure.axes if axes.get_xlabel() == "integration")
    assert [tick for tick in axes.get_xticks() if axes.get_xlim()[0] <= tick <= axes.get_xlim()[1]] == [0]
