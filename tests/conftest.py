"""What all tests share: small observations and runs."""

from __future__ import annotations

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import numpy as np
import pytest
from pyuvdata import UVData

from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.telescope import make_template


def small_instrument(**changes: object) -> InstrumentSettings:
    """Return a five-antenna, 16-channel, 3-integration observation, with sections replaced by `changes`."""
    sections = {
        "layout": {"kind": "hex", "side": 2, "spacing": "14 m"},
        "beam": "gaussian",
        "channels": {"count": 16, "width": "240 kHz"},
        "times": {"count": 3},
        **changes,
    }
    return InstrumentSettings.model_validate(sections)


@pytest.fixture
def template() -> UVData:
    """A small observation without data."""
    return make_template(small_instrument())


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in every run."""
    return np.random.default_rng(20220422)
