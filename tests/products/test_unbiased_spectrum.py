"""The windows of a chain: the linear response against injection, and who has none."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from tiny import tiny

import calstudy
from calstudy.base.errors import ExperimentError
from calstudy.power.tables import load_spectrum
from calstudy.power.windows import LEAST_KEPT, UnbiasedSpectrum, Windows
from calstudy.products.windows import UNBIASED, WINDOWS

CALIBRATION = {"calibrator": "delay-weighted", "weights": "flags", "chunks": 1}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of the tiny experiment with its windows."""
    experiment = tiny(tmp_path_factory.mktemp("windows"))
    experiment["calibration"] = CALIBRATION
    experiment["outputs"] |= {"tables": ["windows"], "figures": ["windows"]}
    return calstudy.load(experiment).run()


def test_the_linear_response_is_what_injection_measures(run):
    found = load_spectrum(run.folder / "tables" / WINDOWS, Windows)
    # T by injection is from fits of data with the EoR and without, and knows nothing of the tangent space.
    kept = found.measured > LEAST_KEPT
    assert kept.sum() >= 3
    np.testing.assert_allclose(found.linear[kept], found.measured[kept], atol=0.03)


def test_the_estimate_is_the_eor_within_its_error(run):
    spectrum = load_spectrum(run.folder / "tables" / UNBIASED, UnbiasedSpectrum)
    pulls = ((spectrum.power - spectrum.signal) / spectrum.error)[np.isfinite(spectrum.power)]
    assert pulls.size >= 3
    # Chance leaves 3 sigma once in 370, and there are a handful of bins.
    assert np.abs(pulls).max() < 4


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"calibration": {"calibrator": "redcal"}}, "needs a calibrator that fits each integration by least squares"),
        ({"power": {"pairs": "redundant-group"}}, "needs power.pairs: same-baseline"),
    ],
)
def test_a_calibration_without_a_linear_response_has_no_windows(tmp_path, changes, sentence):
    experiment = {**tiny(tmp_path), "calibration": CALIBRATION, **changes}
    experiment["outputs"] = {**experiment["outputs"], "tables": ["windows"]}
    with pytest.raises(ExperimentError, match=sentence):
        calstudy.load(experiment)


def test_every_field_has_a_unit():
    for kind in (Windows, UnbiasedSpectrum):
        assert all("unit" in item.metadata for item in dataclasses.fields(kind))
