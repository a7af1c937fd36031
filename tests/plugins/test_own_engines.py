"""An engine from one file outside the package: settings, key, cost, refusal, and visibilities that agree."""

from __future__ import annotations

import numpy as np
import pytest
from plugin_files import Plugged, make

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.user_code import load_file
from calstudy.base.visibilities import to_cube
from calstudy.products import simulation
from calstudy.products.files import read_visibilities
from calstudy.products.graph import Graph
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.simulate.interface import Engine
from calstudy.studies.reference import field_reference, plugin_reference

SIMULATE = "    def simulate(self, sky, beam, template):\n        return 0\n"


@pytest.fixture(params=["path", "entry point"])
def plugged(request, tmp_path, monkeypatch) -> Plugged:
    return Plugged("An engine", request.param, tmp_path, monkeypatch)


def with_engine(plugged: Plugged, engine, **instrument):
    small = {"foregrounds": {"kind": "g4jy-and-counts", "count": 20}, "eor": {"nside": 16}}
    changes = {"simulation": {"engine": engine, "chunks": 2}, "sky": small, "instrument": instrument}
    return plugged.experiment(changes)


def test_its_settings_are_validated_with_units(plugged):
    assert with_engine(plugged, plugged.settings(faintest="2 mJy")).simulation.engine.faintest == 2e-3
    with pytest.raises(ExperimentError, match=r"simulation\.engine\.faintest: 0\.001 has no unit"):
        with_engine(plugged, plugged.settings(faintest=0.001))
    with pytest.raises(ExperimentError, match=r"simulation\.engine: 'fast' is not an engine \(there are: auto, dense"):
        with_engine(plugged, "fast")


def test_it_is_listed(plugged):
    text = plugin_reference(plugged.file) if plugged.reference.endswith(".py") else field_reference()
    assert "| `faintest` | quantity in Jy | `0 Jy` | Fainter components are left out. |" in text


def test_it_decides_the_simulation_and_its_cost(plugged):
    default, own, other = (
        simulation.foregrounds(Graph(with_engine(plugged, engine)))
        for engine in ("auto", plugged.settings(), plugged.settings(faintest="1 Jy"))
    )
    assert len({default.key, own.key, other.key}) == 3
    seconds = [next(iter(task.pieces.values())).cost.seconds for task in (default, own)]
    assert seconds[0] != seconds[1]


def test_its_visibilities_are_those_of_the_default(plugged):
    tasks = [simulation.foregrounds(Graph(with_engine(plugged, engine))) for engine in ("auto", plugged.settings())]
    products = make(tasks, plugged.folder)
    expected, found = (to_cube(read_visibilities(products[task.key].path / "visibilities.uvh5")) for task in tasks)
    # Two ways to add up the same terms: what differs is rounding, of phases of up to 1e3 turns.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * abs(expected).max())


@pytest.mark.parametrize(
    ("bases", "own", "expected"),
    [("Mixin, DenseEngine", "", "Engine"), ("Own", SIMULATE, "Own"), ("DenseEngine", "", "DenseEngine")],
)
def test_the_interpolation_that_calls_the_simulation_is_used(tmp_path, bases, own, expected):
    """Of a class that overrides one of them; an interpolation of the user's is nobody's to replace."""
    (tmp_path / "derived.py").write_text(
        f"from calstudy.simulate.engines.dense import DenseEngine\n\n\nclass Mixin:\n{SIMULATE}\n\n"
        "class Own(DenseEngine):\n    kind: str = ''\n\n    def interpolate(self, *given):\n        return 1\n\n\n"
        f"class Derived({bases}):\n    kind: str = ''\n\n{own}"
    )
    module = load_file(tmp_path / "derived.py")
    known = {"Engine": Engine, "DenseEngine": DenseEngine, "Own": module.Own}
    assert module.Derived.interpolate is known[expected].interpolate


def test_it_refuses_in_a_sentence(plugged):
    task = simulation.foregrounds(Graph(with_engine(plugged, plugged.settings(), polarizations=["xx", "yy"])))
    with pytest.raises(InputError, match=r"simulation\.engine = '\w.*': needs an unpolarized sky in xx"):
        make([task], plugged.folder)


WITHOUT_FIRST = """
from calstudy.simulate.engines.dense import {base}

class WithoutFirst({base}):
    kind: str = ""

    def simulate(self, sky, beam, template):
        cube = super().simulate(sky, beam, template)
        cube[:, 0] = 0
        return cube
"""


@pytest.mark.parametrize("base", ["DenseEngine", "FastestEngine"])
def test_one_that_changes_a_built_in_simulation_is_interpolated_by_its_own(plugged, base):
    """The built-in ones interpolate by themselves, and not by what they simulate."""
    (plugged.folder / "without_first.py").write_text(WITHOUT_FIRST.format(base=base))
    tasks = [simulation.foregrounds(Graph(with_engine(plugged, engine))) for engine in ("dense", "without_first.py")]
    products = make(tasks, plugged.folder)
    expected, found = (to_cube(read_visibilities(products[task.key].path / "visibilities.uvh5")) for task in tasks)
    assert not found[:, 0].any()
    # Both to the tolerance of the interpolation.
    np.testing.assert_allclose(found[:, 1:], expected[:, 1:], rtol=0, atol=1e-6 * abs(expected).max())
