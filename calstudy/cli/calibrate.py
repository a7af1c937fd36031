"""``calstudy calibrate``: calibration of measured data."""

from __future__ import annotations

import math
import shutil
import statistics
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from calstudy.base.errors import InputError

if TYPE_CHECKING:
    from pyuvdata import UVCal, UVData

    from calstudy.calibrate.interface import Calibrator
    from calstudy.calibrate.records import CalibrationResult
    from calstudy.calibrate.settings import GainFit
    from calstudy.measured.selection import Selection
    from calstudy.observed.pieces import Given

EXIT_UNCONVERGED = 3
# More unconverged solves than this are counted instead of named.
NAMED = 5
SECONDS_BETWEEN_LINES = 10.0

Data = Annotated[list[Path], typer.Argument(help="Visibilities in any format that pyuvdata reads.", show_default=False)]
SkyModel = Annotated[Path | None, typer.Option("--sky-model", help="Visibilities that fix the overall scale.")]
Gains = Annotated[Path | None, typer.Option(help="CalH5 or calfits file to start from; by default unity.")]
SettingsFile = Annotated[Path | None, typer.Option("--settings", help="YAML file: a `calibration` section.")]
SolverName = Annotated[str | None, typer.Option("--solver", help="gauss-newton (default) or adamax.")]
Buffer = Annotated[str | None, typer.Option(help="Added to the horizon delay of the foreground model: '100 ns'.")]
Redundant = Annotated[bool, typer.Option("--redundant", help="One foreground model per redundant group.")]
GainsOnly = Annotated[bool, typer.Option("--gains-only", help="Freeze the sky model and solve for gains alone.")]
Weighting = Annotated[str | None, typer.Option(help="gains (default), flags, nsamples, autos, or a UVFlag file.")]
Select = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KEY=VALUE",
        help="antennas=0,1,12  lengths='14 m..60 m'  times=0..9  frequencies='120 MHz..'  polarizations=xx",
    ),
]
FlagInterference = Annotated[
    bool, typer.Option("--flag-interference", help="First flag what stands out in time and frequency, by hera_qm.")
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
DryRun = Annotated[bool, typer.Option("--dry-run", help="Read and check everything, say what would be done, and stop.")]
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
    interference: FlagInterference = False,
    overrides: Set = None,
    output: Output = Path("calibrated"),
    calfits: Calfits = False,
    expected_loss: ExpectedLoss = False,
    overwrite: Overwrite = False,
    max_memory: MaxMemory = None,
    dry_run: DryRun = False,
) -> None:
    """Calibrate visibilities: solve for gains and foregrounds, write both and the residual.

    Writes gains.calh5, model.uvh5, residual.uvh5, solution.json and a diagnostic figure, and warns of outliers among
    channels, antennas and integrations. The same command resumes an interrupted calibration. Exit status: 0 if every
    solve converged, 3 if some did not, 2 if an input cannot be used.
    """
    from calstudy.base.resources import parse_memory
    from calstudy.measured.defaults import defaults
    from calstudy.observed.options import read_calibrator
    from calstudy.observed.output import CALFITS, EXPECTED

    changes = {
        "solver": solver,
        "basis.buffer": buffer,
        "calibrator": _calibrator(redundant, gains_only),
        "weights": _weights(weights),
    }
    start = None if gains is None else {"kind": "file", "path": str(gains)}
    assumed = {"initial_gains": start, **defaults(sky_model is not None)}
    calibrator = read_calibrator(settings_file, changes, assumed, overrides or [])
    budget = None if max_memory is None else parse_memory(max_memory)
    extras = [name for name, wanted in ((CALFITS, calfits), (EXPECTED, expected_loss)) if wanted]
    request = _Request(data, sky_model, gains, select or [], interference, output, budget, extras, overwrite, dry_run)
    sys.exit(_run(request, calibrator))


@dataclass(frozen=True)
class _Request:
    """The data and the calibration, the memory (bytes, None for all that is free), and the requested output."""

    paths: list[Path]
    sky_path: Path | None
    gains_path: Path | None
    selections: list[str]
    interference: bool
    output: Path
    budget: float | None
    extras: list[str]
    overwrite: bool
    dry_run: bool

    @property
    def files(self) -> list[Path]:
        """All input files."""
        return [*self.paths, *(path for path in (self.sky_path, self.gains_path) if path is not None)]


def _calibrator(redundant: bool, gains_only: bool) -> str | None:
    if redundant and gains_only:
        raise InputError("--redundant and --gains-only: choose one; a frozen sky model has no groups")
    return "calamity-redundant" if redundant else "sky-based" if gains_only else None


def _weights(text: str | None) -> Any:
    if text is None or text in ("gains", "flags", "nsamples", "autos"):
        return text
    if not Path(text).is_file():
        raise InputError(f"--weights {text}: neither gains, flags, nsamples or autos, nor a file")
    return {"kind": "file", "path": text}


def _run(request: _Request, calibrator: Calibrator) -> int:
    from calstudy.calibrate.settings import NOISE_UNKNOWN, ForegroundFit, GainFit
    from calstudy.measured.selection import parse_selection
    from calstudy.observed.output import EXPECTED, describe, require_free, write_result

    if isinstance(calibrator, ForegroundFit) and calibrator.needs_noise:
        raise InputError(NOISE_UNKNOWN)

    selection = parse_selection(request.selections)
    if calibrator.needs_autos:
        selection = replace(selection, autos=True)
    require_free(request.output, request.extras, request.overwrite)
    if EXPECTED in request.extras and not isinstance(calibrator, GainFit):
        raise InputError(f"--expected-loss: is known for fits by least squares, and {calibrator.label} is none")
    # These import pyuvdata, so they come after all refusals that do not need it.
    from calstudy.observed.pieces import Given, pieces_folder
    from calstudy.products.files import quiet_libraries

    console = Console(stderr=True, soft_wrap=True, highlight=False)
    started = time.perf_counter()
    with quiet_libraries():
        autos = isinstance(calibrator, GainFit) and calibrator.autos
        data, sky, notes = _load(request, selection, autos)
        calibrator, plan = _plan(data, calibrator, sky is not None, notes, request.budget)
        for note in notes:
            console.print(note, markup=False)
        console.print(plan, markup=False)
        if request.dry_run:
            return 0
        context: dict[str, Any] = {
            "data": [str(path) for path in request.paths],
            "sky_model": None if request.sky_path is None else str(request.sky_path),
            "gains": None if request.gains_path is None else str(request.gains_path),
            "selection": asdict(selection),
            "flag_interference": request.interference,
            "settings": calibrator.model_dump(mode="json"),
            "notes": notes,
            "plan": plan,
        }
        settings = {name: context[name] for name in ("selection", "flag_interference", "settings")}
        folder = pieces_folder(request.output, request.files, settings)
        result = _calibrate(Given(data, sky, _start(request.gains_path)), calibrator, folder, console)
        context["quality"] = _qualities(data, result, console)
        expected = {}
        if EXPECTED in request.extras and isinstance(calibrator, GainFit):
            expected = _expected(data, sky, calibrator, result)
        figure, description = _figure(data, result, notes), describe(result, context)
        written = write_result(result, description, request.output, figure, request.extras, expected)
        shutil.rmtree(folder, ignore_errors=True)
    console.print(f"{len(written)} files in {request.output}, {time.perf_counter() - started:.1f} s", markup=False)
    _tell_distance(result, console)
    _tell_scale(result, console)
    return _verdict(result)


def _load(request: _Request, selection: Selection, autos: bool) -> tuple[UVData, UVData | None, list[str]]:
    from calstudy.calibrate.sky_model import common_baselines
    from calstudy.measured.interference import flag_interference
    from calstudy.measured.reading import prepare, read_visibilities
    from calstudy.measured.selection import Selection
    from calstudy.measured.settings import Interference

    data, notes = prepare(read_visibilities(request.paths), selection)
    if request.interference:
        notes.append(flag_interference(data, Interference()))
    if request.sky_path is None:
        return data, None, notes
    sky, sky_notes = prepare(read_visibilities([request.sky_path]), Selection(polarizations=selection.polarizations))
    sky, data, left_out = common_baselines(sky, data, autos)
    return data, sky, notes + [f"Sky model: {note}" for note in sky_notes] + left_out


def _plan(
    data: UVData, calibrator: Calibrator, has_sky_model: bool, notes: list[str], budget: float | None
) -> tuple[Calibrator, str]:
    """Fit the calibrator to the memory, describe it, and collect notes; raises InputError if it cannot fit."""
    from calstudy.base.observation import Observation
    from calstudy.base.plugins import guarded
    from calstudy.base.resources import free_memory
    from calstudy.calibrate.execution import require_calibratable
    from calstudy.calibrate.weights import conspicuous

    frame = Observation(data)
    require_calibratable(calibrator, frame, has_sky_model)
    results, available = 6 * data.data_array.nbytes, free_memory() if budget is None else budget
    with guarded(calibrator):
        plan = calibrator.plan(frame)
        while plan.cost.memory + results > available and (leaner := calibrator.with_less_memory()) is not None:
            calibrator, plan = leaner, leaner.plan(frame)
    notes += [*conspicuous(frame), *plan.notes]
    cross = frame.n_baselines - int(frame.autos.sum())
    needed = plan.cost.memory + results
    if needed > available:
        raise InputError(
            f"{frame.n_antennas} antennas, {cross} baselines and {frame.n_channels} channels need about "
            f"{needed / 1e9:.1f} GB, and {available / 1e9:.1f} GB are "
            f"{'free' if budget is None else 'allowed by --max-memory'}; --select fewer of them"
        )
    solves = len(calibrator.solves(frame.n_times)) * frame.n_polarizations
    details = "".join(f", {part}" for part in (plan.details, f"about {needed / 1e9:.1f} GB") if part)
    return calibrator, (
        f"{frame.n_antennas} antennas, {cross} baselines, {frame.n_channels} channels, {frame.n_times} integrations, "
        f"{frame.n_polarizations} polarizations: {solves} solves{details}"
    )


def _start(gains_path: Path | None) -> UVCal | None:
    from calstudy.base.gains import read_gains

    return None if gains_path is None else read_gains(gains_path, "--gains")


def _calibrate(given: Given, calibrator: Calibrator, folder: Path, console: Console) -> CalibrationResult:
    """Calibrate with a progress bar on a terminal, and with lines of text elsewhere."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from calstudy.observed.pieces import calibrate_in_pieces

    lines = _ProgressLines(console)

    def show(done: int, total: int) -> None:
        bar.update(task, completed=done, total=total)
        if not console.is_terminal:
            lines.tell(done, total)

    columns = (TextColumn("calibrating"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("calibrating", total=None)
        bar.update(task, completed=0, total=len(calibrator.solves(given.data.Ntimes)) * given.data.Npols)
        return calibrate_in_pieces(calibrator, given, folder, show)


class _ProgressLines:
    """Reports the progress of a calibration in a line of text at most every `SECONDS_BETWEEN_LINES`."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.started = self.told = time.perf_counter()
        self.first: int | None = None

    def tell(self, done: int, total: int) -> None:
        """Print a line if the interval has passed; the first call may count solves of an earlier process."""
        from calstudy.run.progress import duration

        now = time.perf_counter()
        if self.first is None:
            self.first = done - 1
        if now - self.told < SECONDS_BETWEEN_LINES or done >= total:
            return
        self.told = now
        left = (now - self.started) * (total - done) / max(done - self.first, 1)
        text = f"{done} of {total} solves, {duration(now - self.started)}, about {duration(left)} left"
        self.console.print(text, markup=False)


def _qualities(data: UVData, result: CalibrationResult, console: Console) -> list[dict[str, Any]]:
    """Return the outliers of each polarization, and warn of them."""
    from calstudy.measured.quality import assess

    found = [assess(data, result, index) for index in range(result.model.Npols)]
    for warning in (sentence for quality in found for sentence in quality.warnings):
        console.print(f"warning: {warning}", markup=False)
    return [quality.described() for quality in found]


def _figure(data: UVData, result: CalibrationResult, notes: list[str]) -> tuple[Any, dict[str, Any]]:
    from calstudy.observed.diagnostics import diagnose
    from calstudy.observed.diagnostics_figure import draw_diagnostics
    from calstudy.plotting.save import figure_arrays

    found = diagnose(data, result)
    return draw_diagnostics(found, notes), figure_arrays(found)


def _expected(data: UVData, sky: UVData | None, calibrator: GainFit, result: CalibrationResult) -> dict[str, Any]:
    """Return the expected transfer function of every polarization that has solutions."""
    from calstudy.base.observation import Observation
    from calstudy.calibrate.interface import Assumed
    from calstudy.measured.expectation import expect

    assumed = Assumed(None if sky is None else Observation(sky))
    found = {pol: expect(data, calibrator, result, assumed, index) for index, pol in enumerate(result.model.get_pols())}
    return {pol: expected for pol, expected in found.items() if expected is not None}


def _tell_distance(result: CalibrationResult, console: Console) -> None:
    """Print the part of the residual that is left because the iterations stopped."""
    left = [record for record in result.solutions if math.isfinite(record.newton_decrement)]
    if left:
        worst = max(left, key=lambda record: record.newton_decrement)
        console.print(
            f"left by stopping: at most {100 * worst.newton_decrement:.2g} % of the residual's power "
            f"({worst.decrement_rms:.2g} {result.model.vis_units} rms)",
            markup=False,
        )


def _tell_scale(result: CalibrationResult, console: Console) -> None:
    """Print the scale of the calibrated data relative to the sky model, if there is one: medians over the solves."""
    known = [record.diagnostics for record in result.solutions if "sky_model_slope" in record.diagnostics]
    if known:
        slope, shape = (
            statistics.median([item[name] for item in known]) for name in ("sky_model_slope", "band_shape_rms")
        )
        console.print(
            f"calibrated data over the sky model: {slope:.4f}, and {100 * shape:.2g} % rms from channel to channel",
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
