"""Small arrays that several tests of the calibrator share."""

from __future__ import annotations

import pytest
from toy import HEX, Toy, make_toy, scattered


@pytest.fixture(scope="session")
def toy() -> Toy:
    """Eight antennas at random, noise 1e-3 of the foregrounds."""
    return make_toy(scattered(8))


@pytest.fixture(scope="session")
def quiet() -> Toy:
    """The same without noise."""
    return make_toy(scattered(8), noise=0.0)


@pytest.fixture(scope="session")
def hexagon() -> Toy:
    """Seven antennas on a perfect hexagon, no noise."""
    return make_toy(HEX, noise=0.0)
