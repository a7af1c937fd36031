"""An estimator from one file outside the package: settings, key, and spectra that agree with the default's."""

from __future__ import annotations

import numpy as np
import pytest
from plugin_files import Plugged, make

from calstudy.base.errors import ExperimentError
from calstudy.experiment.model import Variant
from calstudy.power.binned import cylindrical_average, noise_level
from calstudy.products import spectra
from calstudy.products.graph import Graph
from calstudy.studies.reference import field_reference, plugin_reference

CHANNELS = 32


@pytest.fixture(params=["path", "entry point"])
def plugged(request, tmp_path, monkeypatch) -> Plugged:
    return Plugged("An estimator", request.param, tmp_path, monkeypatch)


def with_estimator(plugged: Plugged, estimator):
    small = {"foregrounds": {"kind": "g4jy-and-counts", "count": 20}, "eor": {"nside": 16}}
    # A band of 2.6 MHz, within which nothing evolves much: the example takes its numbers at the centre.
    instrument = {"channels": {"first": "170 MHz", "width": "80 kHz", "count": CHANNELS}}
    return plugged.experiment({"power": {"estimator": estimator}, "sky": small, "instrument": instrument})


def test_its_settings_are_validated_with_units(plugged):
    experiment = with_estimator(plugged, plugged.settings())
    assert experiment.power.estimator.lowest == 171e6
    with pytest.raises(ExperimentError, match=r"power\.estimator\.lowest: '2 m' has a unit that cannot be converted"):
        with_estimator(plugged, plugged.settings(lowest="2 m"))
    with pytest.raises(ExperimentError, match=r"power\.estimator: 'plane' is not an estimator \(there are: hera-pspec"):
        with_estimator(plugged, "plane")


def test_it_is_listed(plugged):
    text = plugin_reference(plugged.file) if plugged.reference.endswith(".py") else field_reference()
    assert "| `lowest` | quantity in Hz | `0 Hz` | Channels below are left out. |" in text


def test_it_decides_the_spectra_and_nothing_before(plugged):
    graphs = [Graph(with_estimator(plugged, estimator)) for estimator in ("hera-pspec", plugged.settings())]
    default, own = (spectra.power(graph, "noise") for graph in graphs)
    assert own.key != default.key
    assert [task.key for task in own.inputs.values()] == [task.key for task in default.inputs.values()]
    other = Graph(with_estimator(plugged, plugged.settings(lowest="170.5 MHz")))
    assert spectra.power(other, "noise").key != own.key


@pytest.mark.chain
def test_its_spectra_of_noise_agree_with_the_defaults(plugged):
    """The noise's level to its error, and each mode to a few times the evolution of the beam over the band."""
    graphs = [Graph(with_estimator(plugged, each)) for each in ("hera-pspec", plugged.settings(lowest="0 Hz"))]
    noise = Variant(components=("noise",))
    tasks = [spectra.variant_power(graph, "noise", noise) for graph in graphs]
    products = make(tasks, plugged.folder)
    default, own = (spectra.read_delay_spectra(products[task.key].path) for task in tasks)
    assert not (products[tasks[1].key].path / "pspec.h5").exists()
    modes = own.power.size
    assert noise_level(own) == pytest.approx(noise_level(default), rel=1 / np.sqrt(modes))
    # hera_pspec has the delay axis reversed, and delays of -0.5 / width to (0.5 - 1 / N) / width.
    reversed_power = np.roll(default.power[:, ::-1], 1, axis=1)
    band = (CHANNELS * 80e3 / default.frequency) * 3
    assert np.abs(own.power - reversed_power).max() < band * np.abs(own.power).max()
    # UVPSpec stores positions on the Earth, from which baselines come back to 1e-10.
    np.testing.assert_allclose(own.k_perp, default.k_perp, rtol=1e-9)
    np.testing.assert_allclose(own.k_parallel, default.k_parallel, rtol=1e-9, atol=1e-12)


@pytest.mark.chain
def test_all_spectra_of_a_run_are_made_with_it(plugged):
    experiment = with_estimator(plugged, plugged.settings())
    variants = {name: experiment.variants[name] for name in ("uncalibrated", "eor", "noise")}
    graph = Graph(experiment.model_copy(update={"variants": variants}))
    task = spectra.spectra(graph)
    products = make([task], plugged.folder)
    assert (products[task.key].path / "uncalibrated.wedge.h5").is_file()
    found = spectra.read_delay_spectra(products[spectra.power(graph, "eor").key].path)
    kept = sum(frequency >= 171e6 for frequency in 170e6 + 80e3 * np.arange(CHANNELS))
    assert found.power.shape == (21, kept)
    assert cylindrical_average(found, experiment.power).power.shape[1] == kept // 2 + 1


TWICE = """
from dataclasses import replace
from calstudy.power.estimators.hera_pspec import HeraPspec

class Twice(HeraPspec):
    def estimate(self, even, odd, beam, settings):
        found = super().estimate(even, odd, beam, settings)
        return replace(found, power=2 * found.power, share_power=2 * found.share_power)
"""


@pytest.mark.chain
def test_one_that_changes_the_default_is_used_with_a_folder_as_well(plugged):
    (plugged.folder / "twice.py").write_text(TWICE)
    graphs = [Graph(with_estimator(plugged, each)) for each in ("hera-pspec", "twice.py")]
    tasks = [spectra.variant_power(graph, "noise", Variant(components=("noise",))) for graph in graphs]
    products = make(tasks, plugged.folder)
    default, own = (spectra.read_delay_spectra(products[task.key].path) for task in tasks)
    np.testing.assert_allclose(own.power, 2 * default.power, rtol=1e-12)
