"""Different beams on different antennas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from simulation_cases import ALL_ENGINES, FAST_ENGINES, needs_engines, observe, random_sky, relative_error

from calstudy.base.errors import ExperimentError
from calstudy.base.visibilities import antenna_indices, to_cube
from calstudy.experiment.files import validate
from calstudy.instrument.antenna_beams import make_beams
from calstudy.instrument.interface import AntennaBeams
from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.telescope import make_template
from calstudy.papers.calamity2022 import Calamity2022
from calstudy.products import corruption, simulation
from calstudy.products.files import read_visibilities
from calstudy.products.graph import Graph
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.simulate.engines.other_packages import MatvisEngine, PyuvsimEngine
from calstudy.simulate.settings import SimulationSettings
from calstudy.sky.foregrounds import make_foregrounds

SMALL = {
    "name": "several",
    "instrument": {
        "layout": {"kind": "hex", "side": 2},
        "beam": "gaussian",
        "channels": {"width": "400 kHz", "count": 32},
        "times": {"count": 2},
    },
    "sky": {"foregrounds": {"kind": "g4jy-and-counts", "count": 50}, "eor": {"nside": 16}},
    "simulation": {"chunks": 1},
}
WIDE = {"kind": "gaussian", "fwhm_deg": 30.0}


@pytest.fixture(scope="module")
def template():
    return observe(count=6, channels=1, times=1)


@pytest.fixture(scope="module")
def sky(template):
    return random_sky(template, count=60)


@pytest.fixture(scope="module")
def beams(embedded_beam, gaussian_beam, dipole_beam):
    return AntennaBeams((embedded_beam, gaussian_beam, dipole_beam), np.array([0, 2, 0, 1, 2, 0]))


@pytest.fixture(scope="module")
def expected(sky, beams, template):
    return PyuvsimEngine().simulate(sky, beams, template)


@pytest.mark.parametrize("engine", FAST_ENGINES)
def test_engines_agree_with_pyuvsim(engine, sky, beams, template, expected):
    assert engine.refusal(sky, beams, template) is None
    assert relative_error(engine.simulate(sky, beams, template), expected) < 1e-10


def test_only_the_baselines_of_other_antennas_change(sky, beams, template, expected, embedded_beam):
    alike = DenseEngine().simulate(sky, embedded_beam, template)
    first, second = beams.index[antenna_indices(template)].T
    own = (first == 0) & (second == 0)
    np.testing.assert_allclose(expected[:, own], alike[:, own], rtol=1e-10)
    changes = np.abs(expected - alike).max(axis=(0, 2, 3))
    assert (changes[~own] > 1e-3 * np.sqrt(np.mean(np.abs(alike) ** 2))).all()


@pytest.mark.parametrize("engine", ALL_ENGINES)
def test_the_same_beam_given_to_each_antenna_changes_nothing(engine, sky, gaussian_beam):
    template = observe(count=4, channels=1, times=1)
    twice = AntennaBeams((gaussian_beam, gaussian_beam), np.array([0, 1, 1, 0]))
    whole = engine.simulate(sky, gaussian_beam, template)
    assert relative_error(engine.simulate(sky, twice, template), whole) < 1e-11


def test_beams_that_are_the_same_are_one():
    alike = {"some": {"antennas": [0, 3], "beam": "gaussian"}}
    instrument = InstrumentSettings.model_validate({**SMALL["instrument"], "antenna_beams": alike})
    assert not isinstance(make_beams(instrument, 7), AntennaBeams)
    groups = {"a": {"antennas": [4], "beam": WIDE}, "b": {"antennas": [1], "beam": WIDE}, **alike}
    instrument = InstrumentSettings.model_validate({**SMALL["instrument"], "antenna_beams": groups})
    made = make_beams(instrument, 7)
    assert made.index.tolist() == [0, 1, 0, 0, 1, 0, 0]
    assert "antennas with another: 2" in made.stand_in


def test_auto_takes_the_fastest(sky, beams, template):
    assert SimulationSettings().engine.choose(sky, beams, template).label == "dense"


@needs_engines
def test_an_experiment_simulates_them(tmp_path: Path):
    groups = {"damaged": {"antennas": [2, 5], "beam": WIDE}}
    experiment = validate({**SMALL, "instrument": {**SMALL["instrument"], "antenna_beams": groups}}, tmp_path)
    task = simulation.foregrounds(Graph(experiment))
    (piece,) = task.pieces.values()
    chunk, whole = tmp_path / "chunk", tmp_path / "whole"
    chunk.mkdir()
    whole.mkdir()
    piece.make(chunk)
    task.given({"chunk000": chunk}).make(whole)
    template = make_template(experiment.instrument)
    made = make_beams(experiment.instrument, 7)
    assert made.index.tolist() == [0, 0, 1, 0, 0, 1, 0]
    foregrounds = make_foregrounds(experiment.sky.foregrounds, template.freq_array).sky
    direct = MatvisEngine().simulate(foregrounds, made, template)
    assert relative_error(to_cube(read_visibilities(whole / "visibilities.uvh5")), direct) < 1e-8


def test_an_array_of_like_antennas_is_identified_as_before(tmp_path: Path):
    plain, with_field = (
        validate({**SMALL, "instrument": {**SMALL["instrument"], **extra}}, tmp_path)
        for extra in ({}, {"antenna_beams": {}})
    )
    assert simulation.foregrounds(Graph(plain)).key == simulation.foregrounds(Graph(with_field)).key
    groups = {"antenna_beams": {"odd": {"antennas": [1], "beam": WIDE}}}
    other = validate({**SMALL, "instrument": {**SMALL["instrument"], **groups}}, tmp_path)
    assert simulation.foregrounds(Graph(other)).key != simulation.foregrounds(Graph(plain)).key
    assert "antennas with another: 1" in " ".join(Calamity2022().substitutions(other))
    # What does not look through the beams stays the same.
    assert corruption.gains(Graph(other)).key == corruption.gains(Graph(plain)).key


@pytest.mark.parametrize(
    ("groups", "told"),
    [
        ({"a": {"antennas": [7], "beam": "airy"}}, "names antenna 7, but the layout has 7 antennas"),
        ({"a": {"antennas": [1, 1], "beam": "airy"}}, r"antenna_beams\.a\.antennas.*already in a set"),
        (
            {"a": {"antennas": [1], "beam": "airy"}, "b": {"antennas": [1], "beam": "airy"}},
            r"antenna_beams\.b\.antennas.*already in a set",
        ),
        ({"a": {"antennas": [], "beam": "airy"}}, r"antenna_beams\.a\.antennas"),
        (
            {"a": {"antennas": [1], "beam": {"kind": "beamfits", "path": "none.fits"}}},
            r"antenna_beams\.a\.beam\.path = 'none\.fits': no such file",
        ),
    ],
)
def test_mistakes_are_told(groups, told, tmp_path: Path):
    with pytest.raises(ExperimentError, match=told):
        validate({**SMALL, "instrument": {**SMALL["instrument"], "antenna_beams": groups}}, tmp_path)
