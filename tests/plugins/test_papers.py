"""A paper of one's own, from a single file: by its path, and installed with an entry point."""

from __future__ import annotations

import io
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from command_line import run_command
from installed import install
from plugin_files import sections
from rich.console import Console
from tiny import tiny

from calstudy.base.errors import InputError
from calstudy.base.user_code import load_file
from calstudy.claims.evaluation import evaluate_folder
from calstudy.experiment.files import override, validate
from calstudy.experiment.model import PAPERS
from calstudy.papers.barry2016 import Barry2016
from calstudy.regression import accept, read_reference
from calstudy.report.page import read_contents
from calstudy.results.reader import RunFolder
from calstudy.run.execution import Budget
from calstudy.studies.load import load_study
from calstudy.studies.show import show_run
from calstudy.studies.study import Run, run_study
from calstudy.verdicts.tables import from_json

CODE = sections()["A paper"]["python"]
VERDICTS = {"gains-recovered": "supported", "signal-kept": "contradicted"}
BROKEN = CODE.replace('run.measured("gains_aligned")', "run.gains")


@pytest.fixture(scope="module")
def folder(tmp_path_factory, shared_store) -> Path:
    """Where all runs of this file go: they share the products of the tiny experiment."""
    folder = tmp_path_factory.mktemp("papers")
    (folder / "store").symlink_to(shared_store)
    return folder


def run_of(folder: Path, *papers: str, **changes) -> tuple[Run, str]:
    """Run the tiny experiment, compared with papers; return the run, and what the terminal shows."""
    (folder / "hexagons.py").write_text(CODE)
    data = {**override(tiny(folder), "outputs.figures", []), "papers": list(papers), **changes}
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(data))
    run, text = run_study(load_study(path), Budget(workers=1)), io.StringIO()
    show_run(run, Console(file=text, width=300))
    return run, text.getvalue()


def verdicts(folder: Path) -> dict[str, str]:
    return {claim.name: claim.verdict for claim in from_json((folder / "claims.json").read_text())}


def test_its_statements_are_judged_as_they_come_out(folder):
    run, shown = run_of(folder, "hexagons.py")
    assert verdicts(run.folder) == VERDICTS
    claims = {claim.name: claim for claim in from_json((run.folder / "claims.json").read_text())}
    assert claims["gains-recovered"].measured < 0.2
    assert claims["signal-kept"].measured < 0.98
    assert claims["signal-kept"].runs == ("tiny",)
    text = (run.folder / "claims.md").read_text()
    assert "no EoR is lost outside the wedge" in text
    assert "claim contradicted: signal-kept" in shown
    assert "claims: 2 sentences: 1 supported, 1 contradicted; 2 statements: 1 supported, 1 contradicted" in shown
    (table,) = [table for table in read_contents(RunFolder(run.folder)).tables if table.title == "Claims of the paper"]
    assert [row[-1] for row in table.rows] == ["supported", "contradicted"]


def test_one_that_derives_from_a_built_in_paper_has_its_statements(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "from calstudy.papers.barry2016 import Barry2016\n\n\n"
        "class Mine(Barry2016):\n    usual_members = {'incomplete': 'another'}\n"
    )
    (mine,) = validate({"name": "mine", "papers": [str(path)]}, tmp_path).papers
    assert mine.statements() == Barry2016(kind="barry2016").statements() != []


def test_it_leaves_out_bins_without_modes(tmp_path):
    (tmp_path / "hexagons.py").write_text(CODE)
    spectrum = SimpleNamespace(k=np.array([0.2, 0.4, 0.6]), power=np.array([1, 2, np.nan], complex))
    kept = load_file(tmp_path / "hexagons.py").signal_kept
    assert kept.measure(SimpleNamespace(spherical=lambda *_: spectrum)).value == 1


def test_an_installed_one_is_used_by_its_name_and_beside_others(folder, monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, "hexagons_package", CODE, "calstudy.papers: hexagons = hexagons_package", "1.0")
    run, _ = run_of(folder, "hexagons", "calamity2022")
    found = verdicts(run.folder)
    assert {name: found[name] for name in VERDICTS} == VERDICTS
    assert found["redundant-signal-recovered"] != "not evaluated"


def test_a_finished_run_is_held_to_it_by_the_command(folder, capsys):
    run, shown = run_of(folder)
    assert not (run.folder / "claims.json").exists()
    assert "claim" not in shown
    assert "Claims" not in (run.folder / "report.html").read_text()
    status, told = run_command(capsys, "claims", run.folder)
    assert (status, "names no papers; give one with --paper (" in told, "or a file.py)" in told) == (2, True, True)
    assert run_command(capsys, "claims", run.folder, "--paper", folder / "hexagons.py") == (0, "")
    assert verdicts(run.folder) == VERDICTS
    for path in ("claims.json", "claims.md"):
        (run.folder / path).unlink()


def test_a_run_without_papers_can_be_a_reference(folder, tmp_path):
    run, _ = run_of(folder)
    accept(run.folder, tmp_path)
    assert not (tmp_path / "claims.json").exists()
    assert read_reference(tmp_path).claims == []


def test_a_run_that_plays_no_role_says_why_and_has_no_table(folder):
    (folder / "lines.py").write_text(CODE.replace('"hex"', '"linear"').replace("not 'hex'", "not 'linear'"))
    run, shown = run_of(folder, "lines.py")
    sentence = "The run plays no role in lines: instrument.layout is 'hex', not 'linear' (hexagon)."
    assert verdicts(run.folder) == {}
    assert sentence in (run.folder / "claims.md").read_text()
    assert sentence in (run.folder / "report.html").read_text().replace("&#39;", "'")
    assert "claims: none, for the run plays no role" in shown
    assert evaluate_folder(run.folder).without_role == (sentence,)


def test_a_users_calibrator_plays_no_role_in_another_paper(folder):
    (folder / "stefcal.py").write_text(sections()["A calibrator"]["python"])
    data = {**tiny(folder), "calibration": {"calibrator": "stefcal.py"}, "papers": ["calamity2022"]}
    experiment = validate(data, folder)
    (paper,) = experiment.papers
    for role in ("minimally_redundant", "redundant", "redundant_modelling", "low_snr", "paper_solver"):
        assert "stefcal.py" in paper.refusal(role, experiment)


def test_the_content_of_the_file_decides_the_claims(tmp_path):
    (tmp_path / "hexagons.py").write_text(CODE)
    data = {**tiny(tmp_path), "papers": ["hexagons.py"]}
    path = tmp_path / "experiment.yaml"
    path.write_text(yaml.safe_dump(data))
    first = load_study(path).claims.key
    assert load_study(path).claims.key == first
    (tmp_path / "hexagons.py").write_text(CODE.replace("AtLeast(0.98)", "AtLeast(0.2)"))
    assert load_study(path).claims.key != first


def test_what_goes_wrong_in_it_is_told_with_its_line(folder):
    run, _ = run_of(folder)
    (folder / "broken.py").write_text(BROKEN)
    line = next(number for number, text in enumerate(BROKEN.splitlines(), 1) if "run.gains" in text)
    with pytest.raises(InputError) as caught:
        evaluate_folder(run.folder, [str(folder / "broken.py")])
    told = str(caught.value)
    assert told.startswith(f"broken.py line {line}, in gains_recovered: AttributeError: ")
    with pytest.raises(InputError, match="'calamty' is not a paper"):
        evaluate_folder(run.folder, ["calamty"])


def test_members_of_a_collection_play_its_roles(folder):
    run_of(folder, "hexagons.py")
    path = folder / "collection.yaml"
    collection = {"name": "several", "experiments": ["experiment.yaml"], "roles": {"hexagon": "tiny"}}
    path.write_text(yaml.safe_dump(collection))
    run = run_study(load_study(path), Budget(workers=1))
    assert verdicts(run.folder) == VERDICTS
    assert evaluate_folder(run.folder).verdicts == from_json((run.folder / "claims.json").read_text())
    assert json.loads((run.folder / "manifest.json").read_text())["roles"] == {"hexagon": "tiny"}


def test_papers_of_modules_with_one_name_keep_their_own_statements(tmp_path):
    code = """
from types import SimpleNamespace
from calstudy.claims.paper import Paper
from calstudy.verdicts.statement import Statement

class Base(Paper):
    kind: str = ""

class Said(Statement):
    name: str = NAME

SAID = Said.__new__(Said)
"""
    found = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "common.py").write_text(code.replace("NAME", repr(name)))
        (tmp_path / name / "p.py").write_text("from common import Base\n\n\nclass P(Base):\n    kind: str = ''\n")
        found.append(PAPERS.make(str(tmp_path / name / "p.py")))
    assert [[item.name for item in paper.statements()] for paper in found] == [["a"], ["b"]]
