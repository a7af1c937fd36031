"""Every statement with the paper's solver and with the default one, on made-up runs in which only the bias differs."""

import json

import numpy as np
import pytest
from paper_runs import ADAMAX, EXPERIMENTS, LOW_SNR_FACTS, PAPER, run_folder, verdicts

from calstudy.base.errors import InputError
from calstudy.claims.evaluation import Claims, evaluate_by_solver, evaluate_folder
from calstudy.figures.members import SolverComparison
from calstudy.plotting.style import figure_arrays
from calstudy.run.task import Job
from calstudy.studies.load import load_study
from calstudy.verdicts.tables import CLAIMS_FILES

BIAS = "positive-bias-at-small-k"


@pytest.fixture
def studies(make_study):
    """Runs by role: Adamax leaves a bias of half the EoR at small k, the default none."""
    hexagon = {"noise": 0.003, "redundant_fraction": 0.9}
    return {
        "minimally_redundant": make_study("minimal"),
        "redundant": make_study("hexagon", **hexagon),
        "paper_solver": make_study("minimal-adamax", without_eor_bias=0.5, facts=ADAMAX),
        "redundant_paper_solver": make_study("hexagon-adamax", without_eor_bias=0.5, facts=ADAMAX, **hexagon),
    }


def test_every_statement_is_evaluated_with_either_solver(studies):
    columns = evaluate_by_solver([PAPER], studies)
    assert list(columns) == ["the paper's solver", "gauss-newton"]
    own, other = columns.values()
    assert [item.name for item in own] == [item.name for item in other] == [item.name for item in PAPER.statements()]
    members = {"minimal": "minimal-adamax", "hexagon": "hexagon-adamax"}
    for mine, theirs in zip(own, other, strict=True):
        assert {item.threshold for item in (mine, theirs)} == {mine.threshold}
        if theirs.runs:
            assert mine.runs == tuple(members[name] for name in theirs.runs)
    assert (verdicts(own)[BIAS], verdicts(other)[BIAS]) == ("supported", "undecided")
    # What is said of the paper's solver alone has no verdict with another.
    name = f"{BIAS}-with-papers-solver"
    assert (verdicts(own)[name], verdicts(other)[name]) == ("supported", "not evaluated")
    same = [a.verdict == b.verdict for a, b in zip(own, other, strict=True) if a.name.startswith("gains")]
    assert same
    assert all(same)


def test_there_is_no_such_table_without_the_same_study_with_either_solver(studies, make_study):
    assert evaluate_by_solver([PAPER], {role: studies[role] for role in ("minimally_redundant", "redundant")}) == {}
    assert evaluate_by_solver([PAPER], {role: studies[role] for role in ("redundant", "paper_solver")}) == {}
    low_snr = make_study("low", facts=LOW_SNR_FACTS)
    assert evaluate_by_solver([PAPER], {"low_snr": low_snr, "paper_solver": studies["paper_solver"]}) == {}


def test_the_folder_of_a_collection_gets_the_table_and_a_single_run_does_not(studies, tmp_path):
    runs = tmp_path / "runs"
    folder = runs / "both"
    folder.mkdir(parents=True)
    for study in studies.values():
        run = runs / f"{study.name}-1"
        run.mkdir()
        (run / "tables").symlink_to(study.folders[0])
        run_folder(study, run)
    members = {study.name: f"{study.name}-1" for study in studies.values()}
    roles = {role: study.name for role, study in studies.items()}
    manifest = {"name": "both", "stand_ins": ["a small sky"], "members": members, "roles": roles}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    evaluate_folder(folder)
    found = {row["name"]: row for row in json.loads((folder / "claims-by-solver.json").read_text())}
    assert {name: result["verdict"] for name, result in found[BIAS]["solvers"].items()} == {
        "the paper's solver": "supported",
        "gauss-newton": "undecided",
    }
    assert found[BIAS]["solvers"]["the paper's solver"]["runs"] == ["minimal-adamax"]
    # Nothing is said of run times, which none of the runs measures.
    assert not any("run-time" in name or "step" in name for name in found)
    assert "Stand-in: a small sky." in (folder / "claims-by-solver.md").read_text()
    alone = runs / "minimal-adamax-1"
    # Those of an earlier evaluation do not stay.
    for name in CLAIMS_FILES:
        (alone / name).write_text("earlier")
    evaluate_folder(alone)
    assert {path.name for path in alone.glob("claims*")} == {"claims.json", "claims.md"}


def as_collection(studies, output):
    """The claims of a collection with these members, written to a folder."""
    output.mkdir()
    tables = {
        f"{kind}:{study.name}": study.folders[0] for study in studies.values() for kind in ("spectra", "agreement")
    }
    return Claims(
        "claims",
        papers=[PAPER],
        title="both",
        notes=[],
        experiments={study.name: study.experiment for study in studies.values()},
        roles={role: study.name for role, study in studies.items()},
        tables=tables,
    ).make(output)


def test_the_product_of_a_collection_has_the_table_if_both_solvers_are_in_it(studies, tmp_path):
    as_collection(studies, tmp_path / "both")
    assert {path.name for path in (tmp_path / "both").iterdir()} == set(CLAIMS_FILES)
    default = {role: studies[role] for role in ("minimally_redundant", "redundant")}
    as_collection(default, tmp_path / "default")
    assert {path.name for path in (tmp_path / "default").iterdir()} == {"claims.json", "claims.md"}


def test_the_figure_shows_the_tables_of_the_members(studies, tmp_path):
    inputs = {f"spectra:{role}": study.folders[0] for role, study in studies.items()}
    settings = {"notes": ["a small sky"], "layouts": dict.fromkeys(studies)}
    drawing = SolverComparison().draw(Job(settings=settings, inputs=inputs, output=tmp_path))
    shown = figure_arrays(drawing.shown)
    for role, study in studies.items():
        for name in ("residual", "residual_without_eor"):
            np.testing.assert_array_equal(shown[f"{role}.{name}.power"], study.spherical(name, "outside-wedge").power)
    for table in study.folders[0].glob("residual_without_eor.*.h5"):
        table.unlink()
    with pytest.raises(InputError, match=r"the member in the role \w+ has no variant residual_without_eor"):
        SolverComparison().draw(Job(settings=settings, inputs=inputs, output=tmp_path))


def test_the_figure_shows_an_array_that_was_calibrated_with_both_solvers(studies, tmp_path):
    both = ("paper_solver", "minimally_redundant")
    assert tuple(SolverComparison().roles({*both, "redundant", "low_snr"})) == both
    assert set(SolverComparison().roles(studies)) == set(studies)
    # What is missing is told, if nothing can be shown.
    assert tuple(SolverComparison().roles({"paper_solver", "redundant"})) == both
    inputs = {f"spectra:{role}": studies[role].folders[0] for role in both}
    job = Job(settings={"notes": [], "layouts": dict.fromkeys(both)}, inputs=inputs, output=tmp_path)
    assert set(SolverComparison().draw(job).shown) == set(both)


@pytest.mark.parametrize("scale", [None, "small"])
def test_the_collection_with_the_papers_solver_plays_every_role_twice_and_shares_its_data(scale):
    collection = load_study(EXPERIMENTS / "paper-solver.yaml", scale)
    for role, own in PAPER.own_solver_roles.items():
        assert collection.roles[own] == f"{collection.roles[role]}-adamax"
        members = [collection.parts[collection.roles[name]] for name in (role, own)]
        stages = ("simulate", "gains", "corrupt")
        data, same_data = ({task.key for task in member.tasks if task.stage.name in stages} for member in members)
        assert data == same_data
        solver = members[1].experiment.calibration.solver
        assert (solver.name, solver.tolerance, solver.max_steps, solver.keep) == ("adamax", 0, 10_000, "last")
