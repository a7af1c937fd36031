"""The how-to pages: files are valid, figures are there and small; followed as printed, a page makes its figures."""

from __future__ import annotations

import ast
import re
import shlex
from pathlib import Path

import pytest
from how_to_pages import DOCS, PAGES, HowTo, follow, read_page

from calstudy.base.package_files import published
from calstudy.run.execution import Budget
from calstudy.studies.load import load_study

LARGEST = 150_000
"""Of a figure that is kept with the text, in bytes."""

pages = pytest.mark.parametrize("page", [read_page(path) for path in PAGES], ids=lambda page: page.name)


def written(page: HowTo, folder: Path) -> None:
    """Write what a page shows, and the experiments that it copies."""
    for name, text in page.files.items():
        (folder / name).write_text(text, encoding="utf-8")
    for name, example in re.findall(r"^calstudy init (\S+) --example (\S+)$", page.script, re.MULTILINE):
        text = (published("experiments") / f"{example}.yaml").read_text(encoding="utf-8")
        (folder / f"{name}.yaml").write_text(text.replace(f"name: {example}\n", f"name: {name}\n"), encoding="utf-8")


def test_every_page_is_in_the_table_and_in_the_contents():
    index = (DOCS / "how-to" / "index.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"\]\(([\w-]+)\.md\)", index)) == [path.stem for path in PAGES]
    assert sorted(re.findall(r"^([\w-]+)$", index.partition("{toctree}")[2], re.MULTILINE)) == [
        path.stem for path in PAGES
    ]


@pages
def test_a_page_has_commands_and_figures_of_moderate_size(page):
    assert page.script
    # What the page on long runs tells does not change any figure.
    assert page.figures or page.name == "large-runs"
    for shown in page.figures:
        assert shown.stat().st_size < LARGEST


def test_no_figure_is_left_over():
    shown = {path for page in PAGES for path in read_page(page).figures}
    assert set((DOCS / "figures" / "how-to").iterdir()) == shown


@pages
def test_the_experiments_and_programs_of_a_page_are_valid(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(page, tmp_path)
    for name, text in page.files.items():
        if name.endswith(".py"):
            ast.parse(text)
            if "from calstudy" not in text:
                exec(compile(text, name, "exec"), {})
    for line in page.script.splitlines():
        words = shlex.split(line, comments=True)
        if words[:2] == ["calstudy", "run"]:
            changes = [words[place + 1] for place, word in enumerate(words) if word == "--set"]
            study = load_study(Path(words[2]), overrides=changes)
            # Which also reads beams and catalogues.
            assert study.sized_to(Budget(workers=1))[0].name


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    """Products of all pages: many of them start from the same experiment."""
    return tmp_path_factory.mktemp("products") / "store"


@pytest.mark.slow
@pages
def test_a_page_that_is_followed_makes_its_figures(page, tmp_path, store):
    made = follow(page, tmp_path / page.name, store)
    assert all(path.stat().st_size > 0 for path in made.values())
