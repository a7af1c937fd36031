"""Realizations in the chain: they differ in the drawn seeds alone, share the rest, and are pooled."""

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console
from tiny import load, tiny

from calstudy.base.errors import ExperimentError, InputError
from calstudy.claims.evaluation import evaluate_folder
from calstudy.experiment.files import dump, override, validate
from calstudy.experiment.realizations import expand_realizations, members
from calstudy.power.spectra import SphericalSpectrum
from calstudy.power.tables import load_spectrum
from calstudy.power.transfer import TransferFunction
from calstudy.products.realizations import inputs
from calstudy.products.signal_loss import transfer
from calstudy.run.execution import largest_disk, schedule
from calstudy.run.store import Store
from calstudy.run.task import unique
from calstudy.studies.kinds.collection import Collection
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.kinds.realizations import Realizations
from calstudy.studies.load import load_study
from calstudy.studies.show import describe_plan, show_plan, show_run
from calstudy.studies.study import Budget, Run, run_study
from calstudy.verdicts.tables import from_json

pytestmark = pytest.mark.chain

DRAWN = True

EVERYTHING = {"draw": ["eor", "gains", "noise"], "count": 3}
TWO_BLOCKS = [{"draw": ["gains", "noise"], "count": 4}, {"draw": ["eor"], "count": 3}]


def small(folder, **fields) -> dict:
    data = override(tiny(folder), "instrument.layout", {"kind": "mwa-compact-minredundant", "count": 7})
    # The figures of an experiment are drawn elsewhere.
    cheap = {"simulation.chunks": 1, "calibration.chunks": 1, "outputs.figures": []}
    for path, value in {**cheap, "realizations": EVERYTHING}.items():
        data = override(data, path, value)
    for path, value in fields.items():
        data = override(data, path.replace("__", "."), value)
    return data


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("realizations")


@pytest.fixture(scope="module")
def finished(folder) -> Run:
    return run_study(Realizations(validate(small(folder), folder)), Budget(workers=1))


def seeds_of(experiment) -> tuple:
    return experiment.sky.eor.seed, experiment.corruption.effects[0].seed, experiment.corruption.noise.seeds


def without_seeds(experiment) -> dict:
    """Return all that an experiment says, but for its seeds and the variants that only the first realization has."""

    def stripped(value):
        if isinstance(value, dict):
            return {key: stripped(item) for key, item in value.items() if key not in ("seed", "seeds", "variants")}
        return [stripped(item) for item in value] if isinstance(value, list) else value

    return stripped(experiment.model_dump(mode="json"))


def test_realizations_differ_in_the_drawn_seeds_alone(folder):
    experiment = validate(small(folder, realizations=TWO_BLOCKS), folder)
    found = expand_realizations(experiment)
    assert [seeds_of(item.experiment) for item in found] == [
        (2, 5, (3, 4)),
        (2, 15, (13, 14)),
        (2, 25, (23, 24)),
        (2, 35, (33, 34)),
        (12, 5, (3, 4)),
        (22, 5, (3, 4)),
    ]
    assert [found[place].label for place in (0, 1, -1)] == ["base", "gains 2, noise 2", "eor 3"]
    assert members(experiment) == [[0, 1, 2, 3], [0, 4, 5]]
    others = [without_seeds(item.experiment) for item in found]
    assert all(item == others[0] for item in others)


def test_gains_of_a_file_are_drawn_again_by_their_drift(folder):
    (folder / "x.calh5").touch()
    data = override(small(folder), "corruption.effects", [{"kind": "file-gains", "path": "x.calh5", "drift": "jumps"}])
    drifts = [item.experiment.corruption.effects[0].drift for item in expand_realizations(validate(data, folder))]
    assert [drift.seed for drift in drifts] == [50, 60, 70]


def test_a_realization_has_the_products_of_the_experiment_with_these_seeds_in_its_file(folder):
    """The same keys, so that a run of either finds what the other made."""
    data = small(folder, sky__eor__seed=12, corruption__noise__seeds=[13, 14])
    data = override(data, "corruption.effects", [{"kind": "per-channel-gains", "sigma": 0.1, "seed": 15}])
    data.pop("realizations")
    written = {task.key for task in ExperimentStudy(validate(data, folder)).tasks}
    pooled = inputs(Realizations(validate(small(folder), folder)).graph)
    tasks = unique([pooled["spectra:1"], pooled["transfer:1"]])
    for stage, count in {"calibrate": 4, "corrupt": 7, "simulate": 2, "effect": 1}.items():
        keys = {task.key for task in tasks if task.stage.name == stage}
        assert len(keys) == count
        assert keys <= written


def test_blocks_share_what_they_do_not_draw(folder):
    study = Realizations(validate(small(folder, realizations=TWO_BLOCKS), folder))
    stages = [task.stage.name for task in study.tasks]
    # One sky of foregrounds and three of the EoR; gains of the experiment itself and of three other draws.
    assert stages.count("simulate") == 4
    assert stages.count("effect") == 4
    # With and without the EoR, even and odd, of six realizations.
    assert stages.count("calibrate") == 24
    assert len({task.key for task in study.tasks}) == len(study.tasks)


def test_the_experiment_itself_is_the_first_realization(finished, folder):
    data = small(folder)
    data.pop("realizations")
    own = ExperimentStudy(validate(data, folder))
    todo = {task.stage.name for task in schedule([transfer(own.graph)], Store(own.outputs.store)).todo}
    assert todo == set()


def test_visibilities_of_other_realizations_are_removed_and_those_of_the_experiment_kept(finished):
    store = Store(Path(finished.folder).parents[1] / "store")
    for stage in ("corrupt", "calibrate"):
        tasks = [task for task in finished.tasks if task.stage.name == stage]
        kept = [task for task in tasks if store.find(stage, task.key) is not None]
        assert 0 < len(kept) < len(tasks)
        assert not any(task.temporary for task in kept)
        assert all(task.temporary for task in tasks if task not in kept)
    averages = [task for task in finished.tasks if task.stage.name == "average"]
    assert all(store.find("average", task.key) is not None for task in averages)


def test_a_second_run_makes_nothing_and_a_lost_product_comes_from_averages(finished, folder):
    study = Realizations(validate(small(folder), folder))
    assert run_study(study, Budget(workers=1)).made.tasks == ()
    store = Store(study.outputs.store)
    for task in (inputs(study.graph)["spectra:2"], study.tables[0]):
        store.discard(task.stage.name, task.key)
    made = [
        task.stage.name
        for task in run_study(Realizations(validate(small(folder), folder)), Budget(workers=1)).made.tasks
    ]
    assert made == ["realization", "pooled-realizations"]


def test_what_is_pooled_is_what_the_realizations_measured(finished):
    study = Realizations(load(finished.folder / "experiment.yaml"))
    found = inputs(study.graph)
    store = Store(study.outputs.store)
    transfers = [
        load_spectrum(
            store.folder("transfer", found[f"transfer:{number}"].key) / "transfer.outside-wedge.h5", TransferFunction
        )
        for number in range(3)
    ]
    values = np.stack([item.transfer for item in transfers])
    assert np.ptp(values[:, -1]) > 0
    with np.load(finished.folder / "figures" / "realizations.npz") as arrays:
        assert arrays["outside-wedge.values.transfer"] == pytest.approx(values, nan_ok=True)
        assert arrays["outside-wedge.total.transfer.mean"] == pytest.approx(values.mean(axis=0), nan_ok=True)
        assert arrays["outside-wedge.total.transfer.covariance"][-1, -2] == pytest.approx(
            np.cov(values[:, -1], values[:, -2])[0, 1]
        )
        # The level of the EoR is relative to the foregrounds: the factor, and with it the input, has its sky's scatter.
        put_in = arrays["outside-wedge.input"][:, -1]
        assert 0 < put_in.std() / put_in.mean() < 0.1
        assert arrays["outside-wedge.corrected.shared"].tolist() == [0, 0, 0]
        assert {name.partition(".")[0] for name in arrays} == {"outside-wedge", "inside-wedge", "all-modes"}


def test_inside_and_outside_the_wedge_make_up_all_modes(finished):
    study = Realizations(load(finished.folder / "experiment.yaml"))
    product = Store(study.outputs.store).folder("realization", inputs(study.graph)["spectra:0"].key)
    parts = {
        region: load_spectrum(product / f"residual.{region}.h5", SphericalSpectrum)
        for region in ("outside-wedge", "inside-wedge", "all-modes")
    }
    modes = {name: item.n_modes for name, item in parts.items()}
    assert (modes["outside-wedge"] + modes["inside-wedge"] == modes["all-modes"]).all()
    assert min(modes["inside-wedge"].sum(), modes["outside-wedge"].sum()) > 0
    weighted = sum(np.nan_to_num(parts[name].power) * modes[name] for name in ("outside-wedge", "inside-wedge"))
    used = modes["all-modes"] > 0
    assert (weighted / np.maximum(modes["all-modes"], 1))[used] == pytest.approx(parts["all-modes"].power[used])


def test_a_run_leaves_tables_a_figure_and_verdicts(finished):
    assert {path.name for path in (finished.folder / "tables").iterdir()} == {
        "realizations.csv",
        "realizations.md",
        "realizations.json",
        "tables.json",
    }
    with (finished.folder / "tables" / "realizations.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["region"] for row in rows} == {"outside-wedge", "inside-wedge", "all-modes"}
    empty = [row for row in rows if row["region"] == "inside-wedge" and row["transfer mean"] == "nan"]
    assert empty
    assert {row["why not corrected"] for row in empty} == {"no modes"}
    verdicts = json.loads((finished.folder / "tables" / "realizations.json").read_text())
    assert [item["name"] for item in verdicts] == [
        "bars-cover-eor",
        "bars-cover-input",
        "corrected-mean",
        "corrected-mean-known-scale",
        "corrected-covers-eor",
        "corrected-covers-input",
    ]
    text = (finished.folder / "tables" / "realizations.md").read_text()
    assert "3 realizations of EoR, gains and noise" in text
    assert "## Inside wedge" in text
    manifest = json.loads((finished.folder / "manifest.json").read_text())
    assert [item["sky.eor.seed"] for item in manifest["realizations"]] == [2, 12, 22]
    assert "Realizations" in (finished.folder / "report.html").read_text()
    console = Console(record=True, width=200, file=io.StringIO())
    show_run(finished, console)
    assert "criteria: " in console.export_text()


PAPER = """
from calstudy.claims.paper import Paper
from calstudy.claims.realizations import over_realizations
from calstudy.verdicts.criterion import Within
from calstudy.verdicts.statement import Source


@Source("Results", ("any",)).states(
    "it is recovered", "P^R / P^S", Within(-9, 9), "wide", pooled=over_realizations("ratio", "outside-wedge", 0.2)
)
def recovered(run):
    raise AssertionError("is measured on realizations")


@Source("Results", ("any",)).states("gains are", "g", Within(-9, 9), "wide")
def gains(run):
    raise AssertionError("is about single runs")


class Any(Paper):
    roles = {"any": "a run"}

    def statements(self):
        return [recovered, gains]
"""


def test_claims_are_those_that_realizations_measure(finished, folder, tmp_path):
    """The numbers of the folder's arrays, those of the product of the run, and those of its table."""
    (tmp_path / "any.py").write_text(PAPER)
    (claim,) = evaluate_folder(finished.folder, [str(tmp_path / "any.py")]).verdicts
    assert (claim.name, claim.runs, claim.verdict) == ("recovered", (finished.folder.name.split("-")[0],), "supported")
    data = small(folder, papers=[str(tmp_path / "any.py")], outputs__runs=str(tmp_path / "runs"))
    again = run_study(Realizations(validate(data, folder)), Budget(workers=1))
    assert from_json((again.folder / "claims.json").read_text()) == [claim]
    with (finished.folder / "tables" / "realizations.csv").open(newline="") as table:
        rows = [row for row in csv.DictReader(table) if row["region"] == "outside-wedge"]
    ratios = [float(row["ratio mean"]) for row in rows if float(row["k [h/Mpc]"]) >= 0.2]
    assert claim.measured == pytest.approx(np.nanmean(ratios), rel=1e-6)


def test_the_plan_counts_the_disk_that_is_held_at_one_time(folder, tmp_path):
    few, many = (validate(small(tmp_path, realizations={**EVERYTHING, "count": count}), folder) for count in (3, 12))
    disks = []
    for experiment in (few, many):
        study = Realizations(experiment)
        disks.append(largest_disk(study.targets, study.tasks))
    visibilities = sum(
        task.cost.disk for task in Realizations(many).tasks if task.stage.name in ("corrupt", "calibrate")
    )
    kept = sum(task.cost.disk for task in Realizations(many).tasks if not task.temporary)
    assert disks[0] < disks[1] < kept + visibilities / 4
    console = Console(record=True, width=200, file=io.StringIO())
    show_plan(describe_plan(Realizations(few), Budget(workers=1)), console)
    assert "of disk while running" in console.export_text()


def test_the_file_reads_back_from_the_run_folder(finished):
    experiment = load(finished.folder / "experiment.yaml")
    assert (finished.folder / "experiment.yaml").read_text() == dump(experiment)
    assert Realizations(experiment).folder == finished.folder


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"realizations": {"draw": ["gains"], "count": 1}}, "realizations.0.count: must be at least 2"),
        ({"realizations": {"draw": ["beam"]}}, "realizations.0.draw.0: not a choice (allowed: eor, gains, noise)"),
        ({"realizations": {"draw": []}}, "realizations.0.draw: names nothing"),
        ({"realizations": {"draw": ["eor", "eor"]}}, "names something twice: eor, eor"),
        ({"realizations": {"draws": ["eor"]}}, "realizations.0.draws: unknown key, did you mean 'draw'?"),
        ({"realizations": 3}, "realizations = 3: must be a list"),
        (
            {"realizations": [{"draw": ["eor"]}, {"draw": ["eor", "noise"]}]},
            "realizations: draw 'eor' in 2 blocks; each part can be drawn in one block only",
        ),
        ({"corruption__effects": []}, "realizations: draw 'gains', but no effect on the gains"),
        (
            {"corruption__noise__seeds": [3, 23]},
            "realizations: the seed 23 would be used for noise and for noise (seeds grow by 10",
        ),
        (
            {"corruption__effects": ["per-channel-gains", {"kind": "decoherence", "seed": 25}]},
            "realizations: the seed 25 would be used for gains and for corruption.effects.1 (seeds grow by 10",
        ),
        (
            {"instrument__as_built__positions": {"scatter": "1 cm", "seed": 13}},
            "realizations: the seed 13 would be used for noise and for instrument.as_built.positions (seeds grow by 10",
        ),
        (
            {"sky__eor": {"nside": 32, "spectrum": "power-law", "seed": 1}, "sky__diffuse": {"kind": "synthetic"}},
            "realizations: the seed 21 would be used for sky.diffuse and for the EoR (seeds grow by 10",
        ),
        ({"outputs__figures": ["wedge", "gains"]}, "outputs.figures: are figures of single runs"),
        ({"sweep": {"sky.eor.seed": [2, 3]}}, "realizations: cannot be asked for together with a sweep"),
        (
            {"variants": {"eor": {"components": ["eor"]}}, "outputs__figures": ["layout"]},
            "realizations: pool the signal loss, which needs the variants residual, residual_without_eor, eor",
        ),
    ],
)
def test_faults_are_told_in_one_sentence(folder, fields, told):
    with pytest.raises(ExperimentError) as caught:
        Realizations(validate(small(folder, **fields), folder))
    assert any(told in fault for fault in caught.value.faults), caught.value.faults
    assert len(caught.value.faults) == 1


def test_an_experiment_without_realizations_has_none_and_cannot_draw_their_figure(folder):
    data = small(folder)
    data.pop("realizations")
    with pytest.raises(InputError, match="has no realizations"):
        Realizations(validate(data, folder))
    with pytest.raises(ExperimentError, match="is a figure for realizations files"):
        validate(override(data, "outputs.figures", ["realizations"]), folder)


def test_a_file_with_realizations_is_a_study_of_its_own_also_in_a_collection(folder):
    (folder / "alone.yaml").write_text(yaml.safe_dump(small(folder)))
    assert isinstance(load_study(folder / "alone.yaml"), Realizations)
    plain = small(folder, name="plain")
    plain.pop("realizations")
    (folder / "plain.yaml").write_text(yaml.safe_dump(plain))
    (folder / "both.yaml").write_text(yaml.safe_dump({"name": "both", "experiments": ["alone.yaml", "plain.yaml"]}))
    study = load_study(folder / "both.yaml")
    assert isinstance(study, Collection)
    assert [type(part) for part in study.parts.values()] == [Realizations, ExperimentStudy]
    fitted, _ = study.sized_to(Budget(workers=1))
    assert [type(part) for part in fitted.parts.values()] == [Realizations, ExperimentStudy]
    assert fitted.claims is None


@pytest.mark.parametrize("scale", [None, "small"])
def test_the_shipped_file_draws_what_the_docs_say(scale):
    study = load_study(Path(__file__).parents[2] / "experiments" / "realizations.yaml", scale)
    assert isinstance(study, Collection)
    assert len(study.parts) == 3
    assert [task.label for task in study.figures] == ["realizations-comparison"]
    # The minimally redundant array and the redundant one are compared with the paper.
    assert study.claims.roles == study.roles
    for part in study.parts.values():
        assert isinstance(part, Realizations)
        draws = {part_: block.count for block in part.experiment.realizations for part_ in block.draw}
        assert draws["gains"] >= 3
        assert draws["eor"] >= 3
