"""``calstudy bench``: what the parts cost, measured here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

bench_app = typer.Typer(help="Measure what the parts cost on this machine.", no_args_is_help=True)

Output = Annotated[Path | None, typer.Option(help="Also write the table here, as .csv or .md.")]


@bench_app.callback()
def _group() -> None:
    """Keep `simulate` a subcommand, even while it is the only one."""


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
    from calstudy.bench.engines import Work, compare_engines
    from calstudy.bench.tables import require_writable, show, write

    if output is not None:
        require_writable(output)
    console = Console(highlight=False)
    work = Work(sources=sources, antennas=antennas, channels=channels, times=times)
    with console.status("") as status:
        timings = compare_engines(work, engines.split(","), lambda name: status.update(f"running {name}"))
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
    show(title, headings, rows, console)
    if output is not None:
        write(output, headings, rows)


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
    from calstudy.bench.tables import require_writable, show, write
    from calstudy.quiet import load_tensorflow

    if output is not None:
        require_writable(output)
    load_tensorflow(threads)
    from calstudy.bench.calibration import HEADINGS, measure
    from calstudy.bench.calibration_case import Case

    rows = measure(Case(antennas=antennas, channels=channels), integrations, adamax_steps, device)
    table = [(row.name, row.value, row.note) for row in rows]
    show("calibrator", HEADINGS, table, Console(highlight=False))
    if output is not None:
        write(output, HEADINGS, table)
