"""Calibrators in worlds: which one stands, and that all are held to the same yardstick."""

import csv
import json

import numpy as np
import pytest
import yaml
from small_chain import small
from tiny import load

import calstudy
from calstudy.base.errors import ExperimentError, InputError
from calstudy.experiment.assumed import assumed_changes
from calstudy.power.score import BANDS, Score
from calstudy.power.tables import load_spectrum
from calstudy.power.transfer import TransferFunction
from calstudy.products.graph import Graph
from calstudy.products.score import score
from calstudy.products.signal_loss import transfer
from calstudy.regression import accept, compare_figures, read_reference, read_run
from calstudy.studies.kinds.comparison import load_worlds
from calstudy.studies.load import load_study
from calstudy.studies.study import Budget, Run, run_study

pytestmark = pytest.mark.chain

DRAWN = True

# Each of the two integrations is solved once, and anew, in one piece.
ANEW = {"chunks": 1, "solver": {"warm_start": False}}
CALIBRATORS = {
    # With equal weights, on gains that are white, the errors of the sky reach all delays.
    "sky-based": {"calibrator": "sky-based", "weights": "flags", **ANEW},
    "trusting": {"calibrator": "delay-weighted", "foreground_prior": {"deviation": 0.03}, **ANEW},
    "CALAMITY": {"calibrator": "calamity", "prior": "sky-model", "weights": "flags", **ANEW},
    "none": "none",
}
FIGURES = ("comparison-matrix", "comparison-spectra", "comparison-curves", "comparison-tolerances")
WORLDS = {"ideal": {}, "flux errors: 20 %": {"calibration.assumed.sky.foregrounds.errors": {"flux_scatter": 0.2}}}


def comparison_file(folder, **fields):
    """A comparison of three calibrators in two worlds, with 12 antennas, in `folder`."""
    base = small(folder, instrument__layout={"kind": "mwa-compact-minredundant", "count": 12})
    base["calibration"] = {"calibrator": "lbfgs-of-nobody"}
    (folder / "base.yaml").write_text(yaml.safe_dump(base))
    data = {
        "name": "compared",
        "experiment": "base.yaml",
        "calibrators": CALIBRATORS,
        "worlds": WORLDS,
        "figures": list(FIGURES),
        **fields,
    }
    path = folder / "comparison.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    return path


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> Run:
    return run_study(load_study(comparison_file(tmp_path_factory.mktemp("comparison"))), Budget(workers=1))


@pytest.fixture(scope="module")
def summaries(compared) -> dict:
    return json.loads((compared.folder / "tables" / "comparison.json").read_text())


def test_a_wrong_sky_model_spoils_only_those_who_trust_it(summaries):
    ideal, wrong = (summaries[world] for world in WORLDS)
    bias = {name: wrong[name]["bands"][1]["bias"] for name in CALIBRATORS}
    error = {name: wrong[name]["bands"][1]["bias_error"] for name in CALIBRATORS}
    assert wrong["sky-based"]["sky_model_error"] > 0.05
    assert bias["sky-based"] > 100
    assert bias["trusting"] < 0.01 * bias["sky-based"]
    assert abs(bias["CALAMITY"]) < max(1, 4 * error["CALAMITY"])
    # With a complete sky model nobody has a bias beyond the noise.
    for name in ("sky-based", "trusting", "CALAMITY"):
        band = ideal[name]["bands"][1]
        assert abs(band["bias"]) < 4 * band["bias_error"] + 0.1, name
    assert ideal["CALAMITY"]["sky_model_error"] == 0


def test_a_sky_model_that_is_the_truth_keeps_more_of_the_signal_than_none(summaries):
    kept = {name: summaries["ideal"][name]["bands"][1]["transfer"] for name in CALIBRATORS}
    assert kept["sky-based"] > kept["CALAMITY"]
    # What the gains of 12 antennas absorb at least: (2 N - 1) / (N (N - 1)) = 0.174.
    assert kept["CALAMITY"] < 0.9


def test_held_out_data_are_fitted_to_the_noise_unless_the_sky_is_wrong(summaries):
    ideal, wrong = (summaries[world] for world in WORLDS)
    # Unknowns that fit the noise of the even data add as much to the odd: between 1 and 2.
    assert 1 < ideal["CALAMITY"]["held_out_chi_squared"] < 2
    assert 1 < ideal["sky-based"]["held_out_chi_squared"] < ideal["CALAMITY"]["held_out_chi_squared"]
    assert wrong["sky-based"]["held_out_chi_squared"] > 100


@pytest.mark.parametrize(
    ("changes", "notes"),
    [
        (
            {},
            ["calibration.weights of base.yaml is not that of the calibrators; for all of them, set it in overrides"],
        ),
        ({"overrides": {"calibration.weights": "flags"}, "calibrators": {"A": "sky-based", "B": "calamity"}}, []),
    ],
)
def test_a_plan_notes_weights_that_no_calibrator_has(tmp_path, changes, notes):
    path = comparison_file(tmp_path, **changes)
    base = yaml.safe_load((tmp_path / "base.yaml").read_text())
    base["calibration"] = {"calibrator": "calamity", "solver": "gauss-newton", "weights": "flags"}
    (tmp_path / "base.yaml").write_text(yaml.safe_dump(base))
    assert [note for note in load_study(path).notes if "base.yaml" in note] == notes


def test_without_calibration_gain_errors_times_foregrounds_are_the_bias(summaries):
    """Gains of 1 + 0.1 (n + i n') times a perfect sky model: the error of g g* has the power 4 sigma^2 of F, white."""
    found = summaries["ideal"]["none"]
    assert found["gain_error_as_fitted"] == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    assert found["bands"][2]["bias"] > 1e3
    # T is measured of the response, and so is the power of g g* in the signal: 1 + 4 sigma^2 + ...
    assert found["bands"][2]["transfer"] * found["flux_scale"] ** -2 == pytest.approx(1.04, abs=0.1)


def test_tolerances_name_each_fault_and_calibrator(compared):
    text = (compared.folder / "tables" / "comparison.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith("| flux errors |"))
    cells = dict(zip(CALIBRATORS, (cell.strip() for cell in row.split("|")[2:-1]), strict=True))
    assert cells["sky-based"] == "< 20 %"
    assert cells["CALAMITY"] in ("noise", "> 20 %")


def test_scores_are_those_of_the_experiments_own_products(compared):
    """T s^2 of the score in the experiment's bins is that of its signal loss."""
    experiment = load(compared.folder / "cases" / "002.yaml")
    graph = Graph(experiment, keep_visibilities=False)
    keys = {task.key for task in compared.tasks}
    assert score(graph).key in keys
    product = compared.made.products[score(graph).key]
    found = load_spectrum(product.path / "score-bins.h5", Score)
    full = run_study(load_study(compared.folder / "cases" / "002.yaml"), Budget(workers=1))
    folder = full.made.products[transfer(graph).key].path
    own = load_spectrum(folder / "transfer.outside-wedge.h5", TransferFunction)
    known = np.isfinite(own.scale_free_transfer)
    assert known.any()
    assert np.allclose(found.transfer[known], own.scale_free_transfer[known], rtol=1e-9)


def test_tables_and_figures_hold_every_case(compared):
    folder = compared.folder
    with (folder / "tables" / "comparison.csv").open() as file:
        rows = list(csv.DictReader(file))
    cases = {(row["world"], row["calibrator"]) for row in rows}
    assert cases == {(world, name) for world in WORLDS for name in CALIBRATORS}
    assert len(rows) == len(cases) * (len(BANDS) - 1)
    assert all(float(row["CPU seconds per integration"]) > 0 for row in rows)
    # What a world changes has a column, which is empty for the others.
    scatter = {(row["world"], row["calibration.assumed.sky.foregrounds.errors.flux_scatter"]) for row in rows}
    assert scatter == set(zip(WORLDS, ("", "0.2"), strict=True))
    text = (folder / "tables" / "comparison.md").read_text()
    assert all(f"| {name} |" in text for name in CALIBRATORS)
    for figure in FIGURES:
        arrays = np.load(folder / "figures" / f"{figure}.npz")
        assert {name.split(".")[0] for name in arrays.files} == set(WORLDS)
    assert "flux errors: 20 %" in (folder / "report.html").read_text()


def test_the_answer_is_on_the_report_and_in_python(compared, summaries):
    found = calstudy.open_run(compared.folder).standings().loc[(0.2, 0.5)]
    # It has more than a hundred times the EoR with fluxes that are wrong.
    assert found.standing["sky-based"] == "fails"
    assert found.worlds["sky-based"] == ["flux errors: 20 %"]
    lowest = min(summaries[world]["CALAMITY"]["bands"][1]["transfer"] for world in WORLDS)
    assert found.transfer["CALAMITY"] == lowest
    with pytest.raises(InputError, match="limit = 0: must be greater than 0"):
        calstudy.open_run(compared.folder).standings(limit=0)
    with pytest.raises(InputError, match="limit = 'small': must be greater than 0"):
        calstudy.open_run(compared.folder).standings(limit="small")
    with pytest.raises(InputError, match=r"worlds = 'ideal': must be a list of names, such as \['ideal'\]"):
        calstudy.open_run(compared.folder).standings(worlds="ideal")
    with pytest.raises(InputError, match="has no spectra by variant; its numbers are in its tables"):
        _ = calstudy.open_run(compared.folder).spectra
    with pytest.raises(InputError, match="has no transfer function of one calibration; its numbers are in its tables"):
        _ = calstudy.open_run(compared.folder).transfer
    assert calstudy.open_run(compared.folder).standings(limit=1e9).loc[(0.2, 0.5)].standing["sky-based"] == "passes"
    page = (compared.folder / "report.html").read_text()
    assert page.index("Which calibrator to trust") < page.index("Scores: ideal")
    assert "k 0.2 to 0.5 h/Mpc: " in page


def test_faults_name_the_case_and_the_field(tmp_path):
    path = comparison_file(tmp_path, worlds={"a": {"sky.foregrounds.flux_limit": "8 parsec"}})
    with pytest.raises(ExperimentError, match=r"flux_limit: '8 parsec'.*in 'sky-based in a' and 3 other"):
        load_study(path)
    with pytest.raises(ExperimentError, match=r"calibration.sovler: unknown.*CALAMITY in ideal"):
        load_study(
            comparison_file(
                tmp_path, calibrators={"CALAMITY": {"calibrator": "calamity", "sovler": 1}}, worlds={"ideal": {}}
            )
        )
    with pytest.raises(ExperimentError, match="'wedge' is a figure for experiment files, not for comparison files"):
        load_study(comparison_file(tmp_path, figures=["wedge"]))
    with pytest.raises(ExperimentError, match="wrlds: unknown key, did you mean 'worlds'"):
        load_study(comparison_file(tmp_path, wrlds={}))
    with pytest.raises(ExperimentError, match="experiment = 3: must be a block of keys"):
        load_study(comparison_file(tmp_path, experiment=3))
    with pytest.raises(ExperimentError, match="scales = 3: must be a block of keys"):
        load_study(comparison_file(tmp_path, scales=3))
    # Every case is held to the same yardstick, with the calibrator of its label, and no block is lost.
    for changes, sentence in {
        "calibration.calibrator: none": "'a' changes the calibrator",
        "name: mine": "'a' changes name, which has no effect",
        "power.taper: none": "'a' changes power.taper; all cases are measured alike",
        "instrument: {as_built: {}}": r"'a' replaces all of instrument; .* \(instrument.as_built\)",
    }.items():
        with pytest.raises(ExperimentError, match=sentence):
            load_study(comparison_file(tmp_path, worlds={"a": yaml.safe_load(changes)}))
    with pytest.raises(ExperimentError, match="'x: 2 kg' has the unit 'kg'"):
        load_study(comparison_file(tmp_path, worlds={"x: 1 cm": {}, "x: 2 kg": {}}))
    with pytest.raises(InputError, match="--scale large"):
        load_study(comparison_file(tmp_path), "large")
    inline = {**small(tmp_path), "calibration": {"weights": "autos", "assumed": {"sky.foregrounds.count": 9}}}
    with pytest.raises(ExperimentError, match=r"experiment\.calibration\.weights: .*set calibration.weights in overr"):
        load_study(comparison_file(tmp_path, experiment=inline))


def test_an_array_that_cannot_be_made_is_not_a_refusal_of_calibrators(tmp_path):
    (tmp_path / "positions.csv").write_text("number,east_m,north_m\n1,0,0\n2,14,0\n")
    layout = {"kind": "csv", "path": "positions.csv"}
    worlds = {"mine": {"instrument.layout": layout, "instrument.location": "mwa"}}
    with pytest.raises(InputError, match=r"^instrument\.layout\.path: .*missing: up_m;"):
        load_study(comparison_file(tmp_path, worlds=worlds))


def test_scales_of_the_file_and_of_its_experiment_go_together(tmp_path):
    path = comparison_file(tmp_path, scales={"short": {"worlds": {"ideal": {}}, "overrides": {"sky.eor.seed": 9}}})
    study = load_study(path, "short")
    assert [case.world for case in study.cases] == ["ideal"] * len(CALIBRATORS)
    assert {case.experiment.sky.eor.seed for case in study.cases} == {9}


def test_worlds_and_calibrators_can_be_set_as_fields_of_the_experiment_can(tmp_path):
    overrides = ["worlds={ideal: {}}", "calibrators.CALAMITY={calibrator: calamity}", "name=mine", "sky.eor.seed=9"]
    study = load_study(comparison_file(tmp_path), overrides=overrides)
    assert {case.world for case in study.cases} == {"ideal"}
    assert [case.calibrator for case in study.cases] == list(CALIBRATORS)
    assert {case.experiment.sky.eor.seed for case in study.cases} == {9}
    assert study.folder.name.startswith("mine-")
    fields = ["worlds.flux 2.5 Jy.sky.foregrounds.flux_limit=2.5 Jy", "calibrators.sky-based.solver.max_steps=7"]
    path = comparison_file(tmp_path, worlds={"ideal": {}, "flux 2.5 Jy": {"sky.eor.seed": 4}})
    cases = {(case.calibrator, case.world): case.experiment for case in load_study(path, overrides=fields).cases}
    changed, other = cases["sky-based", "flux 2.5 Jy"], cases["trusting", "ideal"]
    assert (changed.sky.foregrounds.flux_limit, changed.sky.eor.seed) == (2.5, 4)
    assert changed.sky.foregrounds.count == other.sky.foregrounds.count
    assert changed.calibration.solver.max_steps == 7 != other.calibration.solver.max_steps
    with pytest.raises(InputError, match=r"^--set figures\.0: set figures as a whole$"):
        load_study(path, overrides=["figures.0=comparison-matrix"])
    with pytest.raises(
        InputError, match=r"^--set experiment: set fields of the experiment by their own paths, or .*worlds"
    ):
        load_study(path, overrides=["experiment=other.yaml"])
    with pytest.raises(ExperimentError, match=r"sky\.eor\.sed"):
        load_study(comparison_file(tmp_path), overrides=["worlds={ideal: {sky.eor.sed: 9}}"])


def test_what_the_experiment_assumes_is_kept_where_a_calibrator_does_not_say_otherwise(tmp_path):
    calibrators = {
        "trusting": "sky-based",
        "knowing": {"calibrator": "sky-based", "assumed": {"sky.foregrounds.flux_limit": "2 Jy"}},
    }
    worlds = {"scatter": {}, "larger": {"calibration.assumed.sky.foregrounds.errors": {"flux_scatter": 0.2}}}
    path = comparison_file(tmp_path, calibrators=calibrators, worlds=worlds)
    base = yaml.safe_load((tmp_path / "base.yaml").read_text())
    base["calibration"]["assumed"] = {"sky.foregrounds.errors": {"flux_scatter": 0.1}, "sky.foregrounds.count": 9}
    (tmp_path / "base.yaml").write_text(yaml.safe_dump(base))
    study = load_study(path)
    assumed = {
        (case.calibrator, case.world): assumed_changes(case.experiment.calibration.assumed) for case in study.cases
    }
    errors = "sky.foregrounds.errors.flux_scatter"
    count = "sky.foregrounds.count"
    assert {key: (value.get(errors), value.get(count)) for key, value in assumed.items()} == {
        ("trusting", "scatter"): (0.1, 9),
        ("trusting", "larger"): (0.2, 9),
        ("knowing", "scatter"): (None, None),
        ("knowing", "larger"): (0.2, None),
    }


def test_the_file_in_the_run_folder_is_the_same_comparison(compared, tmp_path):
    again = load_study(compared.folder / "experiment.yaml")
    assert again.tables[0].key in compared.made.products
    assert again.folder.name == compared.folder.name
    # As a reference it has no folders of this machine, and can be made again with those of another.
    accept(compared.folder, tmp_path / "reference")
    text = (tmp_path / "reference" / "experiment.yaml").read_text()
    assert str(compared.folder.parent) not in text
    moved = load_study(tmp_path / "reference" / "experiment.yaml", overrides=[f"outputs.store={tmp_path}"])
    assert moved.tables[0].key == again.tables[0].key
    assert (tmp_path / "reference" / "comparison.md").is_file()
    reference = read_reference(tmp_path / "reference")
    found = compare_figures(reference.figures, read_run(compared.folder).figures, reference.tolerances)
    assert found
    assert all(item.status == "same" for item in found)


def test_differences_are_from_the_best_of_each_band_and_better_known_than_scores(compared, summaries):
    for found in summaries.values():
        for band in range(len(BANDS) - 1):
            [best] = {case["differences"][band]["best"] for case in found.values()}
            for name, case in found.items():
                less, own, other = case["differences"][band], case["bands"][band], found[best]["bands"][band]
                assert less["transfer"] == pytest.approx(own["transfer"] - other["transfer"], abs=1e-9)
                if name == best:
                    assert less["transfer_error"] == less["bias_error"] == 0
    # With weights that hardly matter, both see the same noise.
    less, own = summaries["ideal"]["trusting"]["differences"][1], summaries["ideal"]
    assert less["bias_error"] < np.hypot(*(own[name]["bands"][1]["bias_error"] for name in (less["best"], "trusting")))
    text = (compared.folder / "tables" / "comparison.md").read_text()
    assert text.count("Less the best of each band:") == len(WORLDS)


def test_a_world_that_changes_nothing_is_refused(tmp_path):
    count = small(tmp_path)["instrument"]["channels"]["count"]
    path = comparison_file(tmp_path, worlds={"ideal": {}, "as it is": {"instrument.channels.count": count}})
    with pytest.raises(ExperimentError, match="worlds: 'as it is' is the same as 'ideal'; change a field"):
        load_study(path)


OWN_CALIBRATOR = """
from calstudy.calibrate.interface import Calibrator

class Mine(Calibrator):
    def calibrate(self, observation, assumed, progress=None):
        raise NotImplementedError
"""
POSITIONS = "number,east_m,north_m,up_m\n" + "".join(f"{n},{14 * n},{n * n},0\n" for n in range(7))


def read_back(study, folder):
    """Return the comparison of the file in a run folder, which is written elsewhere."""
    folder.mkdir()
    (folder / "experiment.yaml").write_text(study.texts["experiment.yaml"])
    return load_study(folder / "experiment.yaml")


@pytest.mark.parametrize(
    "change",
    [
        "power.taper=hann",
        "corruption={noise: {factor: 3}}",
        "sky.eor.seed=64",
        "sky.foregrounds={count: 50}",
        "calibration.solver.max_steps=7",
        "calibration.assumed.sky.foregrounds.count=9",
        "corruption.noise={kind: times-foregrounds, factor: 0.1}",
    ],
)
def test_the_file_in_the_run_folder_has_the_changes_of_the_command_line(tmp_path, change):
    overrides = {"calibration.chunks": 1, "calibration.assumed": {"sky.foregrounds.errors": {"flux_scatter": 0.1}}}
    worlds = {
        "ideal": {},
        "coarse": {"sky.eor": {"nside": 32}},
        "few": {"sky.foregrounds.count": 40, "instrument.as_built.positions.scatter": "1 cm"},
    }
    names = {"CALAMITY": {"calibrator": "calamity", "chunks": 2}, "groups": {"calibrator": "calamity-redundant"}}
    study = load_study(comparison_file(tmp_path, overrides=overrides, calibrators=names, worlds=worlds), None, [change])
    again = read_back(study, tmp_path / "run")
    assert again.folder.name == study.folder.name
    assert [case.experiment.calibration for case in again.cases] == [
        case.experiment.calibration for case in study.cases
    ]


def test_the_file_in_the_run_folder_names_files_by_their_full_paths_and_has_the_salt(tmp_path):
    (tmp_path / "mine.py").write_text(OWN_CALIBRATOR)
    (tmp_path / "positions.csv").write_text(POSITIONS)
    worlds = {"ideal": {}, "placed": {"instrument.layout": {"kind": "csv", "path": "positions.csv"}}}
    for world in worlds.values():
        world["instrument.location"] = "mwa"
    names = {"mine": "mine.py", "class": {"calibrator": "mine.py:Mine"}}
    study = load_study(comparison_file(tmp_path, calibrators=names, worlds=worlds, salt="5a17"))
    again = read_back(study, tmp_path / "run")
    assert again.folder.name == study.folder.name
    assert again.file.salt == "5a17"


def test_relative_paths_start_at_the_file_that_names_them(tmp_path):
    base, own = tmp_path / "base", tmp_path / "own"
    for folder in (base, own):
        folder.mkdir()
        (folder / "positions.csv").write_text(POSITIONS)
    (own / "mine.py").write_text(OWN_CALIBRATOR)
    placed = {"kind": "csv", "path": "positions.csv"}
    path = comparison_file(own, experiment="../base/base.yaml", calibrators={"mine": "mine.py"})
    data = yaml.safe_load((own / "base.yaml").read_text())
    data["instrument"] |= {"layout": placed, "location": "mwa"}
    (base / "base.yaml").write_text(yaml.safe_dump(data))

    def places(**fields):
        comparison_file(own, experiment="../base/base.yaml", calibrators={"mine": "mine.py"}, **fields)
        return {case.world: case.experiment.instrument.layout.path.parent for case in load_study(path).cases}

    assert places(worlds={"ideal": {}}) == {"ideal": base}
    worlds = {"ideal": {}, "moved": {"instrument.layout": placed, "sky.eor.seed": 3}}
    assert places(worlds=worlds) == {"ideal": base, "moved": own}
    assert places(worlds={"ideal": {}}, overrides={"instrument.layout": placed}) == {"ideal": own}
    assert load_study(path).cases[0].experiment.calibration.calibrator == str(own / "mine.py")


def test_the_name_of_a_calibrator_is_none_of_a_folder(tmp_path):
    (tmp_path / "redcal").mkdir()
    names = {"mine": {"calibrator": "by-file", "folder": "redcal"}, "theirs": "redcal"}
    study = load_study(comparison_file(tmp_path, calibrators=names))
    again = read_back(study, tmp_path / "run")
    labels = {case.calibrator: case.experiment.calibration.label for case in again.cases}
    assert labels == {case.calibrator: case.experiment.calibration.label for case in study.cases}


@pytest.mark.parametrize(
    ("field", "value"), [("sweep", {"sky.eor.seed": [2, 3]}), ("realizations", {"draw": ["noise"], "count": 3})]
)
def test_an_experiment_with_more_than_one_run_is_refused(tmp_path, field, value):
    path = comparison_file(tmp_path)
    base = yaml.safe_load((tmp_path / "base.yaml").read_text())
    (tmp_path / "base.yaml").write_text(yaml.safe_dump(base | {field: value}))
    with pytest.raises(ExperimentError, match=f"^experiment: has {field}, which a comparison does not make"):
        load_study(path)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("calibration=redcal", "changes the calibrator, which each entry of calibrators names"),
        ("calibration.calibrator=redcal", "changes the calibrator, which each entry of calibrators names"),
        ("realizations={count: 5}", "changes realizations, which has no effect"),
        ("sweep={sky.eor.seed: [1, 2]}", "changes sweep, which has no effect"),
        ("outputs.figures=[wedge]", "changes outputs.figures, which has no effect"),
        ("outputs={figures: [wedge]}", "changes outputs.figures, which has no effect"),
        ("papers=[calamity2022]", "changes papers, which has no effect"),
    ],
)
def test_what_no_case_could_have_is_refused(tmp_path, change, told):
    with pytest.raises(InputError, match=f"^--set {change.partition('=')[0]}: {told}"):
        load_study(comparison_file(tmp_path), None, [change])
    field, _, value = change.partition("=")
    changes = {field: yaml.safe_load(value)}
    with pytest.raises(ExperimentError, match=f"^overrides: '{field}' {told}"):
        load_study(comparison_file(tmp_path, overrides=changes))
    load_study(comparison_file(tmp_path), None, ["outputs.figures=[]", "papers=[]"])


def test_two_calibrators_that_are_the_same_are_refused(tmp_path):
    twice = {"sky-based": "sky-based", "mine": {"calibrator": "sky-based", "weights": "gains"}}
    with pytest.raises(ExperimentError, match="calibrators: 'mine' is the same as 'sky-based'; change a field"):
        load_study(comparison_file(tmp_path, calibrators=twice))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"overrides": {"instrument.banana": 3}},
            r"scales\.small: instrument\.banana: unknown key.*in 'sky-based in ideal' and 7 other",
        ),
        ({"worlds.ideal": {"sky.eor.sed": 3}}, r"scales\.small: sky\.eor\.sed: unknown key"),
        ({"calibrators.none": "nobody"}, r"scales\.small: calibration\.calibrator: 'nobody' is not a calibrator"),
        ({"figurs": []}, r"scales\.small: figurs: unknown key, did you mean 'figures'"),
        ({"name.x": 3}, r"scales\.small: name: must be a text"),
    ],
)
def test_a_fault_in_a_scale_that_is_not_asked_for_is_found(tmp_path, changes, sentence):
    path = comparison_file(tmp_path, scales={"small": changes, "other": {"overrides": {"sky.eor.seed": 9}}})
    for scale in (None, "other"):
        with pytest.raises(ExperimentError, match=sentence):
            load_study(path, scale)


def test_an_input_file_of_a_scale_that_is_not_asked_for_may_be_missing(tmp_path):
    layout = {"instrument.layout": {"kind": "csv", "path": "elsewhere.csv"}, "instrument.location": "mwa"}
    path = comparison_file(tmp_path, scales={"there": {"overrides": layout}})
    assert load_study(path).cases
    with pytest.raises(ExperimentError, match=r"elsewhere\.csv"):
        load_study(path, "there")


def test_a_calibrator_of_a_file_has_the_name_of_the_file_as_label(tmp_path):
    (tmp_path / "mine.py").write_text(OWN_CALIBRATOR)
    (tmp_path / f"{'mine' * 11}.py").write_text(OWN_CALIBRATOR)
    path = tmp_path / "study.yaml"
    for name, label in {"mine": "mine", "mine" * 11: "mine" * 10}.items():
        path.write_text(yaml.safe_dump({**small(tmp_path), "calibration": {"calibrator": f"{name}.py"}}))
        [case] = load_worlds(path, None, (), None).cases
        assert case.calibrator == label


def test_texts_that_look_like_numbers_stay_texts_in_the_run_folder(tmp_path):
    path = comparison_file(tmp_path, calibrators={"none": "none"})
    study = load_study(path, None, ["description='1e-3'"])
    assert read_back(study, tmp_path / "run").description == "1e-3"
