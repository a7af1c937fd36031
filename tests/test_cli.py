"""The command line: quick, and clear about mistakes."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from tiny import tiny

from calstudy.experiment.reference import field_reference


def calstudy(*arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "calstudy", *arguments], capture_output=True, text=True, cwd=cwd, check=False
    )


def refused(result: subprocess.CompletedProcess) -> str:
    assert result.returncode == 2
    assert "Traceback" not in result.stderr
    return result.stderr


def test_help_imports_nothing_heavy(tmp_path):
    code = (
        "import sys, calstudy.cli; print([m for m in ('numpy', 'tensorflow', 'pyuvdata', 'dask') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=True)
    assert result.stdout.strip() == "[]"


def test_all_faults_of_a_file_are_told_on_standard_error(tmp_path):
    (tmp_path / "bad.yaml").write_text("{name: bad, bogus: 1, instrument: {channels: {width: 80}}}")
    told = refused(calstudy("run", "bad.yaml", cwd=tmp_path)).splitlines()
    assert [line.split(":")[1].strip() for line in told] == ["instrument.channels.width", "bogus"]
    assert not (tmp_path / "store").exists()
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["run", "none.yaml"], "none.yaml: cannot be read"),
        (["run", "tiny.yaml", "--scale", "smal"], "--scale smal: not a scale of this experiment"),
        (
            ["run", "tiny.yaml", "--set", "instrument.layout=mwa-compact-hexeast"],
            "did you mean 'mwa-compact-hex-east'?",
        ),
        (["run", "tiny.yaml", "--set", "instrument.channels.count"], "write a dotted path and a value"),
        (["run", "tiny.yaml", "--set", "sky.foregrounds={kind: file, path: no.fits}"], "no such file"),
        (["run", "tiny.yaml", "--set", "sky.foregrounds={kind: gleam}"], "calstudy data fetch gleam"),
        (["run", "tiny.yaml", "--set", "outputs.store=/proc/no"], "outputs.store = '/proc/no': cannot be written"),
        (["run", "tiny.yaml", "--set", "outputs.runs=/proc/no"], "outputs.runs = '/proc/no': cannot be written"),
        (["run", "tiny.yaml", "--scheduler", "tcp://127.0.0.1:1"], "tcp://127.0.0.1:1: cannot connect"),
        (["run", "tiny.yaml", "--set", "instrument.layout.spacing=250 m"], "the longest baseline has 500 m"),
        (["data", "fetch", "gleem"], "nothing that can be fetched (allowed: gleam, beam)"),
    ],
)
def test_a_mistake_is_one_clear_sentence(tmp_path, arguments, told):
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    assert told in refused(calstudy(*arguments, cwd=tmp_path))


def test_a_plan_computes_and_writes_nothing(tmp_path):
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    result = calstudy("plan", "tiny.yaml", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "simulate-chunk" in result.stdout
    assert "stand-in: sky: G4Jy" in result.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.yaml"]


def products_by_stage(plan: str) -> dict[str, str]:
    rows = [line.split("│") for line in plan.splitlines() if "│" in line]
    return {row[1].strip(): row[2].strip() for row in rows}


def test_a_plan_of_a_sweep_counts_what_its_points_share_once(tmp_path):
    sweep = {"calibration.basis.buffer": ["50 ns", "100 ns", "200 ns"]}
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump({**tiny(tmp_path), "sweep": sweep}))
    result = calstudy("plan", "tiny.yaml", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    counts = products_by_stage(result.stdout)
    assert (counts["simulate"], counts["transfer"], counts["sweep"]) == ("2", "3", "1")


def test_a_plan_of_a_collection_counts_what_its_members_share_once(tmp_path):
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    members = ["tiny.yaml", {"file": "tiny.yaml", "name": "louder", "overrides": {"corruption.noise.factor": 5}}]
    (tmp_path / "both.yaml").write_text(yaml.safe_dump({"name": "both", "experiments": members}))
    result = calstudy("plan", "both.yaml", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    counts = products_by_stage(result.stdout)
    assert (counts["simulate"], counts["gains"], counts["claims"]) == ("2", "1", "2")
    assert counts["combined-claims"] == "1"
    assert result.stdout.count("run folder: ") == 3


def test_claims_of_what_is_no_run_are_refused(tmp_path):
    assert "not the folder of a finished run" in refused(calstudy("claims", ".", cwd=tmp_path))


def test_a_report_of_what_is_no_run_is_refused(tmp_path):
    assert "not the folder of a finished run" in refused(calstudy("report", ".", cwd=tmp_path))


def test_the_field_reference_in_the_docs_is_current():
    path = Path(__file__).parents[1] / "docs" / "experiments.md"
    assert path.read_text() == field_reference(), "run: python -m calstudy fields > docs/experiments.md"
