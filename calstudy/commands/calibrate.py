"""``calstudy calibrate``: the calibrator on anyone's data."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from calstudy.errors import InputError

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.calibrate.records import CalibrationResult
    from calstudy.calibrate.settings import CalibrationSettings

EXIT_UNCONVERGED = 3
# More solves than this that did not converge are counted instead of named.
NAMED = 5
# A fit is said to be able to absorb anything from this many unknowns per sample on.
CROWDED = 0.9
# Real data of few baselines have directions that converge slowly, at next to no cost.
PATIENT = {"name": "gauss-newton", "max_steps": 500}

Data = Annotated[list[Path], typer.Argument(help="Visibilities in any format that pyuvdata reads.", show_default=False)]
SkyModel = Annotated[Path | None, typer.Option("--sky-model", help="Visibilities that fix the overall scale.")]
Gains = Annotated[Path | None, typer.Option(help="CalH5 or calfits file to start from; by default unity.")]
SettingsFile = Annotated[Path | None, typer.Option("--settings", help="YAML file: a `calibration` section.")]
SolverName = Annotated[str | None, typer.Option("--solver", help="gauss-newton (default), lbfgs, adamax, adam or sgd.")]
Buffer = Annotated[str | None, typer.Option(help="Added to the horizon delay of the foreground model: '100 ns'.")]
Redundant = Annotated[bool, typer.Option("--redundant", help="One foreground model per redundant group.")]
GainsOnly = Annotated[bool, typer.Option("--gains-only", help="Freeze the sky model and solve for gains alone.")]
Weighting = Annotated[str | None, typer.Option(help="flags (default), nsamples, autos, or a UVFlag file.")]
Select = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KEY=VALUE",
        help="antennas=0,1,12  lengths='14 m..60 m'  times=0..9  frequencies='120 MHz..'  polarizations=xx",
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="FIELD=VALUE", help="Any field of `calibration`: --set basis.min_delay='50 ns'."),
]
Output = Annotated[Path, typer.Option(help="Folder for the results.")]
Calfits = Annotated[bool, typer.Option("--calfits", help="Also write the gains as calfits.")]
ExpectedLoss = Annotated[
    bool, typer.Option("--expected-loss", help="Also write the signal loss that the fit is expected to cause.")
]
MaxMemory = Annotated[
    str | None, typer.Option(metavar="SIZE", help="Memory to use at most, such as '6 GB'; by default what is free.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace results of an earlier calibration.")]


def calibrate(
    data: Data,
    sky_model: SkyModel = None,
    gains: Gains = None,
    settings_file: SettingsFile = None,
    solver: SolverName = None,
    buffer: Buffer = None,
    redundant: Redundant = False,
    gains_only: GainsOnly = False,
    weights: Weighting = None,
    select: Select = None,
    overrides: Set = None,
    output: Output = Path("calibrated"),
    calfits: Calfits = False,
    expected_loss: ExpectedLoss = False,
    overwrite: Overwrite = False,
    max_memory: MaxMemory = None,
) -> None:
    """Calibrate visibilities: solve for gains and foregrounds, write both and the residual.

    Writes gains.calh5, model.uvh5, residual.uvh5, solution.json and a diagnostic figure. Exit status: 0 if every solve
    converged, 3 if some did not, 2 if something given cannot be used.
    """
    from calstudy.calibrate.options import read_settings
    from calstudy.calibrate.output import CALFITS, EXPECTED
    from calstudy.running.capacity import parse_memory

    changes = {
        "solver": PATIENT if solver is None and settings_file is None else solver,
        "basis.buffer": buffer,
        "calibrator": _calibrator(redundant, gains_only),
        "weights": _weights(weights),
        # Without a model of the sky nothing knows the scale; visibilities of any phase may sum to nothing.
        "prior": "gains" if sky_model is None else None,
        "initial_gains": None if gains is None else {"kind": "file", "path": str(gains)},
    }
    settings = read_settings(settings_file, changes, overrides or [])
    budget = None if max_memory is None else parse_memory(max_memory)
    extras = [name for name, wanted in ((CALFITS, calfits), (EXPECTED, expected_loss)) if wanted]
    files = {"extras": extras, "overwrite": overwrite}
    sys.exit(_run(data, sky_model, settings, select or [], output, budget=budget, **files))


def _calibrator(redundant: bool, gains_only: bool) -> str | None:
    if redundant and gains_only:
        raise InputError("--redundant and --gains-only: choose one; a frozen sky model has no groups")
    return "calamity-redundant" if redundant else "sky-based" if gains_only else None


def _weights(text: str | None) -> Any:
    if text is None or text in ("flags", "nsamples", "autos"):
        return text
    if not Path(text).is_file():
        raise InputError(f"--weights {text}: neither flags, nsamples or autos, nor a file")
    return {"kind": "file", "path": text}


def _run(
    paths: list[Path],
    sky_path: Path | None,
    settings: CalibrationSettings,
    selections: list[str],
    output: Path,
    *,
    budget: float | None,
    extras: list[str],
    overwrite: bool,
) -> int:
    from calstudy.quiet import load_tensorflow

    load_tensorflow()
    from calstudy.calibrate.output import EXPECTED, describe, require_free, write_result
    from calstudy.calibrate.selection import parse_selection
    from calstudy.stages.files import quiet_libraries

    selection = parse_selection(selections)
    require_free(output, extras, overwrite)
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    started = time.perf_counter()
    with quiet_libraries():
        data, sky, notes = _load(paths, sky_path, selection)
        settings, plan = _plan(data, settings, notes, budget)
        for note in notes:
            console.print(note, markup=False)
        console.print(plan, markup=False)
        result = _calibrate(data, sky, settings, console)
        context = {
            "data": [str(path) for path in paths],
            "sky_model": None if sky_path is None else str(sky_path),
            "selection": asdict(selection),
            "settings": settings.model_dump(mode="json"),
            "notes": notes,
            "plan": plan,
        }
        expected = _expected(data, sky, settings, result) if EXPECTED in extras else {}
        figure = _figure(data, result, notes)
        written = write_result(result, describe(result, context), output, figure, extras, expected)
    console.print(f"{len(written)} files in {output}, {time.perf_counter() - started:.1f} s", markup=False)
    _tell_distance(result, console)
    return _verdict(result)


def _load(paths: list[Path], sky_path: Path | None, selection: Any) -> tuple[UVData, UVData | None, list[str]]:
    from calstudy.calibrate.reading import match_sky_model, prepare, read_visibilities
    from calstudy.calibrate.selection import Selection

    data, notes = prepare(read_visibilities(paths), selection)
    if sky_path is None:
        return data, None, notes
    sky, sky_notes = prepare(read_visibilities([sky_path]), Selection(polarizations=selection.polarizations))
    return data, match_sky_model(sky, data), notes + [f"Sky model: {note}" for note in sky_notes]


def _plan(
    data: UVData, settings: CalibrationSettings, notes: list[str], budget: float | None
) -> tuple[CalibrationSettings, str]:
    """Fit the solver to the memory, say what will be done, note what will not work well, and refuse what cannot fit."""
    from calstudy.calibrate.measured import fitted_part
    from calstudy.calibrate.memory import Dimensions, fit_models_at_once, solve_memory
    from calstudy.calibrate.structure import make_structure, repeat_structure
    from calstudy.resources import free_memory

    with _sentences():
        structure, _ = make_structure(fitted_part(data, settings.autos), settings)
    together = min(settings.integrations_per_solve, data.Ntimes)
    dimensions = Dimensions.of(repeat_structure(structure, together))
    results, available = 6 * data.data_array.nbytes, free_memory() if budget is None else budget
    settings = fit_models_at_once(dimensions, settings, available - results)
    needed = solve_memory(dimensions, settings) + results
    unknowns = structure.basis.n_coefficients + structure.n_antennas * structure.n_frequencies
    samples = structure.n_baselines * structure.n_frequencies
    if settings.calibrator != "sky-based" and unknowns >= CROWDED * samples:
        notes.append(
            f"The fit has {unknowns} unknowns for {samples} samples, so that it can absorb anything: expect slow "
            "convergence, and no residual; use a smaller basis.min_delay or --buffer, or --redundant."
        )
    if needed > available:
        raise InputError(
            f"{structure.n_antennas} antennas, {structure.n_baselines} baselines and {structure.n_frequencies} "
            f"channels need about {needed / 1e9:.1f} GB, and {available / 1e9:.1f} GB are "
            f"{'free' if budget is None else 'allowed by --max-memory'}; --select fewer of them"
        )
    solves = -(-data.Ntimes // together) * data.Npols
    return settings, (
        f"{structure.n_antennas} antennas, {structure.n_baselines} baselines, {structure.n_frequencies} channels, "
        f"{data.Ntimes} integrations, {data.Npols} polarizations: {solves} solves, {structure.basis.n_coefficients} "
        f"foreground coefficients each, about {needed / 1e9:.1f} GB"
    )


@contextmanager
def _sentences() -> Iterator[None]:
    """Turn the numerical core's refusals of data into a user's mistakes."""
    try:
        yield
    except ValueError as error:
        raise error if isinstance(error, InputError) else InputError(str(error)) from None


def _calibrate(data: UVData, sky: UVData | None, settings: CalibrationSettings, console: Console) -> CalibrationResult:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from calstudy.calibrate.calamity import calibrate as run

    columns = (TextColumn("calibrating"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with _sentences(), Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("calibrating", total=None)
        return run(data, settings, sky, progress=lambda done, total: bar.update(task, completed=done, total=total))


def _figure(data: UVData, result: CalibrationResult, notes: list[str]) -> tuple[Any, dict[str, Any]]:
    from calstudy.calibrate.diagnostics import diagnose
    from calstudy.figures.diagnostics import draw_diagnostics
    from calstudy.figures.save import figure_arrays

    found = diagnose(data, result)
    return draw_diagnostics(found, notes), figure_arrays(found)


def _expected(
    data: UVData, sky: UVData | None, settings: CalibrationSettings, result: CalibrationResult
) -> dict[str, Any]:
    """Return the expected transfer function of every polarization that has solutions."""
    from calstudy.calibrate.expectation import expect

    found = {pol: expect(data, settings, result, sky, index) for index, pol in enumerate(result.model.get_pols())}
    return {pol: expected for pol, expected in found.items() if expected is not None}


def _tell_distance(result: CalibrationResult, console: Console) -> None:
    """Say how much the residual still holds because the iterations stopped."""
    left = [record for record in result.solutions if math.isfinite(record.remaining)]
    if left:
        worst = max(left, key=lambda record: record.remaining)
        console.print(
            f"left by stopping: at most {100 * worst.remaining:.2g} % of the residual's power "
            f"({worst.remaining_rms:.2g} {result.model.vis_units} rms)",
            markup=False,
        )


def _verdict(result: CalibrationResult) -> int:
    unconverged = result.unconverged
    if not unconverged:
        return 0
    typer.echo(f"calstudy: {len(unconverged)} of {len(result.solutions)} solves did not converge:", err=True)
    for record in unconverged[:NAMED]:
        typer.echo(
            f"calstudy: integration {record.integration}, polarization {record.polarization}: {record.status}, "
            f"{record.message}",
            err=True,
        )
    if len(unconverged) > NAMED:
        typer.echo(f"calstudy: and {len(unconverged) - NAMED} more, see solution.json", err=True)
    return EXIT_UNCONVERGED
