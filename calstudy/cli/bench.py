"""``calstudy bench``: what the parts cost, measured here."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, TypeVar

import typer
from rich.console import Console

from calstudy.base.errors import InputError
from calstudy.verdicts.tables import Table, require_writable

Item = TypeVar("Item")

bench_app = typer.Typer(help="Measure what the parts cost on this machine.", no_args_is_help=True)

Output = Annotated[Path | None, typer.Option(help="Also write the table here, as .csv or .md.")]


@bench_app.command()
def simulate(
    sources: Annotated[int, typer.Option(min=200, help="Sources of the whole sky, brightest first.")] = 283_000,
    antennas: Annotated[int, typer.Option(min=2, max=36, help="Tiles of the minimally redundant array.")] = 36,
    channels: Annotated[int, typer.Option(min=1, max=64, help="Channels, spread over 30.72 MHz.")] = 2,
    times: Annotated[int, typer.Option(min=1, max=16, help="Integrations, spread over 112 s.")] = 1,
    engines: Annotated[str, typer.Option(help="Names, separated by commas.")] = "dense,matvis,fftvis,pyuvsim",
    output: Output = None,
) -> None:
    """Simulate the same visibilities with every engine: processor time, error against pyuvsim, memory."""
    from calstudy.bench.engines import Work, time_engines

    if output is not None:
        require_writable(output)
    console = Console(highlight=False)
    work = Work(sources=sources, antennas=antennas, channels=channels, times=times)
    with console.status("") as status:
        timings = time_engines(work, engines.split(","), lambda name: status.update(f"running {name}"))
    headings = ("engine", "CPU s per slot", "pyuvsim / it", "error / rms", "peak memory")
    rows = [
        (
            f"{timing.engine}, {timing.precision}",
            f"{timing.seconds:.3g}",
            f"{timing.ratio:.3g}",
            f"{timing.error:.1e}",
            f"{timing.memory / 1e9:.2f} GB",
        )
        for timing in timings
    ]
    title = f"{sources} sources, {antennas} antennas, {work.slots} slots (time x channel), one core"
    _publish(Table(headings, rows, title), console, output)


@bench_app.command()
def calibrate(
    antennas: Annotated[int, typer.Option(min=3)] = 36,
    channels: Annotated[int, typer.Option(min=64)] = 384,
    integrations: Annotated[int, typer.Option(min=1, help="Solved one from the other.")] = 56,
    adamax_steps: Annotated[
        int, typer.Option(min=0, help="Steps the paper's Adamax is given to come within 0.2 % of the minimum.")
    ] = 20_000,
    device: Annotated[str, typer.Option(help="cpu or gpu.")] = "cpu",
    threads: Annotated[int, typer.Option(min=1, help="Processor cores to use.")] = 1,
    output: Annotated[Path | None, typer.Option(help="Also write the table: a name ending in .md or .csv.")] = None,
) -> None:
    """Time steps and solves of the calibrator against the paper's solver, on a synthetic problem."""
    from calstudy.base.quiet import load_tensorflow

    if output is not None:
        require_writable(output)
    load_tensorflow(threads)
    from calstudy.bench.calibration import HEADINGS, time_calibrator
    from calstudy.bench.calibration_case import Case

    case = Case(antennas=antennas, channels=channels)
    rows = time_calibrator(case, integrations, adamax_steps, device)
    _publish(Table(HEADINGS, rows, "calibrator"), Console(highlight=False), output)


@bench_app.command()
def arrays(
    names: Annotated[str, typer.Option("--arrays", help="Names, separated by commas; by default all.")] = "",
    integrations: Annotated[int, typer.Option(min=2, help="Solved one from the other.")] = 6,
    device: Annotated[str, typer.Option(help="cpu or gpu.")] = "cpu",
    output: Output = None,
) -> None:
    """Time the default solver on arrays of every kind, each in a process of its own with one thread."""
    from calstudy.base.quiet import load_tensorflow

    if output is not None:
        require_writable(output)
    load_tensorflow(1)
    from calstudy.bench.arrays import ARRAYS, HEADINGS, require_arrays, time_array
    from calstudy.bench.calibration import unit_of

    chosen = names.split(",") if names else list(ARRAYS)
    require_arrays(chosen)

    def row(name: str) -> Sequence[str]:
        found = time_array(name, integrations, device)
        return (
            name,
            f"{found.baselines}",
            f"{found.channels}",
            f"{found.first:.2f}",
            f"{found.cold:.2f}",
            f"{found.warm:.2f}",
            f"{found.cold_steps}, {found.warm_steps:g}" + ("" if found.converged else ", not converged"),
            f"{found.memory / 1e9:.1f} GB",
        )

    _publish_rows(Table(HEADINGS, [], f"default solver, {unit_of(device)}"), chosen, row, output)


@bench_app.command()
def memory(
    antennas: Annotated[str, typer.Option(help="Sizes, separated by commas.")] = "36,128",
    channels: Annotated[int, typer.Option(min=64)] = 384,
    max_memory: Annotated[str, typer.Option(metavar="SIZE", help="What one solve may take.")] = "16 GB",
    max_steps: Annotated[int, typer.Option(min=1, help="Steps of the default solver at most.")] = 100,
    output: Output = None,
) -> None:
    """Solve one integration of growing arrays, each in a process of its own: planned and measured memory, time."""
    from calstudy.base.quiet import require_tensorflow

    if output is not None:
        require_writable(output)
    require_tensorflow()
    from calstudy.base.resources import parse_memory
    from calstudy.bench.solve_memory import HEADINGS, measure_solve

    budget, sizes = parse_memory(max_memory), _sizes(antennas)

    def row(size: int) -> Sequence[str]:
        found = measure_solve(size, channels, budget, max_steps)
        return (
            f"{found.antennas}",
            f"{found.baselines}",
            f"{found.models_at_once}",
            f"{found.planned / 1e9:.1f} GB",
            f"{found.measured / 1e9:.1f} GB",
            f"{found.cpu_seconds:.0f}",
            f"{found.n_steps}, {found.status}",
        )

    title = f"one cold solve, {channels} channels, one core"
    _publish_rows(Table(HEADINGS, [], title), sizes, row, output)


def _publish(table: Table, console: Console, output: Path | None) -> None:
    """Print a table, and write it to a file if one is wanted."""
    table.show(console)
    if output is not None:
        table.write(output)


def _publish_rows(
    table: Table, items: Sequence[Item], measure: Callable[[Item], Sequence[str]], output: Path | None
) -> None:
    """Measure and publish row by row: the file gets each row at once, and an interrupted run prints its rows.

    Parameters
    ----------
    table
        Its headings and title.
    items
        What is measured, in order; shown meanwhile.
    measure
        Returns the cells of a row.
    output
        File for the table, if one is wanted.
    """
    console = Console(highlight=False)
    try:
        for item in items:
            with console.status(f"{item}"):
                table = replace(table, rows=[*table.rows, measure(item)])
            if output is not None:
                table.write(output)
    finally:
        if table.rows:
            table.show(console)


def _sizes(text: str) -> list[int]:
    """Return the numbers of antennas in a text such as ``36,128``; raises InputError for anything else."""
    if not re.fullmatch(r"\d+(,\d+)*", text) or min(map(int, text.split(","))) < 3:
        raise InputError(f"--antennas {text}: write whole numbers of at least 3, separated by commas, such as 36,128")
    return [int(part) for part in text.split(",")]
