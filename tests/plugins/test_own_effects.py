"""An effect from one file outside the package: settings, key, truth, and what becomes of the data."""

from __future__ import annotations

import numpy as np
import pytest
from plugin_files import Plugged, make
from pyuvdata import UVCal

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.identity import identity
from calstudy.base.user_code import UserCodeError
from calstudy.base.visibilities import antenna_indices, to_cube
from calstudy.corrupt.interface import Effect, apply_effect, draw_truth
from calstudy.experiment.files import validate
from calstudy.products import corruption
from calstudy.products.files import read_visibilities
from calstudy.products.graph import Graph
from calstudy.studies.reference import field_reference, plugin_reference


@pytest.fixture(params=["path", "entry point"])
def plugged(request, tmp_path, monkeypatch) -> Plugged:
    return Plugged("An effect", request.param, tmp_path, monkeypatch)


def with_effects(plugged: Plugged, *effects):
    # Skies of a few sources: what is tested comes after the simulation.
    small = {"foregrounds": {"kind": "g4jy-and-counts", "count": 20}, "eor": {"nside": 16}}
    return plugged.experiment({"corruption": {"noise": {"factor": 2}, "effects": list(effects)}, "sky": small})


def test_its_settings_are_validated_with_units(plugged):
    experiment = with_effects(plugged, plugged.settings(), {"kind": "per-channel-gains"})
    assert experiment.corruption.effects[0].amplitude == 0.05
    assert experiment.corruption.effects[0].delay == 900e-9
    assert experiment.corruption.gains.sigma == 0.1
    for changes, told in (
        ({"delay": 3}, r"corruption.effects.0.delay: 3 has no unit"),
        ({"amplitude": "-1 Jy"}, "corruption.effects.0.amplitude = '-1 Jy': must be at least 0 Jy"),
        ({"amplitud": "1 Jy"}, "corruption.effects.0.amplitud: unknown key, did you mean 'amplitude'"),
    ):
        with pytest.raises(ExperimentError) as caught:
            with_effects(plugged, plugged.settings(**changes))
        assert any(sentence.startswith(told) for sentence in caught.value.faults), caught.value.faults


def test_it_is_listed(plugged):
    text = plugin_reference(plugged.file) if plugged.reference.endswith(".py") else field_reference()
    assert "| `delay_scatter` | quantity in s | `5e-08 s` |" in text
    assert "A signal in every baseline that is constant in time" in text


def test_its_settings_and_its_code_decide_the_product(plugged):
    def key(**changes) -> str:
        graph = Graph(with_effects(plugged, plugged.settings(**changes)))
        return corruption.data(graph, graph.experiment.variants["uncalibrated"], "even").key

    first = key()
    assert key() == first == key(delay="0.9 us")
    assert len({first, key(delay="800 ns"), key(seed=8)}) == 3
    found = identity(with_effects(plugged, plugged.settings()).corruption.effects[0])["kind"]
    if plugged.reference.endswith(".py"):
        plugged.file.write_text(plugged.file.read_text() + "# changed\n")
        assert key() != first
        assert found.startswith("sha256:")
    else:
        assert found == "outside_crosstalk==1.2:outside-crosstalk"


@pytest.mark.chain
def test_effects_happen_to_the_data_in_their_order(plugged):
    """Crosstalk, then gains: V = g g* (sky + noise + crosstalk), and crosstalk is drawn once for both realizations."""
    experiment = with_effects(plugged, plugged.settings(amplitude="2 Jy"), {"kind": "per-channel-gains", "seed": 9})
    graph = Graph(experiment)
    clean, dirty = experiment.variants["uncorrupted"], experiment.variants["uncalibrated"]
    tasks = {(name, parity): corruption.data(graph, variant, parity) for name, variant in
             (("clean", clean), ("dirty", dirty)) for parity in ("even", "odd")}  # fmt: skip
    truth, gains = corruption.truths(graph)[0], corruption.gains(graph)
    products = make([*tasks.values(), gains], plugged.folder)
    assert tasks["dirty", "even"].label == "corrupted data (foregrounds + eor + noise even)"
    data = {name: read_visibilities(products[task.key].path / "data.uvh5") for name, task in tasks.items()}
    drawn = corruption.read_truth(products[truth.key].path)
    template = data["clean", "even"]
    assert drawn["delay"].shape == drawn["phase"].shape == (template.Nbls, 1, template.Npols)
    turns = template.freq_array[:, None] * drawn["delay"]
    crosstalk = 2 * np.exp(1j * (drawn["phase"] - 2 * np.pi * turns))
    true = UVCal.from_file(products[gains.key].path / "gains.calh5").gain_array[:, :, 0]
    first, second = antenna_indices(template).T
    for parity in ("even", "odd"):
        expected = true[first] * true[second].conj() * (to_cube(data["clean", parity]) + crosstalk)
        # Data are stored as complex64.
        np.testing.assert_allclose(to_cube(data["dirty", parity]), expected, rtol=1e-6, atol=1e-6 * abs(expected).max())


def test_without_gain_effects_the_true_gains_are_unity_and_with_several_their_product(plugged):
    def gains(*effects) -> np.ndarray:
        task = corruption.gains(Graph(with_effects(plugged, *effects)))
        return UVCal.from_file(make([task], plugged.folder)[task.key].path / "gains.calh5").gain_array

    channel, reflection = {"kind": "per-channel-gains", "seed": 1}, {"kind": "reflection-gains", "seed": 2}
    assert (gains(plugged.settings()) == 1).all()
    np.testing.assert_allclose(
        gains(channel, plugged.settings(), reflection), gains(channel) * gains(reflection), rtol=1e-14
    )


BROKEN = """
import sys
import numpy as np
from calstudy.corrupt.interface import Effect, GainEffect

class Raising(Effect):
    def apply(self, visibilities, observation, truth):
        return visibilities + truth["nothing"]

class Exiting(Effect):
    def apply(self, visibilities, observation, truth):
        sys.exit(3)

class Short(Effect):
    def apply(self, visibilities, observation, truth):
        return visibilities[:1, :2]

class Real(Effect):
    def apply(self, visibilities, observation, truth):
        return abs(visibilities)

class Spoiling(Effect):
    def apply(self, visibilities, observation, truth):
        return visibilities * np.nan

class Words(Effect):
    def draw(self, observation, random):
        return {"note": "a text"}
    def apply(self, visibilities, observation, truth):
        return visibilities

class Fresh(Effect):
    def draw(self, observation, random):
        return {"phase": np.random.default_rng().uniform(size=3)}
    def apply(self, visibilities, observation, truth):
        return visibilities

class Drifting(GainEffect):
    def gains(self, observation, random):
        return np.ones((observation.n_antennas, observation.n_channels, observation.n_times + 1, 1), complex)
"""


def test_an_effect_that_does_nothing_is_refused(tmp_path):
    """A method whose name is misspelt would be missed in silence."""
    path = tmp_path / "own.py"
    path.write_text(
        "from calstudy.corrupt.interface import Effect\n\nclass Own(Effect):\n"
        "    def aply(self, visibilities, observation, truth):\n        return 2 * visibilities\n"
    )
    with pytest.raises(ExperimentError, match="Own defines neither apply nor flags"):
        validate({"name": "own", "corruption": {"effects": [{"kind": str(path)}]}}, tmp_path)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("Raising", r"broken\.py line 8, in apply: KeyError: 'nothing'"),
        ("Real", "effect 'Real': apply returned an array of float64 of shape .*, expected complex"),
        ("Exiting", r"broken\.py line 12, in apply: it ended the process \(sys\.exit, status 3\)"),
        ("Short", r"effect 'Short': apply returned an array of complex128 of shape \(1, 2, 32, 1\), expected"),
        ("Spoiling", "effect 'Spoiling': apply returned visibilities that are not finite"),
        ("Words", "effect 'Words': 'note' of its truth is an array of <U6"),
        ("Fresh", "effect 'Fresh': it draws different arrays at every call"),
        (
            "Drifting",
            r"effect 'Drifting': its gains are complex128 of shape \(7, 32, 3, 1\), expected complex of shape",
        ),
    ],
)
def test_what_it_does_wrong_is_said_in_a_sentence(tmp_path, monkeypatch, name, told):
    from calstudy.base.observation import Observation
    from calstudy.instrument.telescope import make_template

    (tmp_path / "broken.py").write_text(BROKEN)
    effect = Effect.registry.make(f"broken.py:{name}", folder=tmp_path)
    observation = Observation(
        make_template(Plugged("An effect", "path", tmp_path, monkeypatch).experiment({}).instrument)
    )
    with pytest.raises(InputError, match=told) as caught:
        apply_effect(effect, np.ones(observation.shape, complex), observation, draw_truth(effect, observation))
    assert isinstance(caught.value, UserCodeError) == (name in ("Raising", "Exiting"))


def test_flags_of_a_subclass_are_asked_for(tmp_path):
    (tmp_path / "flagging.py").write_text(
        "import numpy as np\nfrom calstudy.corrupt.effects.losses import Decoherence\n\n\n"
        "class Flagging(Decoherence):\n    kind: str = ''\n\n    def flags(self, observation, truth):\n"
        "        return np.ones((1, 1, 1, 1), dtype=bool)\n"
    )
    assert Effect.registry.make({"kind": "flagging.py"}, folder=tmp_path).can_flag
    assert not Effect.registry.make({"kind": "decoherence"}).can_flag
