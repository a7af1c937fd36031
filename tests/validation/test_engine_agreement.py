"""Two simulations of one sky: the difference is found at its size, on the baselines and at the delay where it is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from calstudy.base.visibilities import baseline_vectors, from_cube
from calstudy.cli.main import app
from calstudy.experiment.files import load
from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.telescope import make_template
from calstudy.products import simulation
from calstudy.products.graph import Graph
from calstudy.run.store import Store
from calstudy.validation.engine_agreement import compare_simulations, draw_engine_agreement

DRAWN = True

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


def test_other_observations_are_refused(template):
    other = make_template(
        InstrumentSettings.model_validate({**INSTRUMENT, "times": {"count": 2, "integration": "3 s"}})
    )
    with pytest.raises(ValueError, match="differ in time_array"):
        compare_simulations(flat(other), flat(template))


def test_the_command_makes_both_once_and_keeps_them_where_a_run_finds_them(tmp_path: Path):
    pytest.importorskip("matvis", reason="needs the extra [engines]")
    file = tmp_path / "small.yaml"
    settings = {
        "name": "small",
        "instrument": INSTRUMENT,
        "sky": {"foregrounds": {"kind": "g4jy-and-counts", "count": 100}},
        "simulation": {"chunks": 1, "engine": "dense"},
        "outputs": {"store": str(tmp_path / "store")},
    }
    file.write_text(yaml.safe_dump(settings))
    call = [
        "check",
        "engine",
        str(file),
        "--reference",
        "matvis",
        "--workers",
        "1",
        "--output",
        str(tmp_path / "checks"),
    ]
    loose = ["--reference-set", "simulation.nodes.tolerance=1e-6", "--tolerance", "1e-5"]
    first = CliRunner().invoke(app, [*call, *loose])
    assert first.exit_code == 0, first.output
    numbers = json.loads((tmp_path / "checks" / "engine.json").read_text())
    assert 1e-16 < numbers["largest"] < 1e-6
    overrides = ["simulation.engine=matvis", "simulation.nodes.tolerance=1e-6", "simulation.chunks=3"]
    task = simulation.foregrounds(Graph(load(file, None, overrides)))
    assert task.key == numbers["simulations"][1]["key"]
    assert Store(tmp_path / "store").verify(task.stage.name, task.key) is not None
    again = CliRunner().invoke(app, [*call, *loose[:2], "--tolerance", "1e-17"])
    assert "simulate" not in again.output
    assert again.exit_code == 1
    same = CliRunner().invoke(app, ["check", "engine", str(file), "--reference", "dense"])
    assert "own engine" in str(same.exception)
