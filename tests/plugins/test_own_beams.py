"""A beam from one file outside the package: settings, key, and what simulations and power spectra see of it."""

from __future__ import annotations

import numpy as np
import pytest
from plugin_files import Plugged, make
from tiny import tiny

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.visibilities import to_cube
from calstudy.experiment.files import validate
from calstudy.instrument.beams import make_beam
from calstudy.products import corruption, simulation, spectra
from calstudy.products.files import read_visibilities
from calstudy.products.graph import Graph
from calstudy.studies.reference import field_reference, plugin_reference


@pytest.fixture(params=["path", "entry point"])
def plugged(request, tmp_path, monkeypatch) -> Plugged:
    return Plugged("A beam", request.param, tmp_path, monkeypatch)


def with_beam(plugged: Plugged, beam, **instrument):
    small = {"foregrounds": {"kind": "g4jy-and-counts", "count": 20}, "eor": {"nside": 16}}
    return plugged.experiment({"sky": small, "instrument": {"beam": beam, **instrument}})


def test_its_settings_are_validated_with_units(plugged):
    assert with_beam(plugged, plugged.settings()).instrument.beam.diameter == 4.0
    with pytest.raises(ExperimentError, match=r"instrument\.beam\.diameter: 4 has no unit"):
        with_beam(plugged, plugged.settings(diameter=4))
    groups = {"outer": {"antennas": [1], "beam": plugged.settings(diameter="-4 m")}}
    told = r"instrument\.antenna_beams\.outer\.beam\.diameter = '-4 m': must be greater than 0 m"
    with pytest.raises(ExperimentError, match=told):
        with_beam(plugged, "gaussian", antenna_beams=groups)
    with pytest.raises(
        ExperimentError,
        match=r"instrument\.beam: 'gausian' is not a beam, did you mean 'gaussian'\? \(there are: airy, ",
    ):
        with_beam(plugged, "gausian")


def test_it_is_listed(plugged):
    text = plugin_reference(plugged.file) if plugged.reference.endswith(".py") else field_reference()
    assert "| `diameter` | quantity in m | `6 m` |" in text


def test_it_decides_what_looks_through_it(plugged):
    own, default = (Graph(with_beam(plugged, beam)) for beam in (plugged.settings(), "gaussian"))
    assert simulation.foregrounds(own).key != simulation.foregrounds(default).key
    assert spectra.power(own, "noise").key != spectra.power(default, "noise").key
    assert corruption.gains(own).key == corruption.gains(default).key


def test_a_simulation_is_that_of_the_same_built_in_beam(plugged):
    """A standard deviation of the power beam of 0.42 wavelengths over D, and its width at half maximum."""
    width = np.rad2deg(0.42 * 299792458.0 / (4.0 * 170e6) * 2 * np.sqrt(2 * np.log(2)))
    same = {"kind": "gaussian", "fwhm_deg": float(width), "reference_frequency": "170 MHz"}
    experiments = [with_beam(plugged, beam) for beam in (plugged.settings(), same)]
    tasks = [simulation.foregrounds(Graph(experiment)) for experiment in experiments]
    products = make(tasks, plugged.folder)
    found, expected = (to_cube(read_visibilities(products[task.key].path / "visibilities.uvh5")) for task in tasks)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * abs(expected).max())
    beams = [make_beam(experiment.instrument.beam, experiment.instrument.channels) for experiment in experiments]
    angles = [beam.solid_angles(np.array([170e6, 180e6]), "xx") for beam in beams]
    np.testing.assert_allclose(*angles, rtol=1e-9)


@pytest.mark.parametrize(
    ("result", "told"),
    [
        ("None", "make returned NoneType, which is no beam: it has no 'name'$"),
        (
            "GaussianBeam(sigma=0.1)",
            r"returned GaussianBeam, .*; wrap it in calstudy\.instrument\.beams\.ExactBeam$",
        ),
    ],
)
def test_what_is_no_beam_is_refused(tmp_path, result, told):
    path = tmp_path / "own.py"
    path.write_text(
        "from pyuvdata.analytic_beam import GaussianBeam\nfrom calstudy.instrument.interface import BeamModel\n\n"
        f"class Own(BeamModel):\n    def make(self, channels):\n        return {result}\n"
    )
    settings = validate({"name": "own", "instrument": {"beam": str(path)}}, tmp_path).instrument
    with pytest.raises(InputError, match=told):
        make_beam(settings.beam, settings.channels)


@pytest.mark.parametrize(
    ("at", "told"),
    [
        ("return self.analytic", "own.py line 12, in at: AttributeError: 'Failing' object has no attribute 'analytic'"),
        ("raise KeyError('no frequency')", "own.py line 12, in at: KeyError: 'no frequency'"),
    ],
)
def test_what_goes_wrong_while_a_stage_works_is_told_with_its_line(tmp_path, at, told):
    """The engine that calls the beam is built in."""
    (tmp_path / "own.py").write_text(
        "from calstudy.instrument.beams import ExactBeam\nfrom calstudy.instrument.interface import BeamModel\n"
        "from pyuvdata.analytic_beam import AiryBeam\n\nclass Failing:\n    name, stand_in = 'failing', None\n\n"
        "    def __init__(self):\n        self.beam = ExactBeam(AiryBeam(diameter=4.0), 'airy', None)\n\n"
        f"    def at(self, frequencies):\n        {at}\n\n"
        "    def solid_angles(self, *given):\n        return self.beam.solid_angles(*given)\n\n"
        "class Own(BeamModel):\n    def make(self, channels):\n        return Failing()\n"
    )
    content = tiny(tmp_path)
    content["instrument"]["beam"] = "own.py"
    with pytest.raises(InputError) as caught:
        make([simulation.foregrounds(Graph(validate(content, tmp_path)))], tmp_path)
    assert told in str(caught.value)
