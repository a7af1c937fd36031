"""Plug-ins from outside the package, as the pages on extending show them: in a file, or in an installed package."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml
from distributed.protocol.pickle import dumps, loads
from tiny import tiny

from calstudy.experiment.files import validate
from calstudy.experiment.model import Experiment
from calstudy.run.execution import WorkOrder, perform
from calstudy.run.store import Product, Store
from calstudy.run.task import Task, unique

DOCS = Path(__file__).parents[1] / "docs"
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("extending*.md")))
BLOCK = re.compile(r"^```(?P<language>\w+)\n(?P<text>.*?)^```$", flags=re.MULTILINE | re.DOTALL)


def example(title: str) -> tuple[str, str, dict[str, Any]]:
    """Return the name of the file that a section of the page shows, its content, and the experiment's block."""
    text = TEXT.partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    code, block = (re.search(rf"```{language}\n(.*?)```", text, re.DOTALL)[1] for language in ("python", "yaml"))
    return re.match(r"# (\w+\.py)\n", code)[1], code, yaml.safe_load(block)


class Plugged:
    """An example of the page, at hand under a path or as an entry point of an installed package.

    Parameters
    ----------
    title
        Of the section.
    way
        "path" or "entry point".
    folder
        Where it is put.
    monkeypatch
        Adds the package to the path.
    """

    def __init__(self, title: str, way: str, folder: Path, monkeypatch) -> None:
        name, code, self.block = example(title)
        self.folder, self.reference = folder, name
        self.file = folder / name
        if way == "entry point":
            noun, module = title.split()[-1], f"outside_{name.removesuffix('.py')}"
            self.reference = module.replace("_", "-")
            self.file = folder / "packages" / f"{module}.py"
            information = folder / "packages" / f"{module}-1.2.dist-info"
            information.mkdir(parents=True)
            (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.2\n")
            (information / "entry_points.txt").write_text(f"[calstudy.{noun}s]\n{self.reference} = {module}\n")
            monkeypatch.syspath_prepend(str(folder / "packages"))
        self.file.write_text(code)

    def settings(self, **changes: Any) -> dict[str, Any]:
        """Return the example's block of the plug-in alone, with changed fields, under the name by which it is found."""
        (inner,) = self.block.values()
        (found,) = inner.values()
        block = found[0] if isinstance(found, list) else found
        return {**block, "kind": self.reference, **changes}

    def experiment(self, changes: dict[str, Any]) -> Experiment:
        """Return the tiny experiment with changed sections, validated."""
        data = copy.deepcopy(tiny(self.folder))
        for section, block in changes.items():
            data[section] = {**data.get(section, {}), **block}
        return validate(data, self.folder)


def make(tasks: Iterable[Task], folder: Path) -> dict[str, Product]:
    """Make tasks and all they need in this process; orders are pickled as they are for workers."""
    store = Store(folder / "store")
    store.root.mkdir(exist_ok=True)
    return {task.key: perform(loads(dumps(WorkOrder.of(task, store)))) for task in unique(tasks)}


def sections() -> dict[str, dict[str, str]]:
    """Return the blocks of each section that has some, by the section's title and the language of the block."""
    found = {}
    for text in re.split(r"^## ", TEXT, flags=re.MULTILINE)[1:]:
        blocks = {match["language"]: match["text"] for match in BLOCK.finditer(text)}
        if blocks:
            found[text.splitlines()[0]] = blocks
    return found
