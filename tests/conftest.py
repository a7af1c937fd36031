"""What all tests share: small observations and runs."""

from __future__ import annotations

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from observations import small_instrument
from pyuvdata import UVData

from calstudy.instrument.telescope import make_template

# How long an example takes is the machine's affair: a busy one fails hypothesis' deadline of 0.2 s, and no property.
settings.register_profile("any-machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any-machine")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add where notebooks are left as they ran, from where the documentation takes their outputs."""
    parser.addoption("--notebook-outputs", metavar="FOLDER", help="write notebooks that were run to this folder")


@pytest.fixture
def template() -> UVData:
    """A small observation without data."""
    return make_template(small_instrument())


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in every run."""
    return np.random.default_rng(20220422)
