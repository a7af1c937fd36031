"""The signal loss where some samples have gains in data with the EoR, and others in data without it."""

from __future__ import annotations

import numpy as np
import pytest
from tiny import tiny

import calstudy
from calstudy.report.page import recorded_warnings
from calstudy.results.reader import RunFolder

CODE = """
import dataclasses, hashlib

import numpy as np

from calstudy.calibrate.calibrators.given_gains import NoCalibration


class Some(NoCalibration):
    calibrator: str = "some.py"

    def calibrate(self, observation, assumed, progress=None):
        found = super().calibrate(observation, assumed, progress)
        flags = np.zeros(found.gains.shape, bool)
        digest = hashlib.sha256(np.ascontiguousarray(observation.visibilities)).digest()
        random = np.random.default_rng(list(digest))
        # Of every channel as many integrations in all data, but not the same.
        turns = np.arange(flags.shape[2]) == random.permutation(flags.shape[2])[:, None]
        flags |= turns[np.arange(flags.shape[1]) % flags.shape[2]][None, :, :, None]
        return dataclasses.replace(found, gain_flags=flags)
"""
SAMPLES = CODE.replace(
    "gain_flags=flags", "flags=np.repeat(flags[0].swapaxes(0, 1)[:, None], observation.visibilities.shape[1], axis=1)"
)


@pytest.mark.chain
@pytest.mark.parametrize("code", [CODE, SAMPLES], ids=["gains", "samples"])
def test_solves_that_fail_with_the_eor_alone_leave_neither_noise_nor_foregrounds_in_t(tmp_path, code):
    """All gains are one, so that T is one; the foregrounds that are left are a hundred times the EoR."""
    (tmp_path / "some.py").write_text(code)
    found = {}
    for name in ("none", str(tmp_path / "some.py")):
        content = tiny(tmp_path)
        content["instrument"]["times"]["count"] = 6
        content["corruption"]["effects"] = []
        content["calibration"] = {"calibrator": name, "chunks": 1, "assumed": {"sky.foregrounds.count": 50}}
        content["outputs"]["figures"] = []
        found[name] = calstudy.load(content).run(workers=1)
    whole, part = found.values()
    for run in (whole, part):
        transfer = run.scores["transfer"].to_numpy(float)
        assert np.isfinite(transfer).sum() >= 2
        # A third of the integrations is missing in the response, and none in the EoR.
        np.testing.assert_allclose(transfer[np.isfinite(transfer)], 1, atol=0.01)
    said = [recorded_warnings(RunFolder(run.folder).products) for run in (whole, part)]
    parts = [
        [text.partition("% of the samples are left out of T")[0] for text in one if "out of T" in text] for one in said
    ]
    assert not parts[0]
    # Two different ones of six integrations, of those that either has.
    assert all(20 < float(part.rpartition(" ")[2]) < 34 for part in parts[1])
    assert parts[1]
