"""``calstudy validate``: the validation ladder, which tests every stage of the chain against a known answer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from calstudy.cli.options import AsJson, MaxMemory, Set, Workers

EXIT_FAILED = 1


def validate(
    steps: Annotated[
        list[str] | None,
        typer.Argument(metavar="[STEP]...", help="Numbers of steps, such as 0.1, or files of your own; all if none."),
    ] = None,
    scale: Annotated[str, typer.Option(help="'full', or 'small': the same in a minute or two.")] = "full",
    workers: Workers = 1,
    max_memory: MaxMemory = None,
    output: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Where the run gets its folder: --set outputs.runs=FOLDER."),
    ] = None,
    overrides: Set = None,
    as_json: AsJson = False,
) -> None:
    """Run the validation ladder: experiments with limits for numbers; PASS or FAIL, measured value, threshold, why.

    Exit status 0 if every step passes, 1 if one fails.
    """
    from calstudy.experiment.files import StudyFile
    from calstudy.run.execution import Budget
    from calstudy.validation.ladder import Ladder, passed, run_ladder, tally
    from calstudy.verdicts.tables import show_verdicts, to_json

    changes = [*(overrides or ()), *([] if output is None else [f"outputs.runs={json.dumps(str(output.resolve()))}"])]
    ladder = Ladder.load(StudyFile(Path(), {"steps": steps or ()}, scale, changes))
    console = Console(soft_wrap=True, highlight=False, stderr=as_json)
    folder, verdicts = run_ladder(ladder, Budget(workers, max_memory), console)
    if as_json:
        typer.echo(to_json(verdicts))
    else:
        show_verdicts(verdicts, ladder.description, Console(highlight=False), "step", tally(verdicts))
        console.print(f"results: {folder}", markup=False)
    if not passed(verdicts):
        raise typer.Exit(EXIT_FAILED)
