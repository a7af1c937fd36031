"""``calstudy which``: arrays and beams as options, the answer of a tiny run, and faults in the words of the options."""

import json
from pathlib import Path

import pytest
from command_line import run_and_read, run_command

from calstudy.cli.which import array_changes
from calstudy.studies.load import load_study

POSITIONS = [(0, 0), (14, 0), (28, 0), (7, 12), (21, 12), (14, 24)]


@pytest.fixture
def positions(tmp_path, monkeypatch):
    """A CSV file of positions in the working directory."""
    monkeypatch.chdir(tmp_path)
    rows = "\n".join(f"{east},{north},0" for east, north in POSITIONS)
    (tmp_path / "mine.csv").write_text(f"east_m,north_m,up_m\n{rows}\n", encoding="utf-8")
    return "mine.csv"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("hera-19", None, None), {"instrument.layout": "hera-19", "instrument.beam": "hera"}),
        (("hex", None, None), {"instrument.layout": "hex", "instrument.beam": "mwa-embedded-element"}),
        (
            ("{kind: hex, side: 2}", "mwa", "airy"),
            {
                "instrument.layout": "{kind: hex, side: 2}",
                "instrument.location": "mwa",
                "instrument.beam": "airy",
            },
        ),
        (
            ("hex", "-30.5, 21", "airy"),
            {
                "instrument.layout": "hex",
                "instrument.location": "{latitude: -30.5 deg, longitude: 21 deg}",
                "instrument.beam": "airy",
            },
        ),
    ],
)
def test_array_site_and_beam_become_fields_of_the_experiment(arguments, expected):
    assert dict(text.split("=", 1) for text in array_changes(*arguments)) == expected


def test_files_are_found_from_the_working_directory(positions, tmp_path):
    layout, _, beam = array_changes(positions, "hera", "dish.beamfits")
    assert json.loads(layout.partition("=")[2]) == {"kind": "csv", "path": str(tmp_path / "mine.csv")}
    assert json.loads(beam.partition("=")[2]) == {"kind": "beamfits", "path": str(tmp_path / "dish.beamfits")}


def test_the_beam_of_an_unknown_array_must_be_given(positions, capsys):
    status, written = run_command(capsys, "which", positions, "--site", "ovro-lwa", "--dry-run")
    assert status == 2
    assert written.startswith("calstudy: --beam: is needed, because none is known for this array and site: the name")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("missing.csv", "--site", "mars"), ["LAYOUT = ", "--site: 'mars' is not a", "--beam: is needed"]),
        (("mine.csv",), ["--site: is required", "--beam: is needed"]),
        (("{kind: hex, side: 0}", "--beam", "dish"), ["LAYOUT.side = 0: must", "--beam: 'dish' is not a beam"]),
        (("mine.csv", "--set", "foo.bar=3", "--site", "hera"), ["foo: unknown key"]),
        (("missing.csv", "--set", "foo.bar=3"), ["LAYOUT = ", "--beam: is needed", "foo: unknown key"]),
    ],
)
def test_all_faults_of_the_options_are_said_at_once(positions, capsys, arguments, named):
    status, written = run_command(capsys, "which", *arguments, "--dry-run")
    assert status == 2
    assert len(written.splitlines()) == len(named)
    for line, start in zip(written.splitlines(), named, strict=True):
        assert line.startswith(f"calstudy: {start}")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("nonsense",), "LAYOUT: 'nonsense' is not a layout"),
        (("missing.csv", "--site", "hera"), "LAYOUT = "),
        (("mine.csv", "--beam", "airy"), "--site: is required"),
        (("hera-19", "--beam", "dish"), "--beam: 'dish' is not a beam"),
        (("hex", "--site", "95,3", "--beam", "airy"), "--site"),
    ],
)
def test_faults_are_in_the_words_of_the_options_and_said_once(positions, capsys, arguments, sentence):
    status, written = run_command(capsys, "which", *arguments, "--dry-run")
    assert status == 2
    assert written.startswith(f"calstudy: {sentence}")
    assert len(written.splitlines()) == 1
    assert "other cases" not in written


@pytest.mark.parametrize(
    "options", [("{kind: csv, path: mine.csv}",), ("hex", "--set", "instrument.layout={kind: csv, path: mine.csv}")]
)
def test_paths_in_blocks_and_in_set_start_at_the_working_directory(positions, capsys, options):
    status, written = run_and_read(capsys, "which", *options, "--site", "hera", "--beam", "airy", "--dry-run")
    assert status == 0, written.err
    assert "\n6 antennas" in written.out


def test_an_array_without_redundancy_loses_the_calibrator_that_needs_it():
    study = load_study(Path("which"), None, array_changes("golomb", None, None))
    refused = {study.title(label).partition(" in ")[0] for label in study.refusals}
    assert refused == {"redcal"}
    assert any(note.startswith("redcal cannot work in any world: ") for note in study.notes)


@pytest.mark.chain
def test_a_run_ends_with_an_answer(positions, tmp_path, capsys):
    tiny = (
        "instrument.channels.count=32",
        "sky.foregrounds.count=200",
        "sky.eor.nside=16",
        "calibrators={sky-based: sky-based}",
        "worlds={ideal: {}, half known: {calibration.assumed.sky.foregrounds.count: 100}}",
        "figures=[comparison-matrix]",
    )
    changes = [text for change in tiny for text in ("--set", change)]
    options = ("--site", "mwa", "--beam", "gaussian", "--workers", "1", "--output", "answers")
    status, written = run_and_read(capsys, "which", positions, *options, *changes)
    assert status == 0
    assert "6 antennas (csv)" in written.out
    # The missing half is far more than the EoR, and a fit of gains alone leaves it in the data.
    assert "Bias below 0.1 of the EoR in all 2 worlds?" in written.out
    assert "fails in half known" in " ".join(written.out.split())
    (folder,) = (tmp_path / "answers").iterdir()
    assert (folder / "figures" / "comparison-matrix.png").is_file()
