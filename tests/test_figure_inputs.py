"""What the figures of gains and baselines show is what the products hold, brought onto one scale."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyuvdata import UVData

from calstudy.base.errors import InputError
from calstudy.base.gains import make_uvcal
from calstudy.base.visibilities import antenna_indices, antenna_pairs, baseline_vectors, from_cube
from calstudy.experiment.model import FIGURES
from calstudy.figures import Draw
from calstudy.instrument.array_layouts.observatories import MwaLayout
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.telescope import make_template
from calstudy.products.files import write_visibilities
from calstudy.products.selection import read_spectra, spread_in_length
from calstudy.run.task import Job

INSTRUMENT = {
    "layout": {"kind": "hex", "side": 2, "spacing": "14 m"},
    "beam": "gaussian",
    "channels": {"count": 16, "width": "240 kHz"},
    "times": {"count": 3},
}
INTEGRATION = 1
SCALE = 1.25


def complex_normal(rng, *shape):
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


class Products:
    """Products of a run, made up: gains off by a phase per channel and a scale, and a known error besides."""

    def __init__(self, folder: Path) -> None:
        rng = np.random.default_rng(51)
        self.instrument = InstrumentSettings.model_validate(INSTRUMENT)
        self.template: UVData = make_template(self.instrument)
        template = self.template
        shape = (template.Ntimes, template.Nbls, template.Nfreqs, 1)
        self.true = 1 + 0.1 * complex_normal(rng, template.Nants_telescope, template.Nfreqs)
        self.phase = np.exp(1j * rng.uniform(0, 6, template.Nfreqs))
        self.foregrounds, self.noise = 10 * complex_normal(rng, *shape), 0.1 * complex_normal(rng, *shape)
        fitted = (self.true * self.phase / SCALE)[:, :, None, None] * np.ones(template.Ntimes)[:, None]
        self.model = self.foregrounds * SCALE**2
        first, second = antenna_indices(template).T
        self.corruption = (self.true[first] * self.true[second].conj())[..., None]
        self.data = self.corruption * (self.foregrounds + self.noise)
        self.residual = complex_normal(rng, *shape)
        self.folders = {name: folder / name for name in ("gains", "calibration", "foregrounds", "noise", "data")}
        for path in self.folders.values():
            path.mkdir()
        make_uvcal(template, self.true[:, :, None, None]).write_calh5(self.folders["gains"] / "gains.calh5")
        self.write_fit(fitted, np.zeros(fitted.shape, bool))
        for name, file, cube in (
            ("calibration", "model.uvh5", self.model),
            ("calibration", "residual.uvh5", self.residual),
            ("foregrounds", "visibilities.uvh5", self.foregrounds),
            ("noise", "data.uvh5", self.noise),
            ("data", "data.uvh5", self.data),
        ):
            write_visibilities(from_cube(template, cube), self.folders[name] / file)

    def write_fit(self, gains: np.ndarray, flags: np.ndarray) -> None:
        cal = make_uvcal(self.template, gains, flags)
        cal.write_calh5(self.folders["calibration"] / "gains.calh5", clobber=True)

    def job(self, *inputs: str, output: Path | None = None, **settings) -> Job:
        settings = {
            "layout": self.instrument.layout,
            "antennas": [0, 1],
            "integration": INTEGRATION,
            "notes": [],
            **settings,
        }
        return Job(settings=settings, inputs={name: self.folders[name] for name in inputs}, output=output)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Products:
    return Products(tmp_path_factory.mktemp("products"))


def shown(name: str, job: Job) -> Any:
    """Return the arrays that a figure shows."""
    return FIGURES.make(name).draw(job).shown


def test_gains_are_the_products_as_fitted_and_besides_aligned_with_the_truth(made):
    found = shown("gains", made.job("gains", "calibration", antennas=[2, 4]))
    fitted = made.true[[2, 4]] * made.phase / SCALE
    np.testing.assert_array_equal(found.true.values, made.true[[2, 4]])
    np.testing.assert_allclose(found.recovered.values, fitted, atol=1e-12)
    np.testing.assert_allclose(found.residual.values, made.true[[2, 4]] - fitted, atol=1e-12)
    np.testing.assert_allclose(found.aligned_residual.values, 0, atol=1e-12)
    # The phase cancels in the ratio, the scale does not.
    np.testing.assert_allclose(found.correction.values, SCALE**2 - 1, atol=1e-12)
    assert found.antennas == (2, 4)


def test_true_gains_that_drift_are_those_of_the_integration(tmp_path):
    """In every figure that shows them: the gains are not those of the first time."""
    made = Products(tmp_path)
    drift = np.exp(complex_normal(np.random.default_rng(52), len(made.true), 1, made.template.Ntimes))
    true = made.true[..., None] * drift
    made.write_fit(np.ones_like(true)[..., None], np.zeros((*true.shape, 1), bool))
    make_uvcal(made.template, true[..., None]).write_calh5(made.folders["gains"] / "gains.calh5", clobber=True)
    found = shown("gains", made.job("gains", "calibration"))
    np.testing.assert_array_equal(found.true.values, true[[0, 1], :, INTEGRATION])
    np.testing.assert_array_equal(shown("reflections", made.job("gains")).values, true[..., INTEGRATION])
    factor = true[0, :, INTEGRATION] * true[1, :, INTEGRATION].conj()
    index = antenna_pairs(made.template).tolist().index([0, 1])
    noise = shown("data", made.job("gains", "calibration", "data", "noise")).noise.values
    np.testing.assert_allclose(noise, factor * made.noise[INTEGRATION, index, :, 0], rtol=1e-6)


def test_an_error_of_one_antenna_is_shown_as_it_is(made, tmp_path):
    off = Products(tmp_path)
    gains = np.repeat(off.true[:, :, None, None], 3, axis=2)
    gains[0, :, INTEGRATION] *= 1.1
    off.write_fit(gains, np.zeros(gains.shape, bool))
    found = shown("gains", off.job("gains", "calibration"))
    # The least-squares scale of seven antennas, one of which is 10 % too large.
    power = np.sum(np.abs(off.true) ** 2, axis=1)
    scale = (1.1 * power[0] + power[1:].sum()) / (1.21 * power[0] + power[1:].sum())
    np.testing.assert_allclose(found.recovered.values[1], off.true[1], rtol=1e-12)
    np.testing.assert_allclose(found.aligned_residual.values[1], (1 - scale) * off.true[1], rtol=1e-12)
    np.testing.assert_allclose(found.correction.values, 1 / 1.1 - 1, atol=1e-12)


def test_the_model_is_put_on_the_scale_of_the_true_gains(made):
    found = shown("model", made.job("gains", "calibration", "foregrounds", "noise", antennas=[3, 1]))
    index = antenna_pairs(made.template).tolist().index([1, 3])
    assert found.antennas == (1, 3)
    np.testing.assert_allclose(found.reference.values, made.foregrounds[INTEGRATION, index, :, 0])
    np.testing.assert_allclose(found.model.values, made.foregrounds[INTEGRATION, index, :, 0], rtol=1e-10)
    np.testing.assert_allclose(found.noise.values, made.noise[INTEGRATION, index, :, 0])


def test_data_less_gains_times_model_are_the_noise_with_its_gains(made):
    found = shown("data", made.job("gains", "calibration", "data", "noise"))
    assert found.baseline_length == pytest.approx(np.linalg.norm(baseline_vectors(made.template)[0]), rel=1e-6)
    np.testing.assert_allclose(found.reference.values, made.data[INTEGRATION, 0, :, 0])
    np.testing.assert_allclose(found.residual.values, found.noise.values, atol=1e-10)
    np.testing.assert_allclose(found.noise.values, (made.corruption[0] * made.noise[INTEGRATION, 0])[:, 0])


def test_baselines_are_rms_over_time_of_the_products(made):
    spectra = shown("baselines", made.job("calibration", "data", "noise", baselines=[[0, 3], [1, 2]]))
    pairs = antenna_pairs(made.template).tolist()
    for item, pair in zip(spectra, ([0, 3], [1, 2]), strict=True):
        index = pairs.index(pair)
        assert item.antennas == tuple(pair)
        for name, cube in (("data", made.data), ("noise", made.noise), ("residual", made.residual)):
            expected = _rms_transform(cube[:, index, :, 0], made.template.freq_array)
            np.testing.assert_allclose(getattr(item, name), expected, rtol=1e-9)
        model = made.corruption[index] * made.foregrounds[:, index]
        np.testing.assert_allclose(item.model, _rms_transform(model[..., 0], made.template.freq_array), rtol=1e-9)
    assert spectra[0].uncorrupted is None


def _rms_transform(spectra: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """The sum over channels written out, with the Blackman-Harris window from its definition."""
    count, width = frequency.size, np.diff(frequency).mean()
    angle = 2 * np.pi * np.arange(count) / (count - 1)
    taper = 0.35875 - 0.48829 * np.cos(angle) + 0.14128 * np.cos(2 * angle) - 0.01168 * np.cos(3 * angle)
    delay = np.arange(-(count // 2), count - count // 2) / (count * width)
    kernel = np.exp(2j * np.pi * delay[:, None] * frequency)
    transform = width * (spectra * taper) @ kernel.T
    return np.sqrt(np.mean(np.abs(transform) ** 2, axis=0))


def test_baselines_chosen_by_themselves_go_from_short_to_long(made):
    layout = make_layout(MwaLayout())
    places = spread_in_length(layout, 4)
    lengths = [np.linalg.norm(layout.enu[b] - layout.enu[a]) for a, b in places]
    assert len(set(places)) == 4
    assert lengths == sorted(lengths)
    assert lengths[0] < 40 < 90 < lengths[-1]


def test_baselines_are_read_in_the_order_asked_for(made):
    pairs = [(2, 5), (0, 1)]
    found = read_spectra(made.folders["data"] / "data.uvh5", pairs)
    indices = [antenna_pairs(made.template).tolist().index(list(pair)) for pair in pairs]
    expected = np.moveaxis(made.data[..., 0][:, indices], 1, 0)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_an_integration_without_solution_is_refused(made, tmp_path):
    other = Products(tmp_path)
    gains = np.ones((7, 16, 3, 1), complex)
    flags = np.zeros(gains.shape, bool)
    flags[:, :, INTEGRATION] = True
    other.write_fit(gains, flags)
    with pytest.raises(InputError, match=r"outputs\.inspect\.integration = 1"):
        shown("gains", other.job("gains", "calibration"))


@pytest.mark.parametrize("name", ["layout", "gains", "model", "data", "baselines", "reflections"])
def test_every_figure_leaves_picture_and_arrays(made, tmp_path, name):
    job = made.job(*made.folders, baselines=None)
    own = {key: value for key, value in job.settings.items() if key != "notes"}
    Draw(name, figure=FIGURES.make(name), notes=[], own=own, products=job.inputs).make(tmp_path)
    assert {path.suffix for path in tmp_path.iterdir()} == {".png", ".pdf", ".npz"}
    if name == "reflections":
        with np.load(tmp_path / "reflections.npz") as arrays:
            np.testing.assert_array_equal(arrays["values"], made.true)
