"""``calstudy examples``, ``init`` and ``schema``: how to begin an experiment file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from calstudy.base.errors import InputError

Name = Annotated[str, typer.Argument(help="Of the experiment; the file is NAME.yaml.")]
Example = Annotated[
    str | None, typer.Option(metavar="NAME", help="Copy a published experiment instead; see `calstudy examples`.")
]
KINDS = {"experiments": "collection", "runtime": "run times", "calibrators": "comparison"}
"""Files that are not one experiment, by the key that says so."""


def examples() -> None:
    """List the published experiments, which `run`, `plan` and `init --example` take by name."""
    from calstudy.base.package_files import experiment_names, published
    from calstudy.experiment.yaml_files import read_mapping
    from calstudy.verdicts.tables import Table

    rows = []
    for name in experiment_names():
        content = read_mapping(published("experiments") / f"{name}.yaml")
        kind = next((kind for key, kind in KINDS.items() if key in content), "experiment")
        rows.append((name, kind, " ".join(str(content.get("description", "")).split())))
    Table(("name", "kind", "description"), rows, "published experiments").show(Console(highlight=False))


def init(name: Name = "my-study", example: Example = None) -> None:
    """Write a commented experiment file, NAME.yaml, into this folder; nothing is overwritten."""
    from calstudy.base.package_files import published
    from calstudy.experiment.starter import copy_text, starter_text
    from calstudy.studies.json_schema import SCHEMA_FILE

    path = Path(f"{name}.yaml")
    schema_file = published("experiments") / SCHEMA_FILE
    text = starter_text(name, schema_file) if example is None else copy_text(example, name, schema_file)
    if path.exists():
        raise InputError(f"{path}: exists already, and is not overwritten; choose another name or remove it")
    path.write_text(text, encoding="utf-8")
    typer.echo(f"{path}: next, `calstudy plan {path}`")


def schema(
    output: Annotated[Path | None, typer.Option(help="File to write it to; by default it is printed.")] = None,
) -> None:
    """Print the JSON schema of experiment files, with which editors complete and check them.

    An editor with the YAML language server reads it if the first line of a file is
    `# yaml-language-server: $schema=FILE`; files of `calstudy init` have this line.
    """
    from calstudy.studies.json_schema import experiment_schema

    text = experiment_schema()
    if output is None:
        typer.echo(text, nl=False)
        return
    try:
        output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"--output {output}: cannot be written ({error.strerror})") from None
    typer.echo(f"{output}")
