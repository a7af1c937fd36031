"""The table of what the code computes, ``source_table.txt``, so that results do not change in silence.

    python tests/source_table.py                    after a new version of a stage or a plug-in
    python tests/source_table.py "why results stay" after an edit that changes no results

It has the version of every stage and plug-in, and a line for each module: the digest of those of its definitions that
some stage or plug-in reaches (`calstudy.run.source`), and which version was raised, or why results stay. An edit that
changes a digest needs one of these.

There is a line for each module, and not a digest for each stage, so that an edit of a module that twenty stages reach
is one line with one reason, and branches that edit different modules can be merged. When the table is compared the
stages that a changed module counts for are named. Definitions that no stage reaches (commands, plans, costs of tasks)
are not in it, nor are docstrings, comments, layout and annotations.
"""

from __future__ import annotations

import sys
from hashlib import sha256
from importlib import import_module
from itertools import chain
from pathlib import Path

import calstudy
from calstudy.base.plugins import Registry
from calstudy.base.schema import Section
from calstudy.experiment.model import Experiment
from calstudy.realdata.settings import InjectionSettings, ObservedSettings
from calstudy.run.source import reached
from calstudy.run.task import Task

TABLE = Path(__file__).with_suffix(".txt")
SETTINGS = "settings"
"""Stands for all sections of experiment files, which have no version."""
HEADING = "# Versions of stages and plug-ins, then modules; written by tests/source_table.py, which says how."

Table = tuple[dict[str, int], dict[str, tuple[str, str]]]
"""Versions by stage or plug-in; digest and reason by module."""


def makers() -> dict[str, tuple[int, dict[tuple[str, str], str]]]:
    """Return version and definitions of every stage and plug-in, by what it is called."""
    root = Path(calstudy.__file__).parent
    defining = [
        path for path in sorted(root.rglob("*.py")) if "stage=" in (text := path.read_text()) or "Registry" in text
    ]
    names = [
        ".".join(path.relative_to(root.parent).with_suffix("").parts).removesuffix(".__init__") for path in defining
    ]
    defined = [item for name in names for item in vars(import_module(name)).values()]
    kinds = [item for item in defined if isinstance(item, type) and issubclass(item, Task) and "stage" in vars(item)]
    offered = [getattr(item, "registry", item) for item in defined]
    # Kinds of study have no version: they ask for products, and make none.
    registries = {item.noun: item for item in offered if isinstance(item, Registry) and hasattr(item.base, "version")}
    found = {f"stage {kind.stage.name}": (kind.stage.version, reached(kind, {})) for kind in kinds}
    for noun, registry in registries.items():
        for thing in map(registry.find, registry.built_in()):
            found[f"{noun} {registry.reference_of(thing)}"] = (thing.version, reached(thing, {}))
    sections = [value for _, value in Experiment(name="any") if isinstance(value, Section)]
    found[SETTINGS] = (0, reached(ObservedSettings, {"sections": sections}) | reached(InjectionSettings, {}))
    return dict(sorted(found.items()))


def read() -> Table:
    """Read the committed table."""
    versions, modules = {}, {}
    for line in TABLE.read_text(encoding="utf-8").splitlines()[1:]:
        name, value, *reason = line.split("\t")
        if reason:
            modules[name] = (value, reason[0])
        else:
            versions[name] = int(value)
    return versions, modules


def compare(because: str | None = None) -> tuple[Table, list[str]]:
    """Return the table as it would be now, and a sentence for everything that keeps it from being accepted."""
    old_versions, old_modules = read() if TABLE.exists() else ({}, {})
    found = makers()
    versions = {name: version for name, (version, _) in found.items() if name != SETTINGS}
    raised = {name for name, version in versions.items() if old_versions.get(name) != version}
    of_module: dict[str, set[str]] = {}
    for (module, _), digest in chain.from_iterable(definitions.items() for _, definitions in found.values()):
        of_module.setdefault(module, set()).add(digest)
    modules, faults = {}, []
    for module, digests in sorted(of_module.items()):
        digest = sha256("".join(sorted(digests)).encode()).hexdigest()[:12]
        old, reason = old_modules.get(module, (None, "new"))
        users = [name for name, (_, definitions) in found.items() if any(at == module for at, _ in definitions)]
        if old is not None and old != digest:
            new = [f"{name} is version {versions[name]}" for name in users if name in raised]
            reason = because or ", ".join(new)
            if not reason:
                faults.append(f"{module} was changed, which counts for {', '.join(users)}")
        modules[module] = (digest, reason)
    return (versions, modules), faults


def write(table: Table) -> None:
    """Write a table."""
    versions, modules = table
    lines = [*(f"{name}\t{version}" for name, version in versions.items())]
    lines += [f"{module}\t{digest}\t{reason}" for module, (digest, reason) in modules.items()]
    TABLE.write_text("\n".join([HEADING, *lines]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    table, faults = compare(" ".join(sys.argv[1:]) or None)
    for fault in faults:
        print(f"{fault}: raise the version of those whose results change, or say why results stay")
    if not faults:
        write(table)
    sys.exit(bool(faults))
