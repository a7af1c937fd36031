"""The command line: quick, and clear about mistakes."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
import yaml
from command_line import run_and_read, run_command
from tiny import of_the_paper, tiny

from calstudy.calibrate.settings import BasisSettings
from calstudy.cli import main as cli
from calstudy.cli.options import SECTIONS
from calstudy.experiment.files import override, validate
from calstudy.experiment.model import FIGURES
from calstudy.instrument.as_built import AsBuilt
from calstudy.studies.reference import field_reference

EXPERIMENTS = Path(__file__).parents[1] / "experiments"


def calstudy(*arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "calstudy", *arguments], capture_output=True, text=True, cwd=cwd, check=False
    )


def refused(result: subprocess.CompletedProcess) -> str:
    assert result.returncode == 2
    assert "Traceback" not in result.stderr
    return result.stderr


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    """The folder of a test, in which commands are run, with lines of 160 letters."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    return tmp_path


def test_every_command_is_in_a_section_of_the_help():
    listed = [name for names in SECTIONS.values() for name in names]
    assert sorted(listed) == sorted(typer.main.get_command(cli.app).commands)


def plan_of(capsys, file: str) -> str:
    """Return what ``calstudy plan`` prints."""
    status, written = run_and_read(capsys, "plan", file)
    assert status == 0, written.err
    return written.out


def imported_by(code: str, names: tuple[str, ...], cwd: Path) -> list[str]:
    """Return which of some packages a program imports, in a process of its own."""
    told = f"import sys\n{code}\nprint([name for name in {names} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, cwd=cwd, check=False)
    assert result.returncode == 0, result.stderr
    return ast.literal_eval(result.stdout.splitlines()[-1])


def test_help_imports_nothing_heavy(tmp_path):
    heavy = ("numpy", "scipy", "tensorflow", "pyuvdata", "dask", "matplotlib", "pydantic")
    assert imported_by("import calstudy.cli.main", heavy, tmp_path) == []


# Tenths of a second to seconds each; a plan reads and estimates, and makes no product.
SLOW_TO_IMPORT = (
    *("tensorflow", "hera_pspec", "hera_cal", "pyuvdata", "pyuvsim", "pyradiosky", "fftvis", "matvis", "numba"),
    *("healpy", "dask", "distributed", "matplotlib", "jinja2", "pooch", "requests"),
    *("astropy.coordinates", "astropy.cosmology", "astropy.table", "astropy.time"),
    # scipy.special counts the nodes of a simulation.
    *("scipy.constants", "scipy.integrate", "scipy.interpolate", "scipy.linalg", "scipy.ndimage", "scipy.optimize"),
    *("scipy.signal", "scipy.sparse", "scipy.spatial", "scipy.stats"),
)


def test_calibrators_leave_keras_to_those_who_use_it(tmp_path):
    packages = ("tensorflow", "keras", "sklearn")
    assert imported_by("import calstudy.calibrate.calamity", packages, tmp_path) == ["tensorflow"]


def test_plans_import_no_library_that_only_stages_need(tmp_path):
    """Of an experiment, a sweep, a collection, a run-time study and a quick start, one after the other."""
    names = ("minredundant", "signalloss", "paper", "runtime", "quickstart")
    places = f"'--set', 'outputs.store={tmp_path}/store', '--set', 'outputs.runs={tmp_path}/runs'"
    code = (
        "from calstudy.cli.main import main\n"
        f"for name in {names}:\n"
        f"    sys.argv = ['calstudy', 'plan', f'{EXPERIMENTS}/{{name}}.yaml', {places}]\n"
        "    try:\n        main()\n"
        "    except SystemExit as end:\n        assert not end.code, name"
    )
    assert imported_by(code, SLOW_TO_IMPORT, tmp_path) == []


def test_a_plan_with_every_figure_imports_no_library_that_only_stages_need(tmp_path):
    drawn = [
        name
        for name in FIGURES.built_in()
        if FIGURES.find(name).refusal(FIGURES.make(name), validate(of_the_paper(tmp_path), tmp_path)) is None
    ]
    assert len(drawn) >= 10
    data = override(of_the_paper(tmp_path), "outputs.figures", drawn)
    # With fewer channels than sequences are asked for, the foreground basis is made to see that it leaves any free.
    data = override(data, "instrument.channels.count", 64)
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(data))
    code = (
        "sys.argv = ['calstudy', 'plan', 'tiny.yaml']\n"
        "from calstudy.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code"
    )
    assert imported_by(code, SLOW_TO_IMPORT, tmp_path) == []


def test_all_faults_of_a_file_are_told_on_standard_error(here, capsys):
    (here / "bad.yaml").write_text("{name: bad, bogus: 1, instrument: {channels: {width: 80}}}")
    status, told = run_command(capsys, "run", "bad.yaml")
    assert status == 2
    assert [line.split(":")[1].strip() for line in told.splitlines()] == ["instrument.channels.width", "bogus"]
    assert not (here / "store").exists()
    assert not (here / "runs").exists()


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
        (["run", "tiny.yaml", "--set", "instrument.layout.spacing=250 m"], "the longest baseline has 500 m"),
        (
            ["plan", "tiny.yaml", "--set", "calibration.basis.buffer=10 us"],
            "calibration.basis: a delay half-width",
        ),
        (["examples"], "'examples' was a command of earlier versions; use calstudy init --list"),
        (["data", "fetch", "gleem"], "nothing that can be fetched (allowed: gleam, beam, g4jy, haslam)"),
    ],
)
def test_a_mistake_is_one_clear_sentence(tmp_path, monkeypatch, capsys, arguments, told):
    monkeypatch.chdir(tmp_path)
    Path("tiny.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    status, error = run_command(capsys, *arguments)
    assert status == 2
    assert told in error
    assert "Traceback" not in error


def test_a_scheduler_that_is_not_there_is_one_clear_sentence(tmp_path, monkeypatch):
    """In a process of its own: dask tries for a while, and leaves threads behind."""
    monkeypatch.setenv("DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT", "3s")
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    arguments = ["run", "tiny.yaml", "--scheduler", "tcp://127.0.0.1:1"]
    assert "tcp://127.0.0.1:1: cannot connect" in refused(calstudy(*arguments, cwd=tmp_path))


def test_an_interrupted_command_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("calstudy.studies.load.load_study", interrupted)
    status, told = run_command(capsys, "run", tmp_path / "tiny.yaml")
    assert status == 130
    assert told.strip() == "calstudy: interrupted; what is in the store is kept, and a run goes on from there"


CRASH = """
import ctypes, os
from calstudy.cli import main as cli

def crash():
    # As a run does: standard error goes to a file.
    os.dup2(os.open("run.log", os.O_WRONLY | os.O_CREAT), 2)
    ctypes.string_at(0)

cli.app = crash
cli.main()
"""


def test_a_crash_of_a_library_shows_on_the_terminal_where_it_was(tmp_path):
    result = subprocess.run([sys.executable, "-c", CRASH], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode < 0
    assert "Segmentation fault" in result.stderr
    assert "in crash" in result.stderr


def test_what_a_terminal_cannot_show_is_a_question_mark(tmp_path):
    code = "from calstudy.cli import main as cli\ncli.app = lambda: print('1 \xb1 2')\ncli.main()"
    environment = {**os.environ, "PYTHONIOENCODING": "ascii:strict"}
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout == "1 ? 2\n"


def test_a_file_of_the_working_folder_is_not_taken_for_a_module_of_python(tmp_path, monkeypatch):
    # As in an environment that is in the working folder.
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "calstudy").symlink_to(Path(__file__).parents[1] / "calstudy")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "site"))
    for name in ("array", "copy", "logging", "signal"):
        (tmp_path / f"{name}.py").write_text("raise ImportError('not this one')")
    result = calstudy("--version", cwd=tmp_path)
    assert result.returncode == 0, result.stderr


def test_a_plan_computes_and_writes_nothing(here, capsys):
    (here / "tiny.yaml").write_text(yaml.safe_dump(tiny(here)))
    told = plan_of(capsys, "tiny.yaml")
    assert "simulate-chunk" in told
    assert "stand-in: sky: G4Jy" in told
    assert [path.name for path in here.iterdir()] == ["tiny.yaml"]


def products_by_stage(plan: str) -> dict[str, str]:
    rows = [line.split("│") for line in plan.splitlines() if "│" in line]
    return {row[1].strip(): row[2].strip() for row in rows}


def test_a_plan_of_a_sweep_counts_what_its_points_share_once(here, capsys):
    sweep = {"calibration.basis.buffer": ["50 ns", "100 ns", "200 ns"]}
    data = override({**tiny(here), "sweep": sweep}, "outputs.figures", ["layout"])
    (here / "tiny.yaml").write_text(yaml.safe_dump(data))
    told = plan_of(capsys, "tiny.yaml")
    counts = products_by_stage(told)
    # The figures are one layout for all points, and that of the sweep.
    assert (counts["simulate"], counts["transfer"], counts["figure"]) == ("2", "3", "2")
    assert told.count("run folder: ") == 4


def test_a_plan_of_a_collection_counts_what_its_members_share_once(here, capsys):
    (here / "tiny.yaml").write_text(yaml.safe_dump(of_the_paper(here)))
    members = ["tiny.yaml", {"file": "tiny.yaml", "name": "louder", "overrides": {"corruption.noise.factor": 5}}]
    (here / "both.yaml").write_text(yaml.safe_dump({"name": "both", "experiments": members}))
    told = plan_of(capsys, "both.yaml")
    counts = products_by_stage(told)
    # Claims of each, and of both together.
    assert (counts["simulate"], counts["gains"], counts["claims"]) == ("2", "1", "3")
    assert told.count("run folder: ") == 3


@pytest.mark.parametrize("command", ["claims", "report"])
def test_what_is_no_run_is_refused(here, capsys, command):
    status, told = run_command(capsys, command, ".")
    assert status == 2
    assert told.count("\n") == 1
    assert "not the folder of a finished run" in told


def test_one_section_of_the_reference_has_its_fields_and_those_of_the_sections_inside(capsys):
    whole = field_reference()
    for section, fields in {
        "calibration.basis": BasisSettings.model_fields,
        "instrument.as_built": AsBuilt.model_fields,
        "observed.select": ["frequencies"],
    }.items():
        cli.app(["fields", section], standalone_mode=False)
        text = capsys.readouterr().out
        assert all(f"`{name}`" in text or f".{name}`" in text for name in fields)
        assert set(re.findall(r"^#+ `([\w.]+)", text, re.MULTILINE)) == {
            path for path in re.findall(r"^#+ `([\w.]+)", whole, re.MULTILINE) if f"{path}.".startswith(f"{section}.")
        }


def test_a_section_that_is_none_is_refused_with_the_nearest(capsys):
    status, text = run_command(capsys, "fields", "calibration.bases")
    assert status == 2
    assert "did you mean 'calibration.basis'" in text
