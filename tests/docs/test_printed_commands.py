"""Every command that a page or a notebook prints is one that calstudy takes, with these options and these files."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import nbformat
import pytest
from typer.main import get_command

from calstudy.base.package_files import experiment_names
from calstudy.cli.main import app

ROOT = Path(__file__).parents[2]
COMMAND = re.compile(r"(?:timeout .* \d+ )?(?:\.venv/bin/)?(?:python -m )?calstudy (?P<rest>[a-z].*)")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "notebooks").glob("*.ipynb")])


def text_of(path: Path) -> str:
    """Return a page as Markdown."""
    if path.suffix == ".md":
        return path.read_text(encoding="utf-8")
    cells = nbformat.read(path, as_version=4).cells
    return "\n\n".join(cell.source for cell in cells if cell.cell_type == "markdown")


def commands(text: str) -> list[str]:
    """Return what follows `calstudy` in blocks of code, and in code within a line if it is more than a name."""
    text = text.replace("\\\n", " ")
    fence = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
    lines = [line for language, block in fence.findall(text) if language in ("", "bash") for line in block.splitlines()]
    prose = fence.sub("", text)
    lines += re.findall(r"^    (\S.*)$", prose, re.MULTILINE)
    lines += [" ".join(code.split()) for code in re.findall(r"`((?:[^`\n]|\n(?!\n))+)`", prose)]
    parts = [part for line in lines for part in re.split(r" && | \|\| ", line)]
    return [match["rest"] for part in parts if (match := COMMAND.match(part))]


CALSTUDY = get_command(app)
FOUND = sorted({(path.relative_to(ROOT).as_posix(), command) for path in PAGES for command in commands(text_of(path))})


def test_there_are_commands():
    assert len(FOUND) > 100


@pytest.mark.parametrize(("page", "command"), FOUND)
def test_a_printed_command_is_understood(page, command):
    """Arguments in capitals, such as FILE, stand for any; what is in brackets or after | is a choice."""
    words = shlex.split(re.sub(r"\[[^\]]*\]|\s\|.*|…|\.\.\.", "", command), comments=True)
    group: click.Command = CALSTUDY
    while isinstance(group, click.Group):
        name = words.pop(0)
        assert name in group.commands, f"{page}: calstudy has no command {name!r}"
        group = group.commands[name]
        if not words:
            return
    group.make_context(group.name, [word for word in words if word not in ("--help", ">")])
    for word in words:
        if word.startswith("experiments/") and word.endswith(".yaml"):
            assert Path(word).stem in experiment_names(), f"{page}: there is no {word}"
