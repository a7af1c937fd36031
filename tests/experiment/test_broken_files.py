"""Hundreds of broken experiment files through the command line: sentences that name the field, never a traceback."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from broken import Broken, all_broken, bad_layouts, bad_texts, missing_files
from command_line import run_command
from tiny import tiny

REFUSED = 2
HARMLESS = 40
"""Generated changes that are no mistakes, at most: the description may be anything."""


def faulty(item: Broken, status: int, message: str) -> str:
    """Return what is wrong with an answer to a broken file, or nothing."""
    if status == 0:
        return ""
    if status != REFUSED:
        return f"{item.name}: exit status {status}"
    if any(not line.startswith("calstudy: ") or len(line) < 20 for line in message.strip().splitlines()):
        return f"{item.name}: not a sentence: {message!r}"
    if item.field and not any(name in message for name in item.field):
        return f"{item.name}: names none of {item.field}: {message!r}"
    return ""


def test_every_broken_file_is_refused_with_sentences_that_name_the_field(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    items = all_broken(tmp_path)
    answers = []
    for item in items:
        Path("file.yaml").write_bytes(item.text)
        answers.append((item, *run_command(capsys, "plan", "file.yaml")))
    assert [fault for fault in (faulty(*answer) for answer in answers) if fault] == []
    refused = [item for item, status, _ in answers if status == REFUSED]
    assert len(refused) >= 200
    assert len(items) - len(refused) <= HARMLESS
    # Nothing in a file is ever run.
    assert not Path("pwned").exists()


@pytest.mark.parametrize("make", [bad_texts, missing_files, bad_layouts])
def test_none_of_the_hand_written_ones_is_taken_for_good(make, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for item in make(tmp_path):
        Path("file.yaml").write_bytes(item.text)
        assert run_command(capsys, "plan", "file.yaml")[0] == REFUSED, item.name


@pytest.mark.parametrize(
    "option",
    [
        "sky.eor.seed",
        "=3",
        "sky.eor.seed=[",
        "sky.eor.seed=!!python/object/apply:os.system ['touch pwned']",
        "sky..seed=3",
        "nowhere.at.all=3",
        "name.x=3",
        "corruption.noise.factor=.nan",
        "outputs.store=~nobody-of-that-name/store",
    ],
)
def test_broken_overrides_are_refused_in_a_sentence(option, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    status, message = run_command(capsys, "plan", "file.yaml", "--set", option)
    assert status == REFUSED
    assert message.startswith("calstudy: ")
    assert not Path("pwned").exists()


def test_object_tags_are_refused_by_name(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file.yaml").write_text("name: !!python/object/apply:os.system ['touch pwned']\n")
    status, message = run_command(capsys, "plan", "file.yaml")
    assert status == REFUSED
    assert "python/object/apply:os.system is refused" in message


@pytest.mark.parametrize("file", ["nowhere.yaml", ".", "/dev/null/x.yaml"])
def test_an_experiment_that_cannot_be_read_is_named(file, capsys):
    status, message = run_command(capsys, "plan", file)
    assert status == REFUSED
    assert file in message
