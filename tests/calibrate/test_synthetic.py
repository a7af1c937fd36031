"""Synthetic integrations drift with the sky, and have the noise and the size of their case."""

from __future__ import annotations

import numpy as np
import pytest

from calstudy.calibrate.synthetic import Case, Simulation


def test_cases_drift_and_have_the_noise_they_say():
    case = Case(antennas=5, channels=96, extent=40.0)
    simulation = Simulation(case)
    structure = simulation.structure()
    first, later = simulation.foregrounds(0), simulation.foregrounds(20)
    change = np.linalg.norm(later - first) / np.linalg.norm(first)
    assert 1e-3 < change < 0.5
    even, odd = (simulation.problem(0, structure, realization).visibilities for realization in (0, 1))
    noise = np.sqrt(np.mean(np.abs(even - odd) ** 2) / 2) / np.sqrt(np.mean(np.abs(even) ** 2))
    assert noise == pytest.approx(case.noise, rel=0.1)
    lengths = np.linalg.norm(np.ptp(simulation.positions[:2], axis=0))
    assert lengths == pytest.approx(40.0)
