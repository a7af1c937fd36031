"""``calstudy export``, ``score`` and ``leaderboard``: calibration by other programs, through files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from calstudy.base.errors import InputError, errors_of_files
from calstudy.base.files import write_text
from calstudy.cli.options import MaxMemory, Overwrite, Scale, Set, StudyFile, Workers

Format = Annotated[str, typer.Option("--format", help="uvh5, uvfits or ms (which takes python-casacore).")]
Output = Annotated[Path, typer.Option(help="Folder for the data; worlds of a comparison get a folder each in it.")]
Blind = Annotated[
    Path | None,
    typer.Option(metavar="RECIPE.yaml", help="Draw secret seeds, write them with the file to a new one, export that."),
]


def export(
    file: StudyFile,
    output: Output,
    file_format: Format = "uvh5",
    scale: Scale = None,
    overrides: Set = None,
    workers: Workers = None,
    max_memory: MaxMemory = None,
    overwrite: Overwrite = False,
    blind: Blind = None,
) -> None:
    """Write what a calibrator may know: data, nominal telescope, sky model; nothing of the truth.

    Writes four data sets, of both realizations of the noise, with the EoR and without, under names that do not
    reveal which is which, and a README that says what to return. `calstudy score` reads the gains. With --blind,
    publish the printed SHA-256 at once, and the recipe at the end.
    """
    from calstudy.products.files import quiet_libraries
    from calstudy.run.execution import Budget
    from calstudy.studies.export import CARRIER, folders_of, require_worlds, write_recipe
    from calstudy.studies.export import export as write
    from calstudy.studies.kinds.comparison import load_worlds

    console = Console(soft_wrap=True, highlight=False)
    worlds = load_worlds(file, scale, overrides or (), CARRIER)
    if blind is not None:
        # Nothing is promised of data that cannot be written.
        folders_of(worlds, output, file_format, overwrite)
        require_worlds(worlds)
        digest = write_recipe(load_worlds(file, scale, overrides or (), None), blind)
        console.print(f"SHA-256 of {blind}, to be published: {digest}", markup=False)
        worlds = load_worlds(blind, None, (), CARRIER)
    with quiet_libraries():
        folders = write(worlds, output, file_format, overwrite, Budget(workers, max_memory), console)
    console.print(*folders, sep="\n", markup=False)


Gains = Annotated[
    Path | None,
    typer.Argument(
        help="Folder of gains for data of an export; without it, the calibrators of the file are scored.",
        show_default=False,
    ),
]
Name = Annotated[str | None, typer.Option(help="Label of the row; by default the name of the folder.")]
OfClass = Annotated[
    str | None,
    typer.Option("--calibrator", help="In place of a folder, a calibrator: its name, a file.py, or a block in YAML."),
]
ScoreFile = Annotated[
    Path | None, typer.Option("--output", metavar="FILE.json", help="Write the scores, for a leaderboard.")
]


def score(
    file: StudyFile,
    folder: Gains = None,
    calibrator: OfClass = None,
    name: Name = None,
    output: ScoreFile = None,
    scale: Scale = None,
    overrides: Set = None,
    workers: Workers = None,
    max_memory: MaxMemory = None,
    overwrite: Overwrite = False,
) -> None:
    """Score gains of another program, found for data of `calstudy export`, as built-in calibrators are scored.

    Prints one row for each world: T and bias free of the flux scale in three bands of k, the flux scale, errors of
    the gains, and χ² of data that were not fitted.
    """
    from calstudy.products.files import quiet_libraries
    from calstudy.run.execution import Budget
    from calstudy.studies.kinds.comparison import load_worlds
    from calstudy.studies.scores import measure_scores, tables

    if output is not None:
        _require_free(output, overwrite)
    blocks = _blocks(folder, calibrator, name)
    console = Console(soft_wrap=True, highlight=False)
    with quiet_libraries():
        worlds = load_worlds(file, scale, overrides or (), blocks)
        found = measure_scores(worlds, Budget(workers, max_memory), console)
    if output is not None:
        with errors_of_files(f"--output {output}: cannot be written"):
            output.parent.mkdir(parents=True, exist_ok=True)
            write_text(output, found.model_dump_json(indent=1) + "\n")
    for world, table in tables(found).items():
        console.print(f"{world}:\n{table.markdown()}", markup=False)
    for world, calibrator, why in found.refusals:
        console.print(f"{calibrator} cannot work in {world}: {why}", markup=False)


def _require_free(output: Path, overwrite: bool) -> None:
    """Raise InputError if the file of scores cannot be written."""
    from calstudy.run.store import require_writable

    if output.is_dir():
        raise InputError(f"--output {output}: is a folder; give the name of a file, such as {output / 'scores.json'}")
    if output.exists() and not overwrite:
        raise InputError(f"--output {output}: is there already; use --overwrite or another name")
    require_writable(output.parent, f"--output {output}")


def _blocks(folder: Path | None, calibrator: str | None, name: str | None) -> dict[str, Any] | None:
    """Return the calibrator to be scored by its label, or None for those of the file."""
    from calstudy.experiment.files import parse_yaml

    if folder is not None:
        if calibrator is not None:
            raise InputError("--calibrator: cannot be given together with a folder of gains")
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder")
        return {name or folder.resolve().name: {"calibrator": "by-file", "folder": str(folder.resolve())}}
    if calibrator is None:
        if name is not None:
            raise InputError(
                "--name: names the row of a folder or of --calibrator; those of the file have their labels"
            )
        return None
    block = parse_yaml(calibrator, "--calibrator")
    block = {"calibrator": block} if isinstance(block, str) else block
    if not isinstance(block, dict) or not isinstance(block.get("calibrator"), str):
        raise InputError(f"--calibrator {calibrator}: must be a name, a file.py, or a block with 'calibrator'")
    if block["calibrator"].partition(":")[0].endswith(".py"):
        # Paths of an option start at the working folder, not at the experiment.
        block = {**block, "calibrator": str(Path(block["calibrator"]).absolute())}
    return {name or Path(block["calibrator"]).stem: block}


def leaderboard(
    folder: Annotated[Path, typer.Argument(help="Folder of files of `calstudy score --output`.", show_default=False)],
) -> None:
    """Print a page (Markdown) that ranks all scores of a folder, by world and over all of them."""
    from calstudy.studies.scores import leaderboard as page

    typer.echo(page(folder), nl=False)
