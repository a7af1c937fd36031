"""The Python interface returns what the files of a run hold, with labels and units."""

import errno
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from astropy import units
from astropy.cosmology import units as cosmology_units
from matplotlib.figure import Figure
from tiny import tiny

import calstudy
from calstudy.base.errors import ExperimentError, InputError
from calstudy.experiment.model import Folders
from calstudy.power.spectra import CylindricalSpectrum, SphericalSpectrum
from calstudy.power.tables import load_spectrum
from calstudy.products.calibration import Calibrate
from calstudy.report.headline import read_signal
from calstudy.report.page import write_report
from calstudy.results.reader import RunFolder


@pytest.fixture(scope="module")
def file(tmp_path_factory, shared_store):
    folder = tmp_path_factory.mktemp("interface")
    (folder / "store").symlink_to(shared_store)
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump(tiny(folder)))
    return path


@pytest.fixture(scope="module")
def run(file):
    return calstudy.load(file, **{"outputs.figures": ["wedge", "signal-loss"]}).run(workers=1, quiet=True)


def test_a_run_has_its_own_products_after_a_change_of_code(run, monkeypatch):
    made = run.gains()
    monkeypatch.setattr(Calibrate, "stage", Calibrate.stage._replace(version=Calibrate.stage.version + 1))
    assert calstudy.open_run(run.folder).gains() == made


def test_the_import_is_light():
    code = "import sys, calstudy; print(sorted({'numpy', 'pydantic', 'astropy', 'matplotlib'} & set(sys.modules)))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


def test_changes_are_fields_and_faults_are_reported_together(file):
    study = calstudy.load(file, **{"instrument.times.count": 3, "power.wedge_buffer": "250 ns"})
    assert study.experiment.instrument.times.count == 3
    assert study.experiment.power.wedge_buffer == pytest.approx(250e-9)
    with pytest.raises(ExperimentError) as raised:
        calstudy.load(file, **{"instrument.times.count": -1, "calibration.bsis": 1})
    assert len(raised.value.faults) == 2


def test_numbers_of_numpy_and_paths_are_plain_ones(file, tmp_path):
    changes = {"instrument.times.count": np.int64(3), "power.wedge_buffer": "250 ns", "outputs.runs": tmp_path}
    study = calstudy.load(file, **changes)
    assert (study.experiment.instrument.times.count, study.experiment.outputs.runs) == (3, tmp_path)
    assert calstudy.load(file, **{"power.wedge_buffer": 250 * units.ns}).experiment.power.wedge_buffer == 250e-9
    plain = {"corruption.noise.factor": 3 * units.dimensionless_unscaled, "instrument.times.count": np.int64(3)}
    assert calstudy.load(file, **plain).experiment.corruption.noise.factor == 3
    content = yaml.safe_load(file.read_text())
    content["instrument"]["times"]["count"] = np.array([3, 4])[0]
    assert calstudy.load(content).experiment.instrument.times.count == 3
    with pytest.raises(InputError, match=r"power = .*a object cannot be in a file"):
        calstudy.load(file, power=object())


def test_wavenumbers_of_astropy_are_in_units_of_h(file):
    width = 0.08 * cosmology_units.littleh / units.Mpc
    assert calstudy.load(file, **{"power.bins.width": width}).experiment.power.bins.width == pytest.approx(0.08)


def positions(path, north):
    path.write_text(f"number,east_m,north_m,up_m\n0,0,0,0\n1,12,0,0\n2,26,{north},0\n3,45,-3,0\n")
    return {"kind": "csv", "path": str(path)}


@pytest.mark.parametrize("named_in", ["calibration.assumed", "sweep"])
def test_a_run_folder_is_that_of_the_content_of_files_that_are_named_by_their_paths_alone(tmp_path, named_in):
    true, other = positions(tmp_path / "true.csv", 2), positions(tmp_path / "other.csv", 2.5)
    value = [true, other] if named_in == "sweep" else other
    changes = {"instrument.layout": true, "instrument.location": "mwa", named_in: {"instrument.layout": value}}

    def folder():
        return calstudy.load("quickstart", **changes).folder

    # A text that is no field of files may name one.
    changes["description"] = str(tmp_path)
    before = folder()
    (tmp_path / "notes").write_text("of no study")
    assert folder() == before
    positions(tmp_path / "other.csv", 3)
    assert folder() != before


def test_a_variant_is_added_to_those_of_every_experiment():
    def variants(**changes):
        return calstudy.load("quickstart", **{"outputs.figures": ["layout"]}, **changes).experiment.variants

    added, usual = variants(**{"variants.mine": {"components": ["eor", "noise"]}}), variants()
    assert added == usual | {"mine": added["mine"]}
    changed = variants(**{"variants.residual.calibrate": False})
    assert (changed["residual"].calibrate, changed["residual"].effects) == (False, usual["residual"].effects)


def test_an_opened_run_is_found_from_any_folder(run, monkeypatch, tmp_path):
    monkeypatch.chdir(run.folder.parent)
    opened = calstudy.open_run(run.folder.name)
    monkeypatch.chdir(tmp_path)
    assert opened.spectra["residual"].identical(run.spectra["residual"])


def test_every_array_has_its_unit(run):
    found = run.spectra["residual"]
    assert all("units" in found[name].attrs for name in (*found.data_vars, *found.coords))
    assert found["n_modes"].attrs["units"] == run.transfer["transfer"].attrs["units"] == ""


def test_a_dictionary_is_the_content_of_a_file(file):
    study = calstudy.load(yaml.safe_load(file.read_text()))
    assert study.folder == calstudy.load(file).folder


def test_a_plan_is_a_table_and_a_mapping(file):
    plan = calstudy.load(file).plan(workers=1)
    assert "plan for 1 worker(s)" in repr(plan)
    assert plan.stages.loc["calibrate", "products"] == 4


@pytest.mark.parametrize(
    "budget",
    [{"workers": 0}, {"workers": "2"}, {"max_memory": 6}, {"scheduler": "nonsense"}, {"scheduler": 300 * "long"}],
)
def test_a_budget_that_is_none_is_refused(file, budget):
    with pytest.raises(InputError, match=f"{next(iter(budget))} = .*must be"):
        calstudy.load(file).run(**budget)


def test_arguments_of_other_types_are_named(tmp_path):
    with pytest.raises(InputError, match=r"^source = 3: must be of the type str \| Path \| Mapping"):
        calstudy.load(3)
    with pytest.raises(InputError, match=r"^scale = 3: must be of the type str \| None$"):
        calstudy.load("quickstart", scale=3)
    with pytest.raises(InputError, match=r"^data = 5: must be of the type str \| Path \| Iter"):
        calstudy.calibrate_data(5)
    with pytest.raises(InputError, match=r"^observed = 'x': must be of the type Mapping\[str, Any\] \| None$"):
        calstudy.calibrate_data(tmp_path / "x", observed="x")
    with pytest.raises(InputError, match=r"^folder = None: must be of the type str \| Path$"):
        calstudy.open_run(None)
    with pytest.raises(TypeError, match="missing 1 required"):
        calstudy.load()


def test_spectra_are_those_of_the_tables(run):
    found = run.spectra["residual"]
    stored = load_spectrum(run.folder / "tables" / "residual.outside-wedge.h5", SphericalSpectrum)
    np.testing.assert_array_equal(found.power, stored.power)
    np.testing.assert_allclose(found.k, (found.k_from + found.k_to) / 2)
    assert found.power.attrs["units"] == "mK2 h-3 Mpc3"
    assert found.k.attrs["units"] == "h/Mpc"
    assert found.attrs["wedge_excluded"]
    with pytest.raises(KeyError, match="residual"):
        run.spectra["residuel"]


def test_the_example_of_the_page_compares_with_the_truth_without_a_unit(run):
    page = (Path(__file__).parents[1] / "docs" / "python.md").read_text(encoding="utf-8")
    *lines, last = re.findall(r"```python\n(.*?)```", page, re.DOTALL)[-1].splitlines()
    names = {"run": run}
    exec("\n".join(lines), names)
    assert np.isfinite(eval(last, names).item())
    assert names["pull"].attrs["units"] == ""
    assert names["pull"].k.attrs["units"] == "h/Mpc"


def test_cylindrical_spectra_have_lengths_and_delays(run):
    found = run.cylindrical["eor"]
    stored = load_spectrum(run.folder / "tables" / "eor.wedge.h5", CylindricalSpectrum)
    assert found.power.dims == ("baseline_length", "delay")
    np.testing.assert_array_equal(found.power, stored.power)
    # The horizon is at |b| / c, and k_perp is proportional to |b|.
    np.testing.assert_allclose(found.horizon_delay, found.baseline_length / 299_792_458.0)
    assert float((found.k_perp / found.baseline_length).std()) < 1e-12


def test_the_scores_are_the_headline_of_the_report(run):
    signal = read_signal(RunFolder(run.folder))
    band = run.scores.loc[(0.2, 0.5)]
    assert band.transfer == pytest.approx(signal.transfer)
    assert band.bias == pytest.approx(signal.bias)
    # T s^2 of the transfer function in fine bins, which the band pools, surrounds it.
    fine = run.transfer.sel(region="outside-wedge")
    inside = fine.scale_free_transfer[(fine.k > 0.2) & (fine.k < 0.5)]
    assert float(inside.min()) <= band.transfer <= float(inside.max())


def test_gains_and_visibilities_are_those_of_pyuvdata(run):
    true, fitted = run.gains("true"), run.gains("residual")
    assert fitted.Nants_data == true.Nants_data == 7
    # Gains of 10 % that follow the truth; free foregrounds of seven antennas leave half of the scatter open.
    ratio = np.abs(fitted.gain_array[..., 0] / true.gain_array[..., :1, 0])
    assert np.std(ratio) < 0.7 * np.std(np.abs(true.gain_array))
    data, residual = run.visibilities("uncalibrated"), run.visibilities("residual")
    assert np.abs(residual.data_array).std() < 0.1 * np.abs(data.data_array).std()
    with pytest.raises(InputError, match="'eor' is not calibrated"):
        run.gains("eor")


def test_the_error_of_a_difference_from_the_eor_has_no_sample_variance(run):
    spectrum = run.spectra["residual"]
    assert spectrum.difference_error.attrs["units"] == spectrum.noise_error.attrs["units"]
    assert (spectrum.noise_error <= spectrum.difference_error).all()
    assert (spectrum.difference_error < spectrum.noise_error + spectrum.sample_error).all()


def test_errors_of_gains_are_computed_from_the_products(run):
    gains, errors = run.gains("residual"), run.gain_errors("residual")
    assert errors.amplitude.dims == ("antenna", "frequency", "time", "feed")
    assert np.array_equal(np.isfinite(errors.phase.values), ~gains.flag_array)
    assert errors.phase.attrs["units"] == "rad"
    with pytest.raises(InputError, match="'eor' is not calibrated"):
        run.gain_errors("eor")


def test_figures_are_drawn_again(run):
    assert run.figures == ["signal-loss", "wedge"]
    assert isinstance(run.plot("wedge"), Figure)
    with pytest.raises(InputError, match="wedge"):
        run.plot("wedges")


def test_a_figure_that_is_drawn_again_leaves_nothing_in_the_folder_of_the_run(run):
    before = sorted(run.folder.rglob("*"))
    run.plot("signal-loss")
    assert sorted(run.folder.rglob("*")) == before


def test_the_store_is_found_from_any_working_directory(file, tmp_path, monkeypatch):
    monkeypatch.chdir(file.parent)
    run = calstudy.load(file, **{"outputs.store": "store", "outputs.runs": "of/runs"}).run(workers=1, quiet=True)
    found = calstudy.open_run(run.folder.resolve())
    monkeypatch.chdir(tmp_path)
    assert found.gains("true").Nants_data > 1
    assert not (tmp_path / "store").exists()


@pytest.mark.parametrize(
    ("error", "told"),
    [
        ((errno.ENOENT, "no", "{store}/figure/x"), "store/figure/x: was removed while the results were"),
        ((errno.ENOSPC, "No space left on device"), r"outputs\.runs: .* cannot be written \(No space left on device"),
        # Files of a user's own code are no results.
        ((errno.ENOENT, "no", "limits.csv"), None),
        (("my table: column 'k' is missing",), None),
    ],
)
def test_results_that_cannot_be_written_are_told_in_a_sentence(run, file, monkeypatch, error, told):
    failing = OSError(*(part.format(store=file.parent / "store") if isinstance(part, str) else part for part in error))

    def refuse(*_):
        raise failing

    monkeypatch.setattr("calstudy.studies.study.publish", refuse)
    with pytest.raises(InputError if told else OSError, match=told) as caught:
        calstudy.load(file).run(workers=1, quiet=True)
    assert told or caught.value is failing


def test_a_product_that_a_run_did_not_need_is_named_as_such(run, tmp_path):
    shutil.copytree(run.folder, tmp_path / "run")
    path = tmp_path / "run" / "manifest.json"
    manifest = json.loads(path.read_text())
    for entry in manifest["products"]:
        entry["key"] = "0" * 32
    path.write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=r"gains \(true gains\): .*, or was made by another version; start Python in"):
        calstudy.open_run(tmp_path / "run").gains("true")
    content = yaml.safe_load((tmp_path / "run" / "experiment.yaml").read_text())
    content["sky"]["eor"]["seed"] = content["corruption"]["effects"][0]["seed"] = 991
    (tmp_path / "run" / "experiment.yaml").write_text(yaml.safe_dump(content))
    path.write_text(json.dumps({**manifest, "products": []}))
    with pytest.raises(
        InputError, match=r"gains \(true gains\): is not in the store .*, since nothing in this run needed"
    ):
        calstudy.open_run(tmp_path / "run").gains("true")


def test_workers_that_cannot_start_say_what_a_script_must_have(file, monkeypatch):
    import distributed

    def refuse(**settings):
        raise RuntimeError("before the current process has finished its bootstrapping phase")

    monkeypatch.setattr(distributed, "LocalCluster", refuse)
    with pytest.raises(InputError, match=r'put what runs studies below `if __name__ == "__main__":`'):
        calstudy.load(file, **{"sky.eor.seed": 77}).run(workers=2, quiet=True)


def test_what_a_run_lacks_has_a_reason(run, tmp_path):
    for read in (run.gains, run.visibilities, run.gain_errors):
        with pytest.raises(InputError, match="half = 'first': must be one of even, odd"):
            read("residual", half="first")
    assert run.claims.empty
    assert run.parts == {}
    for worlds in (None, ["ideal"]):
        with pytest.raises(InputError, match="no comparison, and has no standings; `scores` has"):
            run.standings(worlds=worlds)
    with pytest.raises(InputError, match="no table 'comparison'"):
        run.table("comparison")
    with pytest.raises(InputError, match="not the folder of a finished run"):
        calstudy.open_run(tmp_path)
    assert "T " in repr(run)


def test_a_sky_below_the_horizon_ends_in_a_sentence(file):
    study = calstudy.load(file, **{"sky.foregrounds.count": 1, "instrument.times.start_lst": "1.8 h"})
    with pytest.raises(InputError, match="foregrounds: no source is above the horizon; use more, or another"):
        study.run(workers=1, quiet=True)


def test_damaged_tables_are_named_with_the_remedy(run, tmp_path):
    shutil.copytree(run.folder, tmp_path / "run")
    for path in (tmp_path / "run" / "tables").iterdir():
        path.write_text("junk")
    damaged = calstudy.open_run(tmp_path / "run")
    for read in (
        lambda: damaged.scores,
        lambda: damaged.transfer,
        lambda: damaged.spectra["eor"],
    ):
        with pytest.raises(InputError, match="is damaged; run the experiment again"):
            read()
    with pytest.raises(InputError, match=r"tables\.json: is damaged"):
        write_report(damaged.folder)
    (damaged.folder / "tables" / "score.json").unlink()
    with pytest.raises(InputError, match=r"score\.json: is missing, and the run wrote it; run the experiment again"):
        _ = calstudy.open_run(tmp_path / "run").scores
    shutil.rmtree(damaged.folder / "tables")
    assert damaged.tables == []


@pytest.mark.parametrize("content", [b"", b"a,b\n1,2\n1,2,3,4\n", b"k,power\n\xff,1\n"])
def test_a_file_that_is_no_table_is_damaged(run, tmp_path, content):
    shutil.copytree(run.folder, tmp_path / "run")
    (tmp_path / "run" / "tables" / "eor.outside-wedge.csv").write_bytes(content)
    with pytest.raises(InputError, match=r"eor\.outside-wedge\.csv: is damaged"):
        calstudy.open_run(tmp_path / "run").table("eor.outside-wedge")


def test_a_run_of_an_older_version_says_so(run, tmp_path):
    """A field that this version does not know any more is a fact of the run, not a mistake of its user."""
    for name in ("manifest.json", "experiment.yaml"):
        (tmp_path / name).write_bytes((run.folder / name).read_bytes())
    older = (
        (tmp_path / "experiment.yaml")
        .read_text(encoding="utf-8")
        .replace("calibration:", "calibration:\n  skip_flagged: 0.5", 1)
    )
    (tmp_path / "experiment.yaml").write_text(older, encoding="utf-8")
    with pytest.raises(InputError, match=r"written on .* by .*; this version refuses it.*\(calibration.skip_flagged"):
        calstudy.open_run(tmp_path).gains("residual")
    with pytest.raises(ExperimentError, match=r"^\S*experiment\.yaml: calibration.skip_flagged"):
        RunFolder(tmp_path).experiment()


def test_a_line_above_the_header_of_a_table_is_no_header(tmp_path):
    (tmp_path / "manifest.json").write_text('{"name": "mine"}')
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "sky-model.csv").write_text("# sky model: a file, of few sources\nfield,true\nbeam,# 3\n")
    (tmp_path / "tables" / "plain.csv").write_text("#,true\n1,2\n")
    run = calstudy.open_run(tmp_path)
    assert run.table("sky-model").to_dict("records") == [{"field": "beam", "true": "# 3"}]
    assert run.table("plain").to_dict("records") == [{"#": 1, "true": 2}]


@pytest.mark.parametrize("place", ["runs/mine", "runs/sweep-x/points/01-a", "renamed/mine"])
def test_the_store_is_beside_the_folder_of_runs(tmp_path, place):
    (tmp_path / place).mkdir(parents=True)
    (tmp_path / place / "manifest.json").write_text('{"name": "mine"}')
    stores = calstudy.open_run(tmp_path / place)._stores(Folders())
    assert [store.root for store in stores] == [Path("store").resolve(), tmp_path / "store"]


def test_texts_that_look_like_numbers_stay_texts():
    assert calstudy.load({"name": "mine"}, description="1e-3").experiment.description == "1e-3"
