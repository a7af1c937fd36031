"""What the calibrator takes for granted: another sky or instrument than the true one, or visibilities from a file."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from astropy.table import Table
from pyuvdata import UVCal, UVData
from rich.console import Console
from tiny import load, tiny

from calstudy.base.errors import InputError
from calstudy.base.visibilities import from_cube, to_cube
from calstudy.calibrate.sky_model import read_sky_model
from calstudy.experiment.files import dump, override, validate
from calstudy.instrument.telescope import make_template
from calstudy.products import calibration, simulation, sky_model
from calstudy.products.graph import Graph
from calstudy.report.page import read_contents
from calstudy.results.reader import RunFolder
from calstudy.run.execution import Workers
from calstudy.run.store import Store
from calstudy.run.task import Task
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.kinds.sweep import Sweep
from calstudy.studies.load import load_study
from calstudy.studies.preflight import require_calibration
from calstudy.studies.study import Budget, Run, RunProducts, make, run_study

RESIDUAL = "residual"


def sky_based(folder: Path, **assumed: object) -> dict:
    """Gains alone, without noise and EoR: nothing but an error of the sky model can keep them from the truth."""
    data = override(tiny(folder), "corruption.noise", "none")
    data = override(data, "variants", {RESIDUAL: {"components": ["foregrounds"], "effects": True, "calibrate": True}})
    data = override(data, "outputs.figures", [])
    return override(data, "calibration", {"calibrator": "sky-based", "chunks": 1, "assumed": assumed})


def graph_of(data: dict, folder: Path) -> Graph:
    return Graph(validate(data, folder))


def calibrated(graph: Graph) -> Task:
    return calibration.calibration(graph, graph.experiment.variants[RESIDUAL], "even")


def make_here(folder: Path, *tasks: Task) -> RunProducts:
    console = Console(file=io.StringIO())
    return make(tasks, Store(folder / "store"), Workers(1, folder / "run.log"), console)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, shared_store) -> Path:
    folder = tmp_path_factory.mktemp("assumed")
    (folder / "store").symlink_to(shared_store)
    return folder


def gains_of(folder: Path, **assumed: object) -> np.ndarray:
    task = calibrated(graph_of(sky_based(folder, **assumed), folder))
    return UVCal.from_file(make_here(folder, task).products[task.key].path / "gains.calh5").gain_array


def test_with_nothing_assumed_the_sky_model_is_the_true_foregrounds(folder):
    graph = graph_of(sky_based(folder), folder)
    assert sky_model.sky_model(graph) is simulation.foregrounds(graph)
    assert sky_model.is_perfect(graph)
    assert sky_model.error(graph) is None
    assert sky_model.described(graph) == "perfect: the calibrator is given the true foregrounds"


def test_what_is_assumed_as_it_is_changes_no_product(folder):
    perfect, same = (
        graph_of(sky_based(folder, **assumed), folder)
        for assumed in ({}, {"sky.foregrounds.count": 100, "instrument.beam": "gaussian"})
    )
    assert calibrated(same).key == calibrated(perfect).key
    assert sky_model.is_perfect(same)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("sky.foregrounds.flux_limit", "10 Jy"),
        ("sky.foregrounds.errors.flux_scale", 1.02),
        ("instrument.beam", {"kind": "gaussian", "fwhm_deg": 23.0}),
        ("instrument.beam", "mwa-analytic"),
        ("instrument.layout.spacing", "14.1 m"),
        ("instrument.antenna_beams", {"one": {"antennas": [0], "beam": "airy"}}),
    ],
)
def test_only_the_sky_model_is_another(folder, path, value):
    true = graph_of(sky_based(folder), folder)
    graph = graph_of(sky_based(folder, **{path: value}), folder)
    task, before = calibrated(graph), calibrated(true)
    chunk, chunk_before = task.inputs["chunk000"], before.inputs["chunk000"]
    assert task.key != before.key
    assert chunk.inputs["data"].key == chunk_before.inputs["data"].key
    assert chunk.inputs["sky_model"].key != chunk_before.inputs["sky_model"].key
    assert simulation.foregrounds(graph).key == simulation.foregrounds(true).key
    assert not sky_model.is_perfect(graph)
    # The same field in the experiment itself gives the very simulation that is assumed here.
    other = graph_of(override(sky_based(folder), path, value), folder)
    assert simulation.foregrounds(other).key == chunk.inputs["sky_model"].key


def test_a_block_without_kind_stands_for_its_fields(folder):
    nested = {"sky": {"foregrounds": {"count": 50, "errors": {"flux_scale": 1.1}}}}
    dotted = {"sky.foregrounds.count": 50, "sky.foregrounds.errors.flux_scale": 1.1}
    keys = {calibrated(graph_of(sky_based(folder, **assumed), folder)).key for assumed in (nested, dotted)}
    assert len(keys) == 1
    for data in (sky_based(folder), sky_based(folder, **{"sky.foregrounds.count": 60})):
        changed = override(data, "calibration.assumed.sky.foregrounds.count", 50)
        assert validate(changed, folder).calibration.assumed == {"sky.foregrounds.count": 50}


def test_the_resolved_file_reads_back_the_same(folder):
    experiment = validate(sky_based(folder, **{"sky.foregrounds.errors.position_scatter": "10 arcsec"}), folder)
    (folder / "resolved.yaml").write_text(dump(experiment))
    assert load(folder / "resolved.yaml") == experiment


@pytest.mark.chain
def test_a_file_of_the_assumed_visibilities_gives_the_same_gains(folder):
    assumed = {"sky.foregrounds.count": 60}
    task = sky_model.sky_model(graph_of(sky_based(folder, **assumed), folder))
    visibilities = UVData.from_file(make_here(folder, task).products[task.key].path / "visibilities.uvh5")
    # As others would write it: baselines the other way round, by baseline, and more channels and antennas than needed.
    visibilities.conjugate_bls("ant2<ant1")
    visibilities.reorder_blts(order="baseline", minor_order="time")
    visibilities.write_uvh5(folder / "model.uvh5", clobber=True)
    simulated, read = gains_of(folder, **assumed), gains_of(folder, sky_model="model.uvh5")
    np.testing.assert_array_equal(simulated, read)
    assert np.abs(simulated - gains_of(folder)).max() > 1e-3


def test_sky_based_gains_follow_a_flux_scale_as_its_square_root(folder):
    """g_a g_b* (s F) = V has the solution g = g_true / sqrt(s): all else is as with the true fluxes."""
    right, wrong = gains_of(folder), gains_of(folder, **{"sky.foregrounds.errors.flux_scale": 1.1})
    np.testing.assert_allclose(np.abs(wrong), np.abs(right) / np.sqrt(1.1), rtol=1e-4)


@pytest.mark.chain
def test_what_the_sky_model_lacks_is_left_over_far_above_the_eor(folder):
    """Without 300 of 5000 sources 7 % of the rms are missing; the EoR of these studies is at 1e-4 of it."""

    def left_over(**assumed: object) -> tuple[float, float]:
        """Return the rms of the residual and the error of the sky model, over the rms of the true foregrounds."""
        graph = graph_of(override(sky_based(folder, **assumed), "sky.foregrounds.count", 5000), folder)
        tasks = (simulation.foregrounds(graph), sky_model.sky_model(graph), calibrated(graph))
        products = make_here(folder, *tasks).products
        files = ("visibilities.uvh5", "visibilities.uvh5", "residual.uvh5")
        true, model, residual = (
            to_cube(UVData.from_file(products[task.key].path / file)) for task, file in zip(tasks, files, strict=True)
        )
        return tuple(float(np.linalg.norm(cube) / np.linalg.norm(true)) for cube in (residual, model - true))

    complete, nothing = left_over()
    lacking, error = left_over(**{"sky.foregrounds.count": 4700})
    assert nothing == 0
    assert error == pytest.approx(0.07, abs=0.02)
    # Data and models are stored in single precision.
    assert complete < 1e-5
    # Seven gains of 21 baselines take a part of it up, and not the most.
    assert 0.3 * error < lacking < 1.5 * error
    assert lacking > 100 * 1e-4


def test_emission_that_is_not_assumed_is_missing_from_the_sky_model(folder):
    """Its visibilities are those of the map alone: the truth is the sum of sources and map."""
    data = override(sky_based(folder, **{"sky.diffuse": "none"}), "sky.diffuse", {"kind": "synthetic", "nside": 16})
    graph, alone = graph_of(data, folder), graph_of(override(data, "sky.foregrounds", "none"), folder)
    tasks = (simulation.foregrounds(graph), sky_model.sky_model(graph), simulation.foregrounds(alone))
    assert tasks[1].key == simulation.foregrounds(graph_of(sky_based(folder), folder)).key
    products = make_here(folder, *tasks).products
    true, model, emission = (to_cube(UVData.from_file(products[task.key].path / "visibilities.uvh5")) for task in tasks)
    assert np.abs(true - model - emission).max() < 1e-7 * np.abs(emission).max()
    assert np.abs(emission).max() > 0.1 * np.abs(model).max()
    warnings = products[tasks[0].key].record["notes"]["warnings"]
    assert any("raise sky.diffuse.nside" in text for text in warnings)
    ((path, emitting, assumed),) = sky_model.differences(graph)
    assert (path, assumed) == ("sky.diffuse", "none")
    assert emitting.startswith("synthetic (spectral_index -2.55, nside 16, frequency 180000000.0 Hz, ")


def test_a_plan_counts_the_pixels_of_a_map(folder):
    def seconds(count: int, **diffuse: object) -> float:
        data = override(sky_based(folder), "sky.foregrounds.count", count)
        data = override(data, "sky.diffuse", diffuse or "none")
        return sum(piece.cost.seconds for piece in simulation.foregrounds(graph_of(data, folder)).pieces.values())

    assert seconds(5000, kind="haslam", nside=128) == pytest.approx(seconds(196_608 + 5000), rel=1e-6)
    assert seconds(5000, kind="haslam", nside=128) > 1.1 * seconds(5000)


@pytest.fixture(scope="module")
def finished(folder) -> Run:
    data = sky_based(folder, **{"sky.foregrounds.count": 60})
    return run_study(ExperimentStudy(validate(data, folder)), Budget(workers=1), Console(file=io.StringIO()))


def test_a_run_says_what_was_assumed(finished):
    told = "assumed: sky.foregrounds.count = 60, where 100 is true"
    assert json.loads((finished.folder / "manifest.json").read_text())["sky_model"] == told
    contents = read_contents(RunFolder(finished.folder))
    assert contents.facts["sky model of the calibrator"] == told
    assert told in next(table for table in contents.tables if table.title == "Solver convergence").note
    lines = (finished.folder / "tables" / "sky-model.csv").read_text().splitlines()
    assert lines == [f"# sky model: {told}", "field,true,assumed", "sky.foregrounds.count,100,60"]
    assert json.loads((finished.folder / "tables" / "sky-model.json").read_text())["relative_error"] > 0


def test_a_run_says_that_its_sky_model_is_perfect(folder):
    study = ExperimentStudy(validate(sky_based(folder), folder))
    run = run_study(study, Budget(workers=1), Console(file=io.StringIO()))
    assert read_contents(RunFolder(run.folder)).facts["sky model of the calibrator"].startswith("perfect: ")
    assert "perfect" in (run.folder / "tables" / "sky-model.csv").read_text()


@pytest.mark.chain
def test_a_run_says_how_its_antennas_are_built(folder):
    data = override(sky_based(folder), "instrument.as_built", {"positions": {"scatter": "2 cm"}})
    experiment = validate(data, folder)
    run = run_study(ExperimentStudy(experiment), Budget(workers=1), Console(file=io.StringIO()))
    table = Table.read(run.folder / "tables" / "as-built.csv", format="ascii.csv")
    nominal, true = (make_template(experiment.instrument, as_built=built).telescope for built in (False, True))
    assert list(table["number"]) == list(nominal.antenna_numbers)
    offsets = np.column_stack([table[name] for name in ("east_m", "north_m", "up_m")])
    # The table has micrometres, and positions of telescopes are differences of geocentric ones.
    np.testing.assert_allclose(nominal.get_enu_antpos() + offsets, true.get_enu_antpos(), atol=1e-5)
    assert np.std(offsets) > 0.01
    assert set(table["dipoles_x"]) == {" ".join(16 * "1")}
    assert set(table["width"]) == {1.0}


def test_the_store_shares_simulations_between_experiments(finished, folder):
    """What one experiment assumes is the truth of another."""
    data = override(sky_based(folder), "sky.foregrounds.count", 60)
    task = simulation.foregrounds(graph_of(data, folder))
    assert make_here(folder, task).tasks == ()


def test_a_plan_counts_the_assumed_simulation(folder):
    def simulations(**assumed: object) -> int:
        tasks = ExperimentStudy(validate(sky_based(folder, **assumed), folder)).tasks
        return sum(task.stage.name == "simulate" for task in tasks)

    assert (simulations(), simulations(**{"sky.foregrounds.count": 30})) == (2, 3)
    assert simulations(**{"sky.foregrounds.count": 100}) == 2


def test_what_is_assumed_can_be_swept(folder):
    data = override(tiny(folder), "sweep", {"calibration.assumed.sky.foregrounds.count": [30, 60]})
    (folder / "sweep.yaml").write_text(yaml.safe_dump(data))
    study = load_study(folder / "sweep.yaml")
    assert isinstance(study, Sweep)
    models = [sky_model.differences(part.graph) for part in study.parts.values()]
    assert models == [[("sky.foregrounds.count", "100", count)] for count in ("30", "60")]
    assert sum(task.label == "foregrounds" for task in study.tasks) == 1


def test_the_variants_and_their_noise_keep_the_true_levels(folder):
    """The levels of EoR and noise are relative to the truth."""
    keys = set()
    for assumed in ({}, {"sky.foregrounds.count": 60}):
        data = override(tiny(folder), "calibration.assumed", assumed)
        study = ExperimentStudy(validate(data, folder))
        keys.add(next(task.key for task in study.tasks if task.stage.name == "levels"))
        agreement = next(task for task in study.tasks if task.stage.name == "agreement")
        assert agreement.inputs["foregrounds"].key == simulation.foregrounds(study.graph).key
    assert len(keys) == 1


@pytest.mark.parametrize(
    ("assumed", "told"),
    [
        (
            {"sky.foregrounds.flux_limt": "1 Jy"},
            "sky.foregrounds.flux_limt: unknown key, did you mean 'flux_limit'",
        ),
        ({"sky.foregrounds.flux_limit": 1}, "assumed.sky.foregrounds.flux_limit: 1 has no unit"),
        ({"sky.foregrounds.flux_limit": 1, "instrument.beam": "arye"}, "assumed.instrument.beam: 'arye' is not a beam"),
        ({"power.taper": "hann"}, "assumed.power.taper: is not a field of the sky or the instrument"),
        ({"instrument": {}}, "assumed.instrument: is not a field of the sky or the instrument"),
        ({"sky.eor.seed": 3}, "assumed.sky.eor.seed: has no effect"),
        ({"instrument.channels.count": 16}, "assumed.instrument.channels: must be that of the data"),
        ({"instrument.times.start_lst": "2 h"}, "assumed.instrument.times: must be that of the data"),
        ({"instrument.polarizations": ["yy"]}, "assumed.instrument.polarizations: must be that of the data"),
        ({"sky_model": "nowhere.uvh5"}, "assumed.sky_model = 'nowhere.uvh5': no such file"),
        ({"sky_model": 3}, "assumed.sky_model = 3: must be a path"),
        ({"sky_model": "a.uvh5", "instrument.beam": "airy"}, "assumed.sky_model: stands for the whole sky model"),
        (
            {"sky.foregrounds": {"kind": "file", "path": "no.skyh5"}},
            "assumed.sky.foregrounds.path = 'no.skyh5'",
        ),
        (
            {"sky.foregrounds.count": 1, "sky": {"foregrounds": {"count": 2}}},
            "assumed.sky.foregrounds.count: is given twice",
        ),
        (
            {"instrument.antenna_beams": {"far": {"antennas": [7], "beam": "airy"}}},
            "assumed.instrument.antenna_beams.far.antennas: names antenna 7",
        ),
    ],
)
def test_wrong_assumptions_are_refused_in_a_sentence(folder, assumed, told):
    with pytest.raises(InputError) as caught:
        validate(sky_based(folder, **assumed), folder)
    assert told in str(caught.value)
    assert all(line.startswith("calibration.assumed.") for line in str(caught.value).splitlines())


def test_every_wrong_assumption_is_told(folder):
    with pytest.raises(InputError) as caught:
        validate(sky_based(folder, **{"sky.foregrounds.count": 0, "instrument.beam": "arye"}), folder)
    assert len(str(caught.value).splitlines()) == 2


LAYOUTS = {
    "fewer": ("east_m,north_m,up_m\n0,0,0\n14,0,0\n0,28,0\n", "has 3 antennas; it must have the 7 of the data"),
    "others": (
        "east_m,north_m,up_m,number\n" + "".join(f"{14 * n},{3 * n * n},0,{n + 1}\n" for n in range(7)),
        "has antenna 1 where the data have 0",
    ),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_assumed_antennas_must_be_those_of_the_data(tmp_path, name):
    table, told = LAYOUTS[name]
    (tmp_path / "layout.csv").write_text(table)
    data = sky_based(
        tmp_path, **{"instrument.layout": {"kind": "csv", "path": "layout.csv"}, "instrument.location": "mwa"}
    )
    with pytest.raises(InputError, match=f"calibration.assumed.instrument.layout: {told}"):
        require_calibration(validate(data, tmp_path))


def test_a_calibrator_that_needs_a_sky_model_is_refused_without_one(folder):
    experiment = validate(sky_based(folder, **{"sky.foregrounds": "none"}), folder)
    with pytest.raises(InputError, match="needs a sky model"):
        require_calibration(experiment)
    assert sky_model.described(Graph(experiment)) == "none: the calibrator is given no sky model"


@pytest.mark.parametrize("fault", ["flagged", "lacking"])
def test_a_file_that_does_not_cover_the_data_is_refused(folder, tmp_path, fault):
    task = simulation.foregrounds(graph_of(sky_based(folder), folder))
    uvd = UVData.from_file(make_here(folder, task).products[task.key].path / "visibilities.uvh5")
    if fault == "flagged":
        uvd.flag_array[3, 2] = True
    else:
        uvd.select(freq_chans=np.arange(1, uvd.Nfreqs))
    uvd.write_uvh5(tmp_path / "model.uvh5")
    told = {"flagged": "1 samples are flagged or not finite", "lacking": "lacks channels of the data"}[fault]
    with pytest.raises(InputError, match=told):
        read_sky_model(tmp_path / "model.uvh5", make_template(validate(sky_based(folder), folder).instrument))


def test_a_file_is_brought_to_the_order_of_the_data(tmp_path):
    """Antenna numbers of a layout may come in any order; pyuvdata sorts baselines by them."""
    (tmp_path / "layout.csv").write_text("east_m,north_m,up_m,number\n0,0,0,3\n14,0,0,1\n0,28,0,7\n40,9,0,2\n")
    data = override(tiny(tmp_path), "instrument.layout", {"kind": "csv", "path": "layout.csv"})
    data = override(data, "instrument.location", "mwa")
    template = make_template(validate(data, tmp_path).instrument)
    shape = (template.Ntimes, template.Nbls, template.Nfreqs, template.Npols)
    normal = np.random.default_rng(1).standard_normal((2, *shape))
    written = from_cube(template, normal[0] + 1j * normal[1])
    written.conjugate_bls("ant1<ant2")
    written.reorder_blts(order="time", minor_order="baseline")
    written.write_uvh5(tmp_path / "model.uvh5")
    found = read_sky_model(tmp_path / "model.uvh5", template)
    np.testing.assert_allclose(to_cube(found), normal[0] + 1j * normal[1], rtol=1e-12)
    assert np.array_equal(found.ant_1_array, template.ant_1_array)
