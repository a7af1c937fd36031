"""``calstudy check``: how good the ingredients of an experiment's simulation are, in figures and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calstudy.experiment.model import Experiment

check_app = typer.Typer(
    help="Check the ingredients of an experiment's simulation; writes a figure and its arrays.", no_args_is_help=True
)

File = Annotated[Path, typer.Argument(help="The experiment file (YAML).", show_default=False)]
Scale = Annotated[str | None, typer.Option(help="Apply a named set of overrides of the file, such as 'small'.")]
Set = Annotated[list[str] | None, typer.Option("--set", metavar="PATH=VALUE", help="Override a field.")]
Folder = Annotated[Path, typer.Option("--output", help="Folder for the figure.")]


def _load(file: Path, scale: str | None, overrides: Sequence[str] | None) -> Experiment:
    from calstudy.experiment.files import load

    return load(file, scale, overrides or ())


def _notes(experiment: Experiment, *subjects: str) -> list[str]:
    """Return the stand-ins that concern these subjects, such as the beam."""
    from calstudy.standins import footnotes

    return [note for note in footnotes(experiment) if note.startswith(subjects)]


def _save(figure: Figure, shown: Any, folder: Path, name: str) -> None:
    from calstudy.figures.save import figure_arrays, save_figure

    for path in save_figure(figure, figure_arrays(shown), folder, name):
        typer.echo(f"{path}")


@check_app.command()
def sky(file: File, scale: Scale = None, overrides: Set = None, folder: Folder = Path("checks")) -> None:
    """Compare the differential source counts of the foreground sky with Franzen et al. (2019)."""
    import numpy as np

    from calstudy.bench.tables import show
    from calstudy.checks.counts import count_sources
    from calstudy.figures.counts import draw_counts
    from calstudy.instrument.telescope import make_template
    from calstudy.sky.foregrounds import make_foregrounds

    experiment = _load(file, scale, overrides)
    foregrounds = make_foregrounds(experiment.sky.foregrounds, make_template(experiment.instrument).freq_array)
    counts = count_sources(foregrounds.sky)
    rows = [
        (f"{low:.3f} to {high:.3f}", f"{number}", f"{ratio:.3f}", f"{error:.3f}")
        for low, high, number, ratio, error in zip(
            counts.edges[:-1], counts.edges[1:], counts.number, counts.ratio, counts.error, strict=True
        )
    ]
    show("differential counts at 200 MHz", ("Jy", "sources", "over expected", "Poisson"), rows, Console())
    typer.echo(f"largest deviation: {100 * np.abs(counts.ratio - 1).max():.1f} %")
    _save(draw_counts(counts, _notes(experiment, "sky", "reduced")), counts, folder, "counts")


@check_app.command()
def beam(file: File, scale: Scale = None, overrides: Set = None, folder: Folder = Path("checks")) -> None:
    """Compare the beam's smooth fit in frequency with its table, and the other interpolations with the fit."""
    from calstudy.checks.beam import compare_interpolations
    from calstudy.figures.beam_fit import draw_beam_fit

    experiment = _load(file, scale, overrides)
    fit = compare_interpolations(experiment.instrument)
    typer.echo(f"fit - table: rms {(fit.fit_rms**2).mean() ** 0.5:.1e}, largest {fit.fit_max.max():.1e} of the zenith")
    for name, rms in fit.others.items():
        typer.echo(f"{name} - fit: rms {(rms**2).mean() ** 0.5:.1e}")
    _save(draw_beam_fit(fit, _notes(experiment, "beam")), fit, folder, "beam_fit")


@check_app.command()
def floor(file: File, scale: Scale = None, overrides: Set = None, folder: Folder = Path("checks")) -> None:
    """Measure the foregrounds' delay floor for every interpolation of the beam, at one integration."""
    from calstudy.bench.tables import show
    from calstudy.checks.floor import compare_floors
    from calstudy.figures.delay_floor import draw_delay_floors

    experiment = _load(file, scale, overrides)
    console = Console(highlight=False)
    with console.status("") as status:
        floors = compare_floors(experiment, lambda name: status.update(f"simulating with interpolation: {name}"))
    tapers = ("dolph-chebyshev", "blackman-harris")
    rows = [
        (name, *(f"{value:.1f}" for taper in tapers for value in _worst(measured, taper)))
        for name, measured in floors.items()
    ]
    headings = ("interpolation", "Dolph-Chebyshev: rms", "peak", "Blackman-Harris: rms", "peak")
    show("highest floor of any baseline length, dB of brightness", headings, rows, console)
    figure = draw_delay_floors(floors, experiment.corruption.eor_level, _notes(experiment, "sky", "beam", "reduced"))
    _save(figure, floors, folder, "delay_floor")


def _worst(measured: Any, taper: str) -> tuple[float, float]:
    import numpy as np

    found = measured.floors[taper]
    return float(np.nanmax(found.rms_db)), found.worst_db
