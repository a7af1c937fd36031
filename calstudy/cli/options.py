"""Options that several commands have, and the order of commands in ``calstudy --help``."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from calstudy.base.errors import ExperimentError, InputError

StudyFile = Annotated[
    Path,
    typer.Argument(
        help="The file (YAML) of a study, or the name of a published one, such as quickstart.", show_default=False
    ),
]
Scale = Annotated[str | None, typer.Option(help="Apply a named set of overrides of the file, such as 'small'.")]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="PATH=VALUE", help="Override a field: --set calibration.basis.buffer='200 ns'."),
]
Workers = Annotated[int | None, typer.Option(min=1, help="Worker processes; by default one per core that has memory.")]
MaxMemory = Annotated[
    str | None,
    typer.Option(metavar="SIZE", help="Memory for all workers together, such as '6 GB'; by default what is free."),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="TCP://HOST:PORT",
        help="Use a running dask cluster in place of own workers: its address, or the scheduler file that it wrote.",
    ),
]
Runs = Annotated[
    Path | None,
    typer.Option("--output", metavar="FOLDER", help="Where the run gets its folder: --set outputs.runs=FOLDER."),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files that an earlier call wrote.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON in place of a table, for programs.")]


def with_runs(overrides: list[str] | None, output: Path | None) -> list[str]:
    """Return the changes of a file by --set and --output; raises InputError if the folder cannot be written."""
    if output is None:
        return overrides or []
    from calstudy.run.store import require_writable

    require_writable(output.absolute(), f"--output {output}")
    return [*(overrides or ()), f"outputs.runs={json.dumps(str(output.resolve()))}"]


SECTIONS = {
    "Every day": ("init", "which", "plan", "run", "calibrate", "report"),
    "Results": ("claims", "compare-gains", "runs", "store"),
    "Other programs": ("export", "score", "leaderboard"),
    "Reference": ("fields", "data"),
    "Checks": ("validate", "regress"),
}
"""Commands by section of the help."""


@contextmanager
def named_as_options(*names: tuple[str, str]) -> Iterator[None]:
    """Replace patterns, of fields of files, in errors by the options of a command; equal sentences are said once."""

    def renamed(text: str) -> str:
        for field, option in names:
            text = re.sub(field, option, text)
        return text

    try:
        yield
    except ExperimentError as error:
        raise ExperimentError(list(dict.fromkeys(map(renamed, error.faults)))) from None
    except InputError as error:
        raise type(error)(renamed(str(error))) from None


REMOVED = {
    "examples": "calstudy init --list",
    "schema": "calstudy fields --schema FILE",
    "check": "calstudy run checks, whose figures are the checks",
    "bench": "the benchmarks of the repository (benchmarks/README.md)",
}
"""Commands of earlier versions, and what has taken their place."""


class Sections(TyperGroup):
    """A group of commands whose help lists them by section, and which knows those of earlier versions."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find a command by its name; one of an earlier version ends with a sentence that names its successor."""
        if args and args[0] in REMOVED:
            ctx.fail(f"'{args[0]}' was a command of earlier versions; use {REMOVED[args[0]]}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands by section, each with its first sentence in as many lines as it has."""
        for title, names in SECTIONS.items():
            with formatter.section(title):
                texts = [(name, self.commands[name].get_short_help_str(limit=1000)) for name in names]
                formatter.write_dl(texts, col_max=16)
