"""``calstudy validate`` and ``calstudy regress``: the validation ladder, and comparison with reference results."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from calstudy.base.errors import InputError
from calstudy.cli.options import MaxMemory, Runs, Scheduler, Set, Workers, with_runs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from calstudy.run.execution import Budget


EXIT_MOVED = 1
"""Exit status if a number is beyond its tolerance, or a step fails."""

Folders = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Reference folders, or folders of them; by default ./figures, or the published ones.", show_default=False
    ),
]
Against = Annotated[
    Path | None, typer.Option(metavar="RUN", help="Compare with this finished run instead of making the study again.")
]
Update = Annotated[bool, typer.Option("--update", help="Then accept the new results as the reference.")]


def regress(
    folders: Folders = None,
    against: Against = None,
    update: Update = False,
    overrides: Set = None,
    workers: Workers = None,
    max_memory: MaxMemory = None,
    scheduler: Scheduler = None,
) -> None:
    """Make reference results again and compare every array with its tolerance; exit status 1 if any is beyond it.

    Products in the store are made again only if they are of other code or other versions of packages; --set
    outputs.store=DIR chooses another store, or a fresh one. Changes, in values and in sigma, are listed and written
    to regression.json in the run's folder. Nothing is overwritten without --update; with --against and --update, a
    folder that does not exist becomes a new reference.
    """
    from calstudy.base.package_files import reference_folder
    from calstudy.regression import accept, find_references
    from calstudy.run.execution import Budget

    console = Console(soft_wrap=True, highlight=False)
    if against is not None:
        if overrides or any(option is not None for option in (workers, max_memory, scheduler)):
            raise InputError("--against RUN: nothing is made again; leave out --set, --workers and the like")
        if update and folders and len(folders) == 1 and not folders[0].exists():
            accept(against, folders[0])
            console.print(f"{folders[0]}: new reference", markup=False)
            return
    if update and not folders and not Path("figures").is_dir():
        raise InputError("--update: there is no folder 'figures' here; give the references that are to be updated")
    references = find_references(folders or ([] if against else [reference_folder()]))
    if against is not None and len(references) != 1:
        raise InputError("--against RUN: give the one reference folder that the run is to be compared with")
    references = _with_results(references, console)
    budget = Budget(workers, max_memory, scheduler)
    made, hold = {}, True
    for reference in references:
        run = against or _made_again(reference, overrides or (), budget, console, alone=len(references) == 1)
        if run is not None:
            made[reference] = run
            hold &= _compare(reference, run, update, console) or update
    # After all runs, because their manifests would otherwise record a changed checkout.
    for reference, run in made.items() if update else ():
        accept(run, reference)
        console.print(f"{reference}: updated", markup=False)
    _leave(bool(made), hold and len(made) == len(references))


def _leave(any_made: bool, all_hold: bool) -> None:
    """End with the exit status of a regression."""
    if not any_made:
        raise InputError("none of the references has results that could be made again")
    if not all_hold:
        raise typer.Exit(EXIT_MOVED)


def _with_results(references: list[Path], console: Console) -> list[Path]:
    """Leave out, of several studies, those without results of their own, such as sweeps, and name them."""
    from calstudy.regression import has_results

    found = list(references)
    for reference in references if len(references) > 1 else ():
        # A study that cannot be read is named in its turn.
        with suppress(InputError):
            if not has_results(reference):
                found.remove(reference)
                text = f"{reference}: left out, for its study has no results of its own to compare"
                console.print(text, markup=False)
    return found


def _made_again(
    reference: Path, overrides: Sequence[str], budget: Budget, console: Console, alone: bool
) -> Path | None:
    """Make a reference again; one of several that cannot be made is named, and the others are not lost."""
    from calstudy.regression import remake

    try:
        return remake(reference, overrides, budget, console)
    except InputError as error:
        if alone:
            raise
        console.print(f"{reference}: NOT MADE AGAIN: {error}", markup=False)
        return None


def _compare(reference: Path, run: Path, update: bool, console: Console) -> bool:
    """Show how a run compares with a reference, write it to its folder, and return whether the reference holds.

    Raises InputError if the run is of another study and would take its place (`update`).
    """
    from calstudy import regression

    if update:
        regression.require_same_study(reference, run)
    old, new = regression.read_reference(reference), regression.read_run(run)
    claims = regression.compare_claims(old.claims, new.claims, old.on_machines) if old.claims else []
    figures = regression.compare_figures(old.figures, new.figures, old.tolerances)
    found = regression.Regression(str(reference), str(run), figures, claims)
    regression.show(found, console)
    regression.write_json(found, run)
    return found.holds


def validate(
    steps: Annotated[
        list[str] | None,
        typer.Argument(metavar="[STEP]...", help="Numbers of steps, such as 0.1, or files of your own; all if none."),
    ] = None,
    scale: Annotated[str, typer.Option(help="'full', or 'small': the same in a minute or two.")] = "full",
    workers: Workers = 1,
    max_memory: MaxMemory = None,
    output: Runs = None,
    overrides: Set = None,
) -> None:
    """Run the validation ladder: experiments with limits for numbers; PASS or FAIL, measured value, threshold, why.

    Exit status 0 if every step passes, 1 if one fails.
    """
    from calstudy.experiment.files import StudyFile
    from calstudy.run.execution import Budget
    from calstudy.validation.ladder import Ladder, passed, run_ladder, tally
    from calstudy.verdicts.tables import show_verdicts

    ladder = Ladder.load(StudyFile(Path(), {"steps": steps or ()}, scale, with_runs(overrides, output)))
    console = Console(soft_wrap=True, highlight=False)
    folder, verdicts = run_ladder(ladder, Budget(workers, max_memory), console)
    show_verdicts(verdicts, ladder.description, Console(highlight=False), "step", tally(verdicts))
    console.print(f"results: {folder}", markup=False)
    if not passed(verdicts):
        raise typer.Exit(EXIT_MOVED)
