"""Beams for the simulators, read once."""

from __future__ import annotations

import pytest

from calstudy.instrument.beam_models.formulas import DipoleBeam, GaussianBeam, MwaAnalyticBeam
from calstudy.instrument.beam_models.tables import MwaEmbeddedBeam
from calstudy.instrument.beams import make_beam


@pytest.fixture(scope="session")
def embedded_beam():
    return make_beam(MwaEmbeddedBeam())


@pytest.fixture(scope="session")
def tile_beam():
    return make_beam(MwaAnalyticBeam(kind="mwa-analytic"))


@pytest.fixture(scope="session")
def dipole_beam():
    """A beam that does not vanish at the horizon."""
    return make_beam(DipoleBeam(kind="short-dipole"))


@pytest.fixture(scope="session")
def gaussian_beam():
    return make_beam(GaussianBeam(kind="gaussian"))
