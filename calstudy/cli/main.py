"""The command line: ``calstudy init | which | run | plan | calibrate | claims | report | regress | validate | ...``.

Only light modules are imported here, so that ``calstudy --help`` answers at once.
"""

from __future__ import annotations

import faulthandler
import json
import logging
import os
import signal
import sys
from collections.abc import Callable
from io import TextIOWrapper
from pathlib import Path
from types import FrameType
from typing import Annotated, NoReturn

import typer
from rich.console import Console

from calstudy import __version__
from calstudy.base.errors import DiskError, ExperimentError, InputError, Terminated, exit_status, refusal_of_disk
from calstudy.base.package_files import MWA_FILES
from calstudy.cli.calibrate import calibrate, compare_gains
from calstudy.cli.checks import regress, validate
from calstudy.cli.export import export, leaderboard, score
from calstudy.cli.options import (
    AsJson,
    MaxMemory,
    Overwrite,
    Runs,
    Scale,
    Scheduler,
    Sections,
    Set,
    StudyFile,
    Workers,
    with_runs,
)
from calstudy.cli.start import init, write_schema
from calstudy.cli.storage import runs, store
from calstudy.cli.which import which

app = typer.Typer(
    cls=Sections,
    help="Simulation and validation studies of 21 cm interferometer calibration.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
data_app = typer.Typer(help="Files that are downloaded once.", no_args_is_help=True)
app.add_typer(data_app, name="data")
for command in (calibrate, regress, compare_gains, export, score, leaderboard, init, which, runs, store):
    app.command()(command)
# Step -1 is an argument, not an option.
app.command(context_settings={"ignore_unknown_options": True})(validate)

EXIT_INPUT = 2
EXIT_INTERRUPTED = 130

Finished = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="FOLDER",
        help="Take members of a collection from finished runs, or references, in this folder; may be repeated.",
    ),
]
Strict = Annotated[
    bool, typer.Option("--strict", help="Make products again that are of other code or other versions of packages.")
]


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"calstudy {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    del version


@app.command()
def run(
    file: StudyFile,
    scale: Scale = None,
    overrides: Set = None,
    workers: Workers = None,
    max_memory: MaxMemory = None,
    scheduler: Scheduler = None,
    output: Runs = None,
    finished: Finished = None,
    strict: Strict = False,
) -> None:
    """Run an experiment or a collection: simulate, corrupt, calibrate, measure power spectra, draw figures.

    Products that are in the store are not made again; the same command resumes an interrupted run.
    """
    from calstudy.run.execution import Budget
    from calstudy.studies.load import load_study
    from calstudy.studies.show import show_run
    from calstudy.studies.study import run_study

    console = Console(soft_wrap=True, highlight=False)
    study = load_study(file, scale, with_runs(overrides, output))
    if finished:
        _require_not_strict(strict)
        study = study.with_finished(finished, console)
    for note in study.notes:
        console.print(f"note: {note}", markup=False)
    show_run(run_study(study, Budget(workers, max_memory, scheduler, strict), console), console)


@app.command()
def plan(
    file: StudyFile,
    scale: Scale = None,
    overrides: Set = None,
    workers: Workers = None,
    max_memory: MaxMemory = None,
    finished: Finished = None,
    strict: Strict = False,
    as_json: AsJson = False,
) -> None:
    """Show what a run would do: stages, products in the store, estimated time, memory and disk."""
    from calstudy.run.execution import Budget
    from calstudy.studies.load import load_study
    from calstudy.studies.show import describe_plan, show_plan

    study = load_study(file, scale, overrides or ())
    if finished:
        _require_not_strict(strict)
        # With JSON, nothing else is on standard output.
        study = study.with_finished(finished, Console(soft_wrap=True, highlight=False, stderr=as_json), planned=True)
    found = describe_plan(study, Budget(workers, max_memory, strict=strict))
    if as_json:
        typer.echo(json.dumps(found, indent=1))
    else:
        show_plan(found, Console(highlight=False))


def _require_not_strict(strict: bool) -> None:
    if strict:
        raise InputError("--strict: makes all products of other code again, and --finished takes some; leave one out")


@app.command()
def claims(
    folder: Annotated[Path, typer.Argument(help="The folder of a finished run or collection.", show_default=False)],
    others: Annotated[list[Path] | None, typer.Argument(help="More runs, whose verdicts count with these.")] = None,
    paper: Annotated[
        list[str] | None, typer.Option(help="Name of a paper, or a file.py, in place of those that the run names.")
    ] = None,
    run_code: Annotated[
        bool, typer.Option("--run-code", help="Run Python files that the folder's experiment names.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Compare a finished run with published statements: the measured number, its threshold, and the verdict.

    A statement is supported, contradicted or undecided by the 95 % interval of the number.

    Writes claims.json and claims.md into the folder, but nothing if no statement can be evaluated. For a collection
    with studies by the paper's own solver and by another one, also writes claims-by-solver.json and
    claims-by-solver.md.

    Of several folders the written verdicts are shown together, and none is written: of each statement that of the last
    folder that evaluates it, so that studies with realizations come last.
    """
    from calstudy.claims.evaluation import Evaluation, evaluate_folder
    from calstudy.results.reader import RunFolder
    from calstudy.verdicts.tables import combined, show_verdicts, to_json

    console = Console(highlight=False)
    runs = [RunFolder(path) for path in (folder, *(others or ()))]
    if others:
        if paper or run_code:
            raise InputError("--paper, --run-code: are for a single folder, whose verdicts are found anew")
        if without := [str(run.path) for run in runs if not run.has_claims]:
            raise InputError(f"{', '.join(without)}: has no verdicts (claims.json)")
        evaluated = Evaluation(combined(run.claims for run in runs))
    else:
        evaluated = evaluate_folder(folder, paper or (), run_code)
    if as_json:
        typer.echo(to_json(evaluated.verdicts))
        return
    if evaluated.verdicts:
        show_verdicts(evaluated.verdicts, ", ".join(run.name for run in runs), console)
    for sentence in evaluated.without_role:
        console.print(sentence, markup=False)
    if evaluated.is_empty:
        console.print("No statement was evaluated; nothing was written.")


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="The folder of a finished run.", show_default=False)],
    others: Annotated[list[Path] | None, typer.Argument(help="More runs, to be shown beside it.")] = None,
    output: Annotated[
        Path | None, typer.Option(help="Page of several runs; by default FOLDER-and-OTHER.html here.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write the report of a finished run, one self-contained page, report.html, into its folder.

    With several runs, write a page with all: power spectra and T in one chart each, and side by side fields that
    differ, verdicts, figures and tables.
    """
    from calstudy.report.page import write_report, write_several

    if not others:
        if output is not None or overwrite:
            raise InputError("--output, --overwrite: are for the page of several runs")
        typer.echo(f"{write_report(folder)}")
        return
    folders = [folder, *others]
    output = output or Path(f"{'-and-'.join(one.resolve().name for one in folders)}.html")
    typer.echo(f"{write_several(folders, output, overwrite)}")


@app.command()
def fields(
    section: Annotated[
        str | None,
        typer.Argument(help="A section, such as calibration.basis, or a Python file: the settings of what it defines."),
    ] = None,
    schema: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the JSON schema, with which editors complete and check a file."),
    ] = None,
) -> None:
    """Print the reference of all fields of an experiment file, or of one section (Markdown)."""
    from calstudy.studies.reference import field_reference, plugin_reference, section_reference

    if schema is not None:
        if section is not None:
            raise InputError(f"fields {section} --schema: the schema is of whole files; leave out the section")
        write_schema(schema)
    elif section is None:
        typer.echo(field_reference(), nl=False)
    else:
        is_file = section.endswith(".py")
        typer.echo(plugin_reference(Path(section)) if is_file else section_reference(section), nl=False)


@data_app.command()
def fetch(
    name: Annotated[str, typer.Argument(help="What to fetch: gleam, beam, g4jy or haslam.")],
    directory: Annotated[Path | None, typer.Option(help="Where to put it; by default the user's data folder.")] = None,
) -> None:
    """Download the GLEAM catalogue, or a file of the package mwa_pb, check it, and keep it for later runs."""
    names = ["gleam", *MWA_FILES]
    if name not in names:
        raise InputError(f"calstudy data fetch {name}: nothing that can be fetched (allowed: {', '.join(names)})")
    from calstudy.sky.catalogue import fetch_gleam

    path = fetch_gleam(directory) if name == "gleam" else MWA_FILES[name].fetch(directory)
    typer.echo(f"{path}")


class _Termination:
    """Handler of SIGTERM that interrupts the main thread; Typer does not distinguish it from Ctrl-C."""

    def __init__(self) -> None:
        self.asked = False
        signal.signal(signal.SIGTERM, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> NoReturn:
        self.asked = True
        raise Terminated("SIGTERM")


def _end(leave: Callable[[int], NoReturn]) -> NoReturn:
    sys.stdout.flush()
    sys.stderr.flush()
    leave(EXIT_INPUT)


def main(leave: Callable[[int], NoReturn] = os._exit) -> None:
    """Run the command line; a user's mistake ends with sentences on standard error and exit status 2.

    If a file could not be written, `leave` ends the process without the clean-up of libraries: HDF5 would crash
    there.
    """
    logging.getLogger().addHandler(logging.NullHandler())
    if isinstance(sys.stdout, TextIOWrapper):
        # What a terminal cannot show, such as ± in ASCII, is a question mark there.
        sys.stdout.reconfigure(errors="replace")
    if not faulthandler.is_enabled():
        # The terminal shows the place of a library's crash: a run writes standard error itself to a file.
        faulthandler.enable(os.dup(2), all_threads=False)
    termination = _Termination()
    try:
        app()
    except InputError as error:
        for sentence in error.faults if isinstance(error, ExperimentError) else [str(error)]:
            typer.echo(f"calstudy: {sentence}", err=True)
        if isinstance(error, DiskError):
            _end(leave)
        sys.exit(EXIT_INPUT)
    except (OSError, RuntimeError) as error:
        reason, name = refusal_of_disk(error), getattr(error, "filename", None)
        if reason is None:
            raise
        typer.echo(f"calstudy: {name or 'a file'}: cannot be read or written ({reason})", err=True)
        _end(leave)
    except (KeyboardInterrupt, SystemExit) as end:
        # Typer ends an interrupted command with this status and no message.
        if isinstance(end, SystemExit) and end.code != EXIT_INTERRUPTED:
            raise
        how = "terminated" if termination.asked else "interrupted"
        typer.echo(f"calstudy: {how}; what is in the store is kept, and a run goes on from there", err=True)
        sys.exit(exit_status(Terminated()) if termination.asked else EXIT_INTERRUPTED)
