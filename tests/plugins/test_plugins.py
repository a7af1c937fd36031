"""Calibrators and skies of one's own: what they are given, what becomes of what they return, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from pyuvdata import UVCal
from tiny import tiny

from calstudy.calibrate.own import calibrate_with
from calstudy.errors import ExperimentError, InputError
from calstudy.experiment.files import load, override
from calstudy.graph.tasks import Graph
from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.telescope import make_template
from calstudy.plugins import Plugin, load_function
from calstudy.running.runs import run
from calstudy.running.store import Store
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.sky.settings import CodeSources
from calstudy.stages.files import read_visibilities
from calstudy.visibilities import from_cube, to_cube

OWN_CODE = Path(__file__).parents[2] / "notebooks" / "own_code.py"
CODE = '''
import numpy as np
from calstudy.gains import make_uvcal

def known(data, sky_model, scale=1.0, antennas=None):
    """Return gains that the channel alone decides."""
    shape = (data.telescope.Nants, data.Nfreqs, 1, data.Npols)
    return make_uvcal(data, scale * np.broadcast_to(np.arange(1, data.Nfreqs + 1)[:, None, None] + 0j, shape)), None

def pair_of_nothing(data, sky_model):
    return None, None

def spoiling(data, sky_model):
    data.data_array[:] = 0
    sky_model.data_array[:] = 0
    return known(data, sky_model)

def wrong_model(data, sky_model):
    return known(data, sky_model)[0], sky_model.select(freq_chans=[0], inplace=False)

def zero(data, sky_model):
    return known(data, sky_model, scale=0.0)

def multiplying(data, sky_model):
    gains, model = known(data, sky_model)
    gains.gain_convention = "multiply"
    return gains, model

def flagged(data, sky_model):
    gains, model = known(data, sky_model)
    gains.flag_array[0, 3] = True
    return gains, model
'''


@pytest.fixture
def code(tmp_path) -> Path:
    path = tmp_path / "code.py"
    path.write_text(CODE)
    return path


@pytest.fixture(scope="module")
def measured():
    """Visibilities of a hexagon, random, and a sky model that is something else."""
    instrument = {**tiny(Path())["instrument"], "channels": {"first": "170 MHz", "width": "400 kHz", "count": 8}}
    template = make_template(InstrumentSettings.model_validate(instrument))
    rng = np.random.default_rng(1)
    shape = (template.Ntimes, template.Nbls, template.Nfreqs, template.Npols, 2)
    return tuple(from_cube(template, rng.standard_normal(shape) @ (1, 1j)) for _ in range(2))


def plugin(path: Path, function: str, **options) -> Plugin:
    return Plugin(path=path, function=function, options=options)


def test_the_residual_is_the_calibrated_data_less_the_model(code, measured):
    data, sky_model = measured
    result = calibrate_with(plugin(code, "known", scale=2.0), data, sky_model)
    channel = 2.0 * np.arange(1, data.Nfreqs + 1)[:, None]
    np.testing.assert_allclose(to_cube(result.residual), to_cube(data) / channel**2 - to_cube(sky_model), rtol=1e-12)
    np.testing.assert_array_equal(to_cube(result.model), to_cube(sky_model))
    assert result.gains.gain_array.shape == (data.telescope.Nants, data.Nfreqs, data.Ntimes, 1)
    assert [record.status for record in result.solutions] == ["converged"] * data.Ntimes


def test_the_function_gets_copies(code, measured):
    data, sky_model = (uvd.copy() for uvd in measured)
    calibrate_with(plugin(code, "spoiling"), data, sky_model)
    assert (data, sky_model) == measured


def test_flagged_gains_flag_what_they_calibrate(code, measured):
    data, sky_model = measured
    result = calibrate_with(plugin(code, "flagged"), data, sky_model)
    flags = result.residual.flag_array.reshape(data.Ntimes, data.Nbls, data.Nfreqs)
    first = data.ant_1_array[: data.Nbls] == data.telescope.antenna_numbers[0]
    assert flags[:, first, 3].all()
    assert flags.sum() == data.Ntimes * first.sum()
    assert np.isfinite(result.residual.data_array).all()


@pytest.mark.parametrize(
    ("function", "told"),
    [
        ("pair_of_nothing", "pair_of_nothing of code.py: must return the pair"),
        ("wrong_model", "the model must be a UVData with the samples of the data"),
        ("zero", "gains that are zero or not finite"),
        ("multiplying", "convention 'multiply'; it must be 'divide'"),
        ("absent", r"function = 'absent': not a function of code.py \(it has: known, "),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(code, measured, function, told):
    with pytest.raises(InputError, match=told):
        calibrate_with(plugin(code, function), *measured)


def test_without_any_model_there_is_no_residual(code, measured):
    with pytest.raises(InputError, match="returns no model, and there is no sky model"):
        calibrate_with(plugin(code, "known"), measured[0], None)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"calibrator": "code"}, "calibration.code: goes with calibrator: code, and that needs it"),
        ({"code": {"path": "code.py", "function": "known"}}, "calibration.code: goes with calibrator: code"),
        (
            {"calibrator": "code", "code": {"path": "no.py", "function": "f"}},
            "calibration.code.path = 'no.py': no such",
        ),
        (
            {"calibrator": "code", "code": {"path": "code.py", "function": "f"}},
            "not a function of code.py (it has: kno",
        ),
        ({"calibrator": "code", "code": {"path": "bad.py", "function": "f"}}, "not valid Python (line 1:"),
        (
            {"calibrator": "code", "code": {"path": "code.py", "function": "known", "options": {"path": "x"}}},
            "calibration.code.options.path: has a name that is kept",
        ),
    ],
)
def test_an_experiment_tells_before_it_starts(code, changes, told):
    (code.parent / "bad.py").write_text("def f(:\n")
    path = code.parent / "own.yaml"
    path.write_text(yaml.safe_dump({**tiny(code.parent), "calibration": changes}))
    with pytest.raises(ExperimentError) as caught:
        load(path)
    assert any(told in sentence for sentence in caught.value.faults), caught.value.faults


def test_a_changed_file_or_option_is_another_product_and_calamity_keeps_its_own(code):
    path = code.parent / "own.yaml"
    own = {"calibrator": "code", "code": {"path": "code.py", "function": "known"}}

    def key(calibration) -> str:
        path.write_text(yaml.safe_dump({**tiny(code.parent), "calibration": calibration}))
        return Graph(load(path)).power("residual").key

    first = key(own)
    assert key(own) == first
    assert key({**own, "code": {**own["code"], "options": {"scale": 2.0}}}) != first
    code.write_text(CODE + "\n# changed\n")
    assert key(own) != first
    assert "code" not in Graph(load_plain(path)).sections["calibration"]


def load_plain(path: Path):
    path.write_text(yaml.safe_dump(tiny(path.parent)))
    return load(path)


def test_a_sky_of_ones_own(tmp_path):
    frequencies = np.linspace(170e6, 180e6, 4)
    source = CodeSources(kind="code", path=OWN_CODE, function="few_bright", options={"count": 7})
    found = make_foregrounds(source, frequencies)
    assert found.sky.Ncomponents == 7
    assert found.stand_in == "foregrounds: 7 sources by few_bright of own_code.py"
    flux = found.sky.at_frequencies(found.sky.reference_frequency[:1], inplace=False).stokes[0, 0].to_value("Jy")
    np.testing.assert_allclose(flux, 100 * (1 + np.arange(7)) ** -0.7)
    other = tmp_path / "sky.py"
    other.write_text("def sky(frequencies):\n    return frequencies\n")
    with pytest.raises(InputError, match="must return a pyradiosky SkyModel of points"):
        make_foregrounds(CodeSources(kind="code", path=other, function="sky"), frequencies)


def test_the_notebooks_calibrator_finds_the_gains(measured):
    """Without noise, and up to the phase that no visibility tells."""
    _, sky_model = measured
    rng = np.random.default_rng(2)
    shape = (sky_model.telescope.Nants, sky_model.Nfreqs, sky_model.Ntimes, 1)
    true = 1 + 0.2 * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    names = sky_model.telescope.antenna_numbers
    first, second = (np.searchsorted(names, array) for array in (sky_model.ant_1_array, sky_model.ant_2_array))
    time = np.repeat(np.arange(sky_model.Ntimes), sky_model.Nbls)
    data = sky_model.copy()
    data.data_array = data.data_array * true[first, :, time] * true[second, :, time].conj()
    function = load_function(plugin(OWN_CODE, "sky_based"))
    gains, _ = function(data, sky_model.copy(), rounds=400)
    assert isinstance(gains, UVCal)
    turn = np.exp(-1j * np.angle((gains.gain_array * true.conj()).sum(axis=0)))
    np.testing.assert_allclose(gains.gain_array * turn, true, atol=1e-6)


def test_a_study_of_own_code_runs_and_plays_no_part_of_the_papers(tmp_path):
    data = override(tiny(tmp_path), "calibration", {"calibrator": "code", "chunks": 2})
    data = override(data, "calibration.code", {"path": str(OWN_CODE), "function": "sky_based"})
    data = override(data, "sky.foregrounds", {"kind": "code", "path": str(OWN_CODE), "function": "few_bright"})
    data = override(data, "outputs.figures", [])
    path = tmp_path / "own.yaml"
    path.write_text(yaml.safe_dump(data))
    experiment = load(path)
    result = run(experiment)
    assert '"verdict": "PASS"' not in (result.folder / "claims.json").read_text()
    assert "sky: own_code.py, not GLEAM" in (result.folder / "manifest.json").read_text()
    graph, store = Graph(experiment), Store(experiment.outputs.store)
    task = graph.calibration(experiment.variants["residual_without_eor"], "even")
    folder = store.find(task.stage, task.key).path
    noise = graph.data(experiment.variants["noise"], "even")
    residual, thermal = (
        read_visibilities(path)
        for path in (folder / "residual.uvh5", store.find(noise.stage, noise.key).path / "data.uvh5")
    )
    # The sky model is the truth, so that what is left is the noise less what the gains absorb of it.
    ratio = np.std(residual.data_array) / np.std(thermal.data_array)
    assert 0.4 < ratio < 1.0
