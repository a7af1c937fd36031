"""``calstudy regress``: comparison of studies, made again, with their reference results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from calstudy.base.errors import InputError
from calstudy.cli.options import MaxMemory, Scheduler, Set, Workers

if TYPE_CHECKING:
    from calstudy.regression.tables import Regression

EXIT_MOVED = 1

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
    from calstudy.regression.reference import accept, find_references
    from calstudy.regression.remake import remake
    from calstudy.regression.tables import show, write_json
    from calstudy.run.execution import Budget

    console = Console(soft_wrap=True, highlight=False)
    if against is not None:
        if not folders or len(folders) != 1:
            raise InputError("--against RUN: give the one reference folder that the run is to be compared with")
        if update and not folders[0].exists():
            accept(against, folders[0])
            console.print(f"{folders[0]}: new reference", markup=False)
            return
    if update and not folders and not Path("figures").is_dir():
        raise InputError("--update: there is no folder 'figures' here; give the references that are to be updated")
    made, holds = {}, True
    for reference in find_references(folders or [reference_folder()]):
        run = against or remake(reference, overrides or (), Budget(workers, max_memory, scheduler), console)
        regression = _compare(reference, run)
        show(regression, console)
        write_json(regression, run)
        made[reference] = run
        holds = holds and (regression.holds or update)
    # After all runs, because their manifests would otherwise record a changed checkout.
    for reference, run in made.items() if update else ():
        accept(run, reference)
        console.print(f"{reference}: updated", markup=False)
    if not holds:
        raise typer.Exit(EXIT_MOVED)


def _compare(reference: Path, run: Path) -> Regression:
    from calstudy.regression.comparison import compare_claims, compare_figures
    from calstudy.regression.reference import read_reference, read_run
    from calstudy.regression.tables import Regression

    old, new = read_reference(reference), read_run(run)
    claims = compare_claims(old.claims, new.claims, old.on_machines) if old.claims else []
    figures = compare_figures(old.figures, new.figures, old.tolerances)
    return Regression(str(reference), str(run), figures, claims)
