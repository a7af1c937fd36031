"""Small arrays that several tests of the calibrator share."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import pytest
from toy import HEX, Toy, make_toy, scattered

from calstudy.calibrate.solvers import adamax, reduced


@pytest.fixture(autouse=True, scope="session")
def kept_kernels() -> Iterator[None]:
    """Keep more compiled kernels than studies do: the arrays below come again between dozens of others."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name in ((reduced, "_kernels"), (adamax, "compiled")):
            patch.setattr(module, name, lru_cache(maxsize=32)(getattr(module, name).__wrapped__))
        yield


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
