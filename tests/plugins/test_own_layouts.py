"""A layout from one file outside the package: settings, key, and what an array and its plan are made of."""

from __future__ import annotations

import numpy as np
import pytest
from plugin_files import Plugged

from calstudy.base.errors import ExperimentError, InputError
from calstudy.instrument.layouts import make_array, make_layout, size_of_instrument
from calstudy.instrument.settings import InstrumentSettings
from calstudy.products import simulation
from calstudy.products.graph import Graph
from calstudy.studies.reference import field_reference, plugin_reference


@pytest.fixture(params=["path", "entry point"])
def plugged(request, tmp_path, monkeypatch) -> Plugged:
    return Plugged("A layout", request.param, tmp_path, monkeypatch)


def with_layout(plugged: Plugged, layout, **instrument):
    return plugged.experiment({"instrument": {"layout": layout, **instrument}})


def test_its_settings_are_validated_with_units(plugged):
    assert with_layout(plugged, plugged.settings()).instrument.layout.radius == 60.0
    with pytest.raises(ExperimentError, match=r"instrument\.layout\.radius: 60 has no unit"):
        with_layout(plugged, plugged.settings(radius=60))
    with pytest.raises(ExperimentError, match=r"instrument\.layout: 'hexx' is not a layout, did you mean 'hex'\?"):
        with_layout(plugged, "hexx")


def test_it_is_listed(plugged):
    text = plugin_reference(plugged.file) if plugged.reference.endswith(".py") else field_reference()
    assert "| `radius` | quantity in m | `100 m` |" in text


def test_antennas_are_where_it_says(plugged):
    """The sum of squared distances of a spiral of N antennas at radii R sqrt((n + 1/2) / N) is N R^2 / 2."""
    instrument = with_layout(plugged, plugged.settings()).instrument
    array = make_array(instrument)
    place = np.arange(24) + 0.5
    spiral = 60 * np.sqrt(place / 24) * np.exp(1j * place * np.pi * (3 - 5**0.5))
    assert np.sum(abs(spiral) ** 2) == pytest.approx(24 * 60**2 / 2)
    np.testing.assert_allclose(array.enu[:, 0] + 1j * array.enu[:, 1], spiral - spiral.mean(), atol=1e-9)
    apart = abs(spiral[:, None] - spiral)
    size = size_of_instrument(instrument)
    assert (size.antennas, size.longest) == (24, pytest.approx(apart.max()))
    assert size.mean == pytest.approx(apart.sum() / (24 * 23))


def test_it_decides_what_is_simulated(plugged):
    small, large = (Graph(with_layout(plugged, plugged.settings(radius=radius))) for radius in ("50 m", "60 m"))
    assert simulation.foregrounds(small).key != simulation.foregrounds(large).key


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ("return self.flat(np.full((3, 2), np.nan))", "must be finite"),
        ("return self.flat(np.zeros((1, 2)))", "at least two antennas are needed"),
        ("return self.flat(np.array([[0, 0], [9, 0], [0, 0.0]]))", "are in the same place"),
        ("self.flat(np.eye(2))", "make returned None; a Layout is needed"),
        ("return self.flat(np.random.default_rng().normal(0, 30, (7, 2)))", "other antennas at every call"),
        ("return self.flat(np.array([[0, 0], [9, 0], [0, 1e-7]]))", "are in the same place"),
        ("return self.flat(np.zeros((3, 2)))", "are in the same place"),
        ("return self.flat(np.array([[0, 0], [9, 9j]]))", "and enu one of real numbers"),
        ("return replace(self.flat(3 * np.eye(2)), numbers=np.array([0.0, 1.5]))", "must be an array of integers"),
        ("return replace(self.flat(3 * np.eye(2)), numbers=[0, 1])", "must be an array of integers"),
        ("return replace(self.flat(3 * np.eye(2)), names=('a', ''))", "antenna 1 has an empty name"),
        ("return 1 / 0", r"own\.py line 7, in make: ZeroDivisionError"),
    ],
)
def test_what_is_no_layout_is_refused_in_a_sentence(tmp_path, body, sentence):
    path = tmp_path / "own.py"
    path.write_text(
        "from dataclasses import replace\nimport numpy as np\n"
        "from calstudy.instrument.layouts import ArrayLayout\n\n"
        f"class Own(ArrayLayout):\n    def make(self):\n        {body}\n"
    )
    layout = InstrumentSettings.model_validate({"layout": str(path)}).layout
    with pytest.raises(InputError, match=sentence):
        make_layout(layout)


def test_an_array_at_no_site_needs_a_location(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(
        "from calstudy.instrument.layouts import ArrayLayout\n\nclass Own(ArrayLayout):\n    site = None\n"
        "    def make(self):\n        return self.flat(np.eye(2))\n"
    )
    with pytest.raises(ValueError, match="is at no site"):
        InstrumentSettings.model_validate({"layout": str(path)})
