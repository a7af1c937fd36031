"""``calstudy init``, and the JSON schema: the first steps of an experiment file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from calstudy.base.errors import InputError

Name = Annotated[str, typer.Argument(help="Of the experiment; the file is NAME.yaml.")]
Example = Annotated[str | None, typer.Option(metavar="NAME", help="Copy a published experiment instead; see --list.")]
Data = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="Measured visibilities, or PACKAGE:PATH: write a file about these instead."),
]
List = Annotated[
    bool, typer.Option("--list", help="List the published experiments, which other commands take by name.")
]
Beam = Annotated[str, typer.Option(help="The beam of measured data: hera, airy, gaussian, ..., or a file.py.")]


def init(
    name: Name = "my-study", example: Example = None, data: Data = None, beam: Beam = "hera", listed: List = False
) -> None:
    """Write a commented experiment file, NAME.yaml, into this folder; nothing is overwritten.

    With --data it is one of measured data: calibration, power spectra, and signal loss by injection.
    """
    from calstudy.base.package_files import published
    from calstudy.experiment.starter import copy_text, observed_text, starter_text
    from calstudy.studies.reference import SCHEMA_FILE

    if listed:
        _list_examples()
        return
    path = Path(f"{name}.yaml")
    schema_file = published("experiments") / SCHEMA_FILE
    if example is not None and data is not None:
        raise InputError("--example and --data: choose one")
    if data is not None:
        text = observed_text(name, schema_file, beam, **_described(data))
    else:
        text = starter_text(name, schema_file) if example is None else copy_text(example, name, schema_file)
    if path.exists():
        raise InputError(f"{path}: exists already, and is not overwritten; choose another name or remove it")
    path.write_text(text, encoding="utf-8")
    typer.echo(f"{path}: next, `calstudy plan {path}`")


def _list_examples() -> None:
    from calstudy.base.package_files import experiment_names, published
    from calstudy.base.table import Table
    from calstudy.experiment.yaml_files import read_mapping
    from calstudy.studies.study import kind_of

    rows = []
    for name in experiment_names():
        content = read_mapping(published("experiments") / f"{name}.yaml")
        kind = kind_of(content, published("experiments")).__module__.rpartition(".")[2]
        rows.append((name, kind, " ".join(str(content.get("description", "")).split())))
    Table(("name", "kind", "description"), rows, "published experiments").show(Console(highlight=False), numbers=False)


def _described(data: str) -> dict[str, Any]:
    """Return entries of a file on measured data, after a look at their metadata."""
    from calstudy.realdata.halves import read_facts
    from calstudy.realdata.interference import has_surroundings
    from calstudy.realdata.selection import Selection
    from calstudy.realdata.settings import find_data

    try:
        facts = read_facts((find_data(data, Path()),), Selection(), even=False)
    except InputError as error:
        raise InputError(f"--data: {error}") from None
    first, last = math.floor(facts.frequencies[0] / 1e3), math.ceil(facts.frequencies[-1] / 1e3)
    return {
        "path": data,
        "summary": f"{facts.antennas} antennas with baselines of up to {facts.frame.lengths.max():.0f} m, "
        f"{facts.frequencies.size} channels between {first / 1e3:.3f} and {last / 1e3:.3f} MHz, {facts.times.size} "
        f"integrations, in {facts.unit!r}.",
        "first": f"{first / 1e3:.3f} MHz",
        "last": f"{last / 1e3:.3f} MHz",
        "in_jansky": facts.unit.lower() == "jy",
        "searchable": has_surroundings(facts.times.size, facts.frequencies.size),
    }


def write_schema(path: Path) -> None:
    """Write the JSON schema of experiment files; raises InputError if the file cannot be written.

    An editor with the YAML language server reads it if the first line of a file is
    `# yaml-language-server: $schema=FILE`; files of `calstudy init` have this line.
    """
    from calstudy.studies.reference import experiment_schema

    try:
        path.write_text(experiment_schema(), encoding="utf-8")
    except OSError as error:
        raise InputError(f"--schema {path}: cannot be written ({error.strerror})") from None
    typer.echo(f"{path}")
