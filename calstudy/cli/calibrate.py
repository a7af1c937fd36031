"""``calstudy calibrate`` and ``compare-gains``: calibration of measured data, and files of gains side by side."""

from __future__ import annotations

import json
import re
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from calstudy.base.errors import InputError
from calstudy.base.files import write_text
from calstudy.cli.options import MaxMemory, Overwrite, named_as_options

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calstudy.base.gains import ErrorsOfFile
    from calstudy.calibrate.gain_comparison import GainDifference


EXIT_UNCONVERGED = 3
# More unconverged solves than this are counted instead of named.
NAMED = 5
OPTIONS = (
    (r"observed\.data(\.\d+)?: ", ""),
    (r"observed\.select\.", "--select "),
    (r"observed\.sky_model", "--sky-model"),
    (r"--set outputs\.store=DIR", "--output"),
    (r"^output = ", "--output "),
    (r"^expected_loss: ", "--expected-loss: "),
    (r"^also(\.\d+)?(:| =) ", "--also "),
    (r"`overwrite`", "--overwrite"),
)
"""Fields of files in messages, and the options of the command that set them."""

Data = Annotated[list[Path], typer.Argument(help="Visibilities in any format that pyuvdata reads.", show_default=False)]
SkyModel = Annotated[Path | None, typer.Option("--sky-model", help="Visibilities that fix the overall scale.")]
Gains = Annotated[Path | None, typer.Option(help="File of gains to start from; by default unity.")]
SettingsFile = Annotated[Path | None, typer.Option("--settings", help="YAML file: a `calibration` section.")]
Buffer = Annotated[str | None, typer.Option(help="Added to the horizon delay of the foreground model: '100 ns'.")]
Redundant = Annotated[bool, typer.Option("--redundant", help="One foreground model per redundant group.")]
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
Also = Annotated[
    list[str] | None,
    typer.Option(
        metavar="FORMAT",
        help="Also write the gains as calfits, h5parm, hyperdrive (FITS) or mwaocal (.bin).",
    ),
]
ExpectedLoss = Annotated[
    bool, typer.Option("--expected-loss", help="Also write the signal loss that the fit is expected to cause.")
]
GainErrors = Annotated[
    bool, typer.Option(help="Give gains their errors by noise; about a third of the time of the solves.")
]
Realizations = Annotated[
    int | None,
    typer.Option(
        "--gain-error-realizations",
        min=2,
        metavar="N",
        help="For calibrators without errors of gains: find them by N more calibrations, of realizations of the noise.",
    ),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Read and check everything, say what would be done, and stop.")]


def calibrate(
    data: Data,
    sky_model: SkyModel = None,
    gains: Gains = None,
    settings_file: SettingsFile = None,
    buffer: Buffer = None,
    redundant: Redundant = False,
    weights: Weighting = None,
    select: Select = None,
    interference: FlagInterference = False,
    overrides: Set = None,
    output: Output = Path("calibrated"),
    also: Also = None,
    gain_errors: GainErrors = True,
    gain_error_realizations: Realizations = None,
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
    from calstudy.products.files import quiet_libraries
    from calstudy.realdata.selection import split_selections
    from calstudy.run.execution import Budget
    from calstudy.studies.calibration import UNFINISHED, DataCalibration, calibration_file, require_free

    changes = {
        "basis.buffer": buffer,
        "calibrator": "calamity-redundant" if redundant else None,
        "weights": _weights(weights),
        "initial_gains": None if gains is None else {"kind": "file", "path": str(gains)},
    }
    if max_memory is not None:
        parse_memory(max_memory)
    if gain_error_realizations and not gain_errors:
        raise InputError("--gain-error-realizations, --no-gain-errors: choose one")
    sections = {
        "observed": {
            "data": [str(path) for path in data],
            "select": split_selections(select or []),
            "flag_interference": interference,
            "sky_model": None if sky_model is None else str(sky_model),
        },
        "calibration": _calibration(settings_file, changes),
        "also": also or [],
        "gain_errors": gain_error_realizations or gain_errors,
        "expected_loss": expected_loss,
    }
    # They may use the path of the field in an experiment file.
    texts = [f"calibration.{text.strip().removeprefix('calibration.')}" for text in overrides or []]
    console = Console(soft_wrap=True, highlight=False)
    store = re.escape(f"outputs.store = {str((output / UNFINISHED).resolve())!r}")
    named = f"--output {output}".replace("\\", r"\\")
    with named_as_options(*OPTIONS, (store, named)), quiet_libraries():
        require_free(output, overwrite)
        study = DataCalibration.load(calibration_file(sections, output, texts))
        study, _ = study.sized_to(Budget(workers=1, max_memory=max_memory))
        for line in (*study.notes, *(study.read() if dry_run else ()), study.described()):
            console.print(line, markup=False)
        if dry_run:
            return
        solution = study.run(console)
    sys.exit(_show(solution, output, console))


def _weights(text: str | None) -> Any:
    if text is None or text in ("gains", "flags", "nsamples", "autos"):
        return text
    if not Path(text).is_file():
        raise InputError(f"--weights {text}: neither gains, flags, nsamples or autos, nor a file")
    return {"kind": "file", "path": text}


def _calibration(path: Path | None, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the section `calibration` of a YAML file, which has it or is it, with changes, but for None, by path.

    The path of a calibrator in the file starts at the file, all others at the working directory.
    """
    from calstudy.calibrate.interface import CALIBRATORS
    from calstudy.experiment.files import override, read_mapping

    content: dict[str, Any] = {}
    if path is not None:
        content = dict(read_mapping(path, f"{CALIBRATORS.tag}: calamity"))
        section = content.get("calibration", content)
        if not isinstance(section, str | Mapping | None):
            raise InputError(
                f"{path}: calibration = {section!r}: must be the name of a calibrator, or a block of keys such as "
                f"'{CALIBRATORS.tag}: calamity'"
            )
        content = {CALIBRATORS.tag: section} if isinstance(section, str) else dict(section or {})
        reference = content.get(CALIBRATORS.tag)
        if isinstance(reference, str) and ".py" in reference:
            content[CALIBRATORS.tag] = str(path.parent / Path(reference).expanduser())
    for field, value in changes.items():
        content = content if value is None else override(content, field, value)
    return content


def _show(solution: Mapping[str, Any], output: Path, console: Console) -> int:
    """Print changes of the data, warnings and what is known of the solves; return the exit status."""
    records = solution["records"]
    lines = [*solution["notes"], *(f"warning: {text}" for text in solution["warnings"])]
    lines.append(f"results are in {output}")
    if left := [record for record in records if record["newton_decrement"] is not None]:
        worst = max(left, key=lambda record: record["newton_decrement"])
        lines.append(
            f"left by stopping: at most {100 * worst['newton_decrement']:.2g} % of the residual's power "
            f"({worst['decrement_rms']:.2g} rms, in the unit of the data)"
        )
    lines += _about_the_sky_model([record.get("diagnostics", {}) for record in records])
    reasons = [record["gain_errors"]["reason"] for record in records if "reason" in record.get("gain_errors", {})]
    lines += [
        f"no errors of gains in {reasons.count(reason)} of {len(records)} solves: {reason}; N more calibrations find "
        "them with --gain-error-realizations N"
        for reason in sorted(set(reasons))
        if not any(reason in warning for warning in solution["warnings"])
    ]
    console.print("\n".join(lines), markup=False)
    return _status(records)


def _about_the_sky_model(diagnostics: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return sentences on the data against the sky model, of what solves say of it."""
    lines = []
    if known := [found for found in diagnostics if "sky_model_slope" in found]:
        slope = statistics.median(found["sky_model_slope"] for found in known)
        shape = statistics.median(found["band_shape_rms"] for found in known)
        lines.append(
            f"calibrated data over the sky model: {slope:.4f}, and {100 * shape:.2g} % rms from channel to channel"
        )
    if estimated := [found["deviation"] for found in diagnostics if "deviation" in found]:
        own, shared = (100 * statistics.median(column) for column in zip(*estimated, strict=True))
        common = f", and {shared:.2g} % that redundant baselines share" if shared > 0 else ""
        lines.append(f"errors of the sky model: {own:.2g} % of its rms on each baseline{common}")
    return lines


def _status(records: Sequence[Mapping[str, Any]]) -> int:
    """Print the solves that did not converge to standard error; return the exit status."""
    from calstudy.base.visibilities import polarization_names
    from calstudy.calibrate.records import SETTLED

    unconverged = [record for record in records if record["status"] not in SETTLED]
    if not unconverged:
        return 0
    lines = [f"{len(unconverged)} of {len(records)} solves did not converge:"]
    for record in unconverged[:NAMED]:
        polarization = polarization_names([record["polarization"]])
        where = f"integration {record['integration']}, polarization {polarization}"
        lines.append(f"{where}: {record['status']}, {record['message']}")
    lines += [f"and {len(unconverged) - NAMED} more, see solution.json"] if len(unconverged) > NAMED else []
    for line in lines:
        typer.echo(f"calstudy: {line}", err=True)
    return EXIT_UNCONVERGED


NAME = "gain-comparison"
MOST_NAMES = 40
"""Largest number of antennas that are named on the axis."""

First = Annotated[Path, typer.Argument(help="Gains, a file of any format of gains.", show_default=False)]
Second = Annotated[Path, typer.Argument(help="Gains that they are compared with, such as the true ones.")]
OnlyRedundant = Annotated[
    bool,
    typer.Option(
        "--redundant", help="Also leave out an amplitude and a phase gradient in every channel, as redundancy does."
    ),
]
Feed = Annotated[int, typer.Option(min=0, help="Which of the feeds that both files have, counted from 0.")]
Folder = Annotated[Path, typer.Option("--output", help="Folder for figure, arrays and numbers.")]


def compare_gains(
    first: First,
    second: Second,
    redundant: OnlyRedundant = False,
    feed: Feed = 0,
    folder: Folder = Path("checks"),
    overwrite: Overwrite = False,
) -> None:
    """Compare two files of gains by antenna, channel and delay.

    Antennas, feeds and channels that are in one file only are left out. One phase in every channel and one real
    scale are removed in every integration, because no data determine them. If both files have errors of gains, the
    difference is given in units of them as well.
    """
    from calstudy.base.gain_files import read_gain_pair
    from calstudy.base.gains import at_common_channels
    from calstudy.calibrate.gain_comparison import compare_gains, pair_gains
    from calstudy.plotting import style
    from calstudy.plotting.style import figure_arrays, save_figure
    from calstudy.products.files import quiet_libraries
    from calstudy.run.store import require_writable

    if (folder / f"{NAME}.json").exists() and not overwrite:
        raise InputError(f"--output {folder}: holds {NAME}.json already; use --overwrite or another folder")
    require_writable(folder.absolute(), f"--output {folder}")
    with quiet_libraries():
        files = read_gain_pair(first, second)
        common = at_common_channels(*files)
        whole = all(one is other for one, other in zip(files, common, strict=True))
        errors = _errors_of_both(first, second, "--redundant" if redundant else "" if whole else "other channels")
        found = compare_gains(pair_gains(*common, feed, errors), redundant)
    numbers = _numbers(found)
    for name, value in numbers.items():
        typer.echo(f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value}")
    with style.journal_style():
        figure = _draw(found)
    for path in save_figure(figure, figure_arrays(found), folder, NAME):
        typer.echo(f"{path}")
    path = folder / f"{NAME}.json"
    write_text(path, json.dumps(numbers, indent=1))
    typer.echo(f"{path}")


def _errors_of_both(first: Path, second: Path, other_gains: str) -> tuple[ErrorsOfFile, ErrorsOfFile] | None:
    """Read the errors of gains of two files; None if they are not compared, which is announced if there are some.

    `other_gains` says why errors are not of the gains that are compared, and is empty if they are.
    """
    from calstudy.base.gains import find_gain_errors
    from calstudy.calibrate.gain_comparison import obstacle

    one, other = find_gain_errors(first), find_gain_errors(second)
    if one is None or other is None:
        reason: str | None = f"{first if one is None else second} has none"
    elif not (reason := other_gains or obstacle(one, other)):
        return one, other
    if one is not None or other is not None:
        typer.echo(f"calstudy: errors of gains are not compared: {reason}", err=True)
    return None


def _in_units_of_errors(found: GainDifference) -> dict[str, float | str]:
    """Return chi^2 and the percentages of the differences within 1 and 1.96 errors, by what they are called."""
    from calstudy.calibrate.agreement import PARTS

    if found.pulls is None:
        return {}
    delay = found.pair.smooth_delay
    compared = f"beyond {1e9 * delay:.0f} ns" if delay > 0 else "all"
    numbers: dict[str, float | str] = {"gains that are compared with their errors": compared}
    noise = f"({_percentages(found.expected_within)} % if independent noise makes all of it)"
    for name, chi_squared, within in zip(PARTS, found.chi_squared, found.within, strict=True):
        numbers[f"chi-squared per {name}"] = chi_squared
        numbers[f"{name}s within 1 and 1.96 errors"] = f"{_percentages(within)} % {noise}"
    return numbers


def _percentages(fractions: Sequence[float]) -> str:
    return " and ".join(f"{100 * fraction:.1f}" for fraction in fractions)


def _numbers(found: GainDifference) -> dict[str, float | int | str]:
    import numpy as np

    worst = int(np.nanargmax(found.of_antenna))
    return {
        "antennas": int(np.isfinite(found.of_antenna).sum()),
        "channels": int(np.isfinite(found.of_channel).sum()),
        "difference": found.together,
        "difference as given": found.as_given,
        "median over antennas": float(np.nanmedian(found.of_antenna)),
        "worst antenna": str(found.pair.antennas[worst]),
        "difference of the worst antenna": float(found.of_antenna[worst]),
        "worst channel [MHz]": float(found.pair.frequency[np.nanargmax(found.of_channel)] / 1e6),
        "difference of the worst channel": float(np.nanmax(found.of_channel)),
        "worst delay [ns]": float(1e9 * found.delay[np.argmax(found.of_delay)]),
        "difference at the worst delay": float(found.of_delay.max()),
        **_in_units_of_errors(found),
    }


def _draw(found: GainDifference) -> Figure:
    """Draw the relative difference by antenna, by channel and by delay, on logarithmic axes."""
    import numpy as np

    from calstudy.plotting import style

    figure = style.new_figure(style.TWO_COLUMNS, 2.4)
    by_antenna, by_channel, by_delay = figure.subplots(1, 3)
    place = np.arange(found.of_antenna.size)
    by_antenna.plot(place, found.of_antenna, "o", color=style.BLUE)
    if place.size <= MOST_NAMES:
        by_antenna.set_xticks(place, found.pair.antennas, rotation=90, fontsize=style.NOTE_SIZE)
    by_antenna.set_ylabel("rms difference / rms")
    by_channel.plot(found.pair.frequency / 1e6, found.of_channel, color=style.BLUE)
    by_delay.plot(1e9 * found.delay, found.of_delay, color=style.BLUE)
    for axes, label in ((by_antenna, "antenna"), (by_channel, style.FREQUENCY), (by_delay, style.DELAY)):
        axes.set_xlabel(label)
        if np.nanmax(axes.lines[0].get_ydata()) > 0:
            axes.set_yscale("log")
    by_channel.set_title(f"feed {found.pair.polarization}; together {found.together:.3g}")
    return figure
