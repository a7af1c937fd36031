"""``calstudy calibrate``: the calibrator on anyone's data."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from calstudy.base.errors import InputError

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.calibrate.interface import Calibrator
    from calstudy.calibrate.records import CalibrationResult
    from calstudy.calibrate.settings import GainFit

EXIT_UNCONVERGED = 3
# More solves than this that did not converge are counted instead of named.
NAMED = 5
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
    from calstudy.base.resources import parse_memory
    from calstudy.observed.options import read_calibrator
    from calstudy.observed.output import CALFITS, EXPECTED

    changes = {
        "solver": solver,
        "basis.buffer": buffer,
        "calibrator": _calibrator(redundant, gains_only),
        "weights": _weights(weights),
    }
    defaults = {
        "initial_gains": None if gains is None else {"kind": "file", "path": str(gains)},
        "solver": PATIENT if solver is None and settings_file is None else None,
        # Without a model of the sky nothing knows the scale; visibilities of any phase may sum to nothing.
        "prior": "gains" if sky_model is None else None,
    }
    calibrator = read_calibrator(settings_file, changes, defaults, overrides or [])
    budget = None if max_memory is None else parse_memory(max_memory)
    extras = [name for name, wanted in ((CALFITS, calfits), (EXPECTED, expected_loss)) if wanted]
    request = _Request(data, sky_model, gains, select or [], output, budget, extras, overwrite)
    sys.exit(_run(request, calibrator))


@dataclass(frozen=True)
class _Request:
    """What is to be calibrated, with how much memory (bytes, None for what is free), and what is to be written."""

    paths: list[Path]
    sky_path: Path | None
    gains_path: Path | None
    selections: list[str]
    output: Path
    budget: float | None
    extras: list[str]
    overwrite: bool


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


def _run(request: _Request, calibrator: Calibrator) -> int:
    from calstudy.base.quiet import load_tensorflow
    from calstudy.calibrate.settings import GainFit

    if isinstance(calibrator, GainFit):
        load_tensorflow()
    from calstudy.observed.output import EXPECTED, describe, require_free, write_result
    from calstudy.observed.selection import parse_selection
    from calstudy.products.files import quiet_libraries

    selection = parse_selection(request.selections)
    require_free(request.output, request.extras, request.overwrite)
    if EXPECTED in request.extras and not isinstance(calibrator, GainFit):
        raise InputError(f"--expected-loss: is known for fits by least squares, and {calibrator.label} is none")
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    started = time.perf_counter()
    with quiet_libraries():
        data, sky, notes = _load(request.paths, request.sky_path, selection)
        calibrator, plan = _plan(data, calibrator, sky is not None, notes, request.budget)
        for note in notes:
            console.print(note, markup=False)
        console.print(plan, markup=False)
        result = _calibrate(data, sky, calibrator, request.gains_path, console)
        context = {
            "data": [str(path) for path in request.paths],
            "sky_model": None if request.sky_path is None else str(request.sky_path),
            "gains": None if request.gains_path is None else str(request.gains_path),
            "selection": asdict(selection),
            "settings": calibrator.model_dump(mode="json"),
            "notes": notes,
            "plan": plan,
        }
        expected = {}
        if EXPECTED in request.extras and isinstance(calibrator, GainFit):
            expected = _expected(data, sky, calibrator, result)
        figure, description = _figure(data, result, notes), describe(result, context)
        written = write_result(result, description, request.output, figure, request.extras, expected)
    console.print(f"{len(written)} files in {request.output}, {time.perf_counter() - started:.1f} s", markup=False)
    _tell_distance(result, console)
    return _verdict(result)


def _load(paths: list[Path], sky_path: Path | None, selection: Any) -> tuple[UVData, UVData | None, list[str]]:
    from calstudy.calibrate.sky_model import match_sky_model
    from calstudy.observed.reading import prepare, read_visibilities
    from calstudy.observed.selection import Selection

    data, notes = prepare(read_visibilities(paths), selection)
    if sky_path is None:
        return data, None, notes
    sky, sky_notes = prepare(read_visibilities([sky_path]), Selection(polarizations=selection.polarizations))
    return data, match_sky_model(sky, data), notes + [f"Sky model: {note}" for note in sky_notes]


def _plan(
    data: UVData, calibrator: Calibrator, has_sky_model: bool, notes: list[str], budget: float | None
) -> tuple[Calibrator, str]:
    """Fit the calibrator to the memory, say what will be done, note what will not work well, refuse what cannot fit."""
    from calstudy.base.observation import Observation
    from calstudy.base.plugins import guarded
    from calstudy.base.resources import free_memory
    from calstudy.calibrate.execution import require_calibratable

    frame = Observation(data)
    require_calibratable(calibrator, frame, has_sky_model)
    results, available = 6 * data.data_array.nbytes, free_memory() if budget is None else budget
    with guarded(calibrator):
        outline = calibrator.outline(frame)
        while outline.cost.memory + results > available and (leaner := calibrator.leaner()) is not None:
            calibrator, outline = leaner, leaner.outline(frame)
    notes += outline.notes
    cross = frame.n_baselines - int(frame.autos.sum())
    needed = outline.cost.memory + results
    if needed > available:
        raise InputError(
            f"{frame.n_antennas} antennas, {cross} baselines and {frame.n_channels} channels need about "
            f"{needed / 1e9:.1f} GB, and {available / 1e9:.1f} GB are "
            f"{'free' if budget is None else 'allowed by --max-memory'}; --select fewer of them"
        )
    solves = len(calibrator.solves(frame.n_times)) * frame.n_polarizations
    details = "".join(f", {part}" for part in (outline.details, f"about {needed / 1e9:.1f} GB") if part)
    return calibrator, (
        f"{frame.n_antennas} antennas, {cross} baselines, {frame.n_channels} channels, {frame.n_times} integrations, "
        f"{frame.n_polarizations} polarizations: {solves} solves{details}"
    )


def _calibrate(
    data: UVData, sky: UVData | None, calibrator: Calibrator, gains_path: Path | None, console: Console
) -> CalibrationResult:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from calstudy.base.gains import read_gains
    from calstudy.calibrate.execution import run_calibrator

    start = None if gains_path is None else read_gains(gains_path, "--gains")

    def show(done: int, total: int) -> None:
        bar.update(task, completed=done, total=total)

    columns = (TextColumn("calibrating"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("calibrating", total=None)
        return run_calibrator(calibrator, data, sky, start, show)


def _figure(data: UVData, result: CalibrationResult, notes: list[str]) -> tuple[Any, dict[str, Any]]:
    from calstudy.observed.diagnostics import diagnose
    from calstudy.observed.diagnostics_figure import draw_diagnostics
    from calstudy.plotting.save import figure_arrays

    found = diagnose(data, result)
    return draw_diagnostics(found, notes), figure_arrays(found)


def _expected(data: UVData, sky: UVData | None, calibrator: GainFit, result: CalibrationResult) -> dict[str, Any]:
    """Return the expected transfer function of every polarization that has solutions."""
    from calstudy.observed.expectation import expect

    found = {pol: expect(data, calibrator, result, sky, index) for index, pol in enumerate(result.model.get_pols())}
    return {pol: expected for pol, expected in found.items() if expected is not None}


def _tell_distance(result: CalibrationResult, console: Console) -> None:
    """Say how much the residual still holds because the iterations stopped."""
    left = [record for record in result.solutions if math.isfinite(record.newton_decrement)]
    if left:
        worst = max(left, key=lambda record: record.newton_decrement)
        console.print(
            f"left by stopping: at most {100 * worst.newton_decrement:.2g} % of the residual's power "
            f"({worst.decrement_rms:.2g} {result.model.vis_units} rms)",
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
