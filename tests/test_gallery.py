"""The gallery shows what is in figures/: every folder, with its figure, its verdicts, and the command that made it."""

from __future__ import annotations

import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from calstudy.studies.kinds.collection import Collection
from calstudy.studies.load import load_study
from calstudy.verdicts.tables import OUTCOMES, from_json, outcomes_of_sentences

ROOT = Path(__file__).parents[1]
FOLDERS = sorted(path.name for path in (ROOT / "figures").iterdir() if path.is_dir())
SECTIONS = {
    re.findall(r"!\[[^\]]+\]\(\.\./figures/([^/]+)/", section)[0]: section
    for section in re.split(r"^## .+\n", (ROOT / "docs/gallery.md").read_text(), flags=re.MULTILINE)[1:]
}
"""By the folder of the figure."""

folders = pytest.mark.parametrize("folder", FOLDERS)


@cache
def names_made_by(experiment: str) -> set[str]:
    """Of the study of a file, and of its members."""
    study = load_study(ROOT / experiment)
    members = set(study.members) if isinstance(study, Collection) else set()
    return {study.name} | members


def test_every_folder_has_a_section():
    assert sorted(SECTIONS) == FOLDERS


@folders
def test_the_figure_is_in_the_folder(folder):
    [path] = re.findall(r"!\[[^\]]+\]\(\.\./(.*?)\)", SECTIONS[folder])
    assert (ROOT / path).is_file()


@folders
def test_the_verdicts_are_those_of_the_claims(folder):
    path = ROOT / "figures" / folder / "claims.json"
    claims = from_json(path.read_text()) if path.exists() else []
    counts = Counter(outcomes_of_sentences(claims).values())
    text = " ".join(SECTIONS[folder].split())
    told = {verdict: int(count) for count, verdict in re.findall(rf"(\d+) ({'|'.join(OUTCOMES)})", text)}
    assert told == {verdict: counts[verdict] for verdict in OUTCOMES if counts[verdict]}


@folders
def test_the_command_makes_the_study(folder):
    [experiment] = re.findall(r"^calstudy run (\S+)(?: --scale small)?$", SECTIONS[folder], re.MULTILINE)
    assert folder in names_made_by(experiment)
