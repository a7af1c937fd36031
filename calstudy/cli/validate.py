"""``calstudy validate``: the validation ladder, which tests every stage of the chain against a known answer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

EXIT_FAILED = 1


def validate(
    steps: Annotated[
        list[str] | None, typer.Argument(metavar="[STEP]...", help="Numbers of steps, such as 0.1; all if none.")
    ] = None,
    scale: Annotated[str, typer.Option(help="'full', or 'small': the same in a minute or two.")] = "full",
    workers: Annotated[int, typer.Option(min=1, help="Worker processes.")] = 1,
    output: Annotated[Path, typer.Option(help="Folder for tables, figures and manifests.")] = Path("validation"),
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="PATH=VALUE", help="Override a field of all experiments.")
    ] = None,
    ladder: Annotated[Path | None, typer.Option(help="Folder of other steps than calstudy's own.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON in place of a table, for programs.")] = False,
) -> None:
    """Run the validation ladder: experiments with criteria in numbers; PASS or FAIL, measured value, threshold, why.

    Exit status 0 if every step passes, 1 if one fails.
    """
    from calstudy.validation.ladder import run_ladder
    from calstudy.validation.outcomes import show
    from calstudy.validation.steps import LADDER, load_ladder
    from calstudy.verdicts.tables import as_json as verdicts_as_json

    chosen = load_ladder(steps or (), scale, overrides or (), LADDER if ladder is None else ladder)
    stores = dict.fromkeys(item.outputs.store for step in chosen for item in step.experiments.values())
    console = Console(soft_wrap=True, highlight=False, stderr=as_json)
    result = run_ladder(chosen, next(iter(stores), Path("store")), output, workers, console)
    if as_json:
        found = {outcome.step.name: verdicts_as_json(outcome.verdicts) for outcome in result.outcomes}
        typer.echo(json.dumps(found, indent=1))
    else:
        show(result.outcomes, scale, Console(highlight=False))
        console.print(f"table: {result.folder / 'validation.md'}", markup=False)
    if not result.passed:
        raise typer.Exit(EXIT_FAILED)
