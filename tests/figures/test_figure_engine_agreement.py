"""Two simulations of one sky: the difference is found at its size, on the baselines and at the delay where it is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from calstudy.base.errors import ExperimentError
from calstudy.base.visibilities import baseline_vectors, from_cube
from calstudy.experiment.files import validate
from calstudy.figures.engine_agreement import compare_simulations, draw_engine_agreement
from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.telescope import make_template
from calstudy.run.execution import Budget
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.study import run_study

pytestmark = pytest.mark.chain

INSTRUMENT = {
    "layout": {"kind": "mwa-compact-minredundant", "count": 6},
    "beam": {"kind": "gaussian"},
    "channels": {"width": "320 kHz", "count": 96},
    "times": {"count": 2},
}
TONE = 1e-5
DELAY = 40 / (96 * 320e3)


@pytest.fixture(scope="module")
def template():
    return make_template(InstrumentSettings.model_validate(INSTRUMENT))


def flat(template, factor=1.0):
    """Return visibilities of 2 Jy on all baselines."""
    shape = (template.Ntimes, template.Nbls, template.Nfreqs, template.Npols)
    return from_cube(template, np.full(shape, 2.0 * factor + 0j))


def with_tone(template):
    """Return the same with a tone on the longest baseline at the second integration."""
    tone = 2 * TONE * np.exp(2j * np.pi * DELAY * template.freq_array)
    cube = np.full((template.Ntimes, template.Nbls, template.Nfreqs, 1), 2.0 + 0j)
    cube[1, np.linalg.norm(baseline_vectors(template), axis=1).argmax(), :, 0] += tone
    return from_cube(template, cube)


def test_a_tone_is_found_on_its_baseline_at_its_delay_with_its_size(template):
    agreement = compare_simulations(with_tone(template), flat(template))
    assert agreement.largest == pytest.approx(TONE)
    assert agreement.worst_slot == pytest.approx(TONE)
    assert agreement.rms == pytest.approx(TONE / np.sqrt(2 * template.Nbls))
    *others, last = agreement.groups
    assert {group.largest for group in others} == {0.0}
    assert last.largest == pytest.approx(TONE)
    assert sum(group.baselines for group in agreement.groups) == template.Nbls
    assert last.rms_jy == pytest.approx(2)
    # One of two integrations, one of the group's baselines, one of the two signs of delay.
    level = TONE / np.sqrt(2 * last.baselines * 2)
    assert last.difference.max() == pytest.approx(level, rel=1e-6)
    assert last.delay[last.difference.argmax()] == pytest.approx(DELAY)
    found = agreement.differences["dolph-chebyshev"].max_db
    assert found[-1] == pytest.approx(10 * np.log10(TONE / np.sqrt(2 * last.baselines)), abs=0.01)
    assert np.nanmax(found[:-1]) < -1000
    assert len(draw_engine_agreement(agreement, ("a", "b"), 1e-6, -40.0).axes) == 2


def test_a_common_factor_is_a_relative_difference_everywhere(template):
    agreement = compare_simulations(flat(template, 1 + 1e-4), flat(template))
    assert {round(group.largest, 12) for group in agreement.groups} == {1e-4}
    # What differs has the same delays: it lies as far below the peak as the foregrounds do, and 40 dB more.
    for taper, floor in agreement.floors.items():
        assert agreement.differences[taper].worst_db == pytest.approx(floor.worst_db - 40, abs=0.01)


SMALL = {
    "name": "small",
    "instrument": {**INSTRUMENT, "times": {"count": 1}},
    "sky": {"foregrounds": {"kind": "g4jy-and-counts", "count": 100}, "eor": {"nside": 16}},
    "simulation": {"chunks": 1, "engine": "dense"},
    "variants": {"foregrounds": {"components": ["foregrounds"]}},
}


def test_a_run_compares_engines_and_shows_the_components_from_one_simulation(tmp_path: Path):
    """What a run has simulated is used, and a difference beyond the tolerance is a warning."""
    engines = {"kind": "engine-agreement", "node_tolerance": 1e-6, "tolerance": 1e-17}
    outputs = {"store": str(tmp_path / "store"), "runs": str(tmp_path), "figures": [engines, "simulated-components"]}
    study = ExperimentStudy.of(validate({**SMALL, "outputs": outputs}, tmp_path))
    assert [task.label for task in study.tasks if task.stage.name == "simulate"] == [
        "foregrounds",
        "foregrounds",
        "eor",
    ]
    run = run_study(study, Budget(1))
    (warning,) = [text for text in run.warnings if "pyuvsim" in text]
    assert warning.startswith("figure (engine-agreement): dense and pyuvsim differ by")
    notes = {
        item["label"]: item["notes"] for item in json.loads((run.folder / "manifest.json").read_text())["products"]
    }
    assert 1e-16 < notes["engine-agreement"]["largest"] < 1e-6
    with np.load(run.folder / "figures" / "simulated-components.npz") as arrays:
        assert arrays["baselines.0.eor"].shape == arrays["baselines.2.foregrounds"].shape == (96,)


def test_an_engine_is_not_compared_with_itself(tmp_path: Path):
    outputs = {"figures": [{"kind": "engine-agreement", "against": "dense"}]}
    with pytest.raises(ExperimentError, match="compares dense with itself"):
        validate({**SMALL, "outputs": outputs}, tmp_path)
    outputs = {"figures": [{"kind": "engine-agreement", "against": "fast"}]}
    with pytest.raises(ExperimentError, match=r"outputs\.figures\.0: 'fast' is not an engine"):
        validate({**SMALL, "outputs": outputs}, tmp_path)


def test_without_foregrounds_there_is_nothing_to_compare(tmp_path: Path):
    without = {"foregrounds": "none", "eor": {"nside": 16}}
    settings = {"sky": without, "variants": {"eor": {"components": ["eor"]}}, "corruption": {"eor_level": None}}
    with pytest.raises(ExperimentError, match="'simulated-components', which needs foregrounds"):
        validate({**SMALL, **settings, "outputs": {"figures": ["simulated-components"]}}, tmp_path)
