"""``calstudy check``: how good the ingredients of an experiment's simulation are, in figures and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from calstudy.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calstudy.checks.engine import EngineAgreement
    from calstudy.experiment.model import Experiment

WAVENUMBERS = (0.1, 0.2, 0.5, 1.0, 2.0)
"""Where the ranges of k begin for which `simulation` prints a ratio, h/Mpc."""

check_app = typer.Typer(
    help="Check the ingredients of an experiment's simulation; writes a figure and its arrays.", no_args_is_help=True
)

File = Annotated[Path, typer.Argument(help="The experiment file (YAML).", show_default=False)]
Scale = Annotated[str | None, typer.Option(help="Apply a named set of overrides of the file, such as 'small'.")]
Set = Annotated[list[str] | None, typer.Option("--set", metavar="PATH=VALUE", help="Override a field.")]
Folder = Annotated[Path, typer.Option("--output", help="Folder for the figure.")]
Reference = Annotated[
    str, typer.Option(metavar="ENGINE", help="Engine to compare with: dense, matvis, fftvis, pyuvsim.")
]
ReferenceSet = Annotated[
    list[str] | None,
    typer.Option(
        "--reference-set",
        metavar="PATH=VALUE",
        help="Override a field of the reference alone: --reference-set simulation.nodes.tolerance=1e-6",
    ),
]
Tolerance = Annotated[
    float | None, typer.Option(help="Exit with status 1 if any visibility differs by more than this times the rms.")
]
Workers = Annotated[int | None, typer.Option(min=1, help="Worker processes; by default one per core that has memory.")]
MaxMemory = Annotated[str | None, typer.Option(metavar="SIZE", help="Memory for all workers together: '6 GB'.")]


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


@check_app.command()
def engine(
    file: File,
    reference: Reference = "pyuvsim",
    reference_set: ReferenceSet = None,
    tolerance: Tolerance = None,
    scale: Scale = None,
    overrides: Set = None,
    workers: Workers = None,
    max_memory: MaxMemory = None,
    folder: Folder = Path("checks"),
) -> None:
    """Compare the foregrounds with the same foregrounds made in full by another engine.

    Both are products in the store: what a run has made is not made again, and an interrupted check is resumed.
    """
    from calstudy.checks.engine import compare_engines
    from calstudy.figures.engine_agreement import draw_engine_agreement
    from calstudy.running.components import FILE, make_component
    from calstudy.stages.files import read_visibilities, write_json

    experiment = _load(file, scale, overrides)
    other = _load(file, scale, [*(overrides or ()), f"simulation.engine={reference}", *(reference_set or ())])
    console = Console(soft_wrap=True, highlight=False)
    products = [
        make_component(each, "foregrounds", folder / "check.log", console, workers, max_memory)
        for each in (experiment, other)
    ]
    if products[0].record["key"] == products[1].record["key"]:
        raise InputError(f"--reference {reference}: the experiment's own engine; there is nothing to compare")
    agreement = compare_engines(*(read_visibilities(product.path / FILE) for product in products))
    allowed = sum(each.simulation.nodes.tolerance for each in (experiment, other) if each.simulation.nodes.enabled)
    names = (experiment.simulation.engine, other.simulation.engine)
    _show_agreement(agreement, allowed, console)
    notes = _notes(experiment, "sky", "beam", "reduced")
    figure = draw_engine_agreement(agreement, names, allowed, experiment.corruption.eor_level, notes)
    _save(figure, agreement, folder, "engine")
    described = [
        {"engine": name, "key": product.record["key"], **product.record["notes"]}
        for name, product in zip(names, products, strict=True)
    ]
    numbers = {"simulations": described, "node_tolerances": allowed, **agreement.as_json()}
    write_json(folder / "engine.json", numbers)
    typer.echo(f"{folder / 'engine.json'}")
    if tolerance is not None and agreement.largest > tolerance:
        typer.echo(f"the largest difference, {agreement.largest:.1e} of the rms, is above {tolerance:g}", err=True)
        raise typer.Exit(1)


@check_app.command()
def simulation(
    file: File,
    scale: Scale = None,
    overrides: Set = None,
    workers: Workers = None,
    max_memory: MaxMemory = None,
    folder: Folder = Path("checks"),
) -> None:
    """Look at the simulated components alone: wedge of F, P(k) of S against its input, delay spectra of baselines.

    Both are products in the store: what a run has made is not made again.
    """
    from calstudy.bench.tables import show
    from calstudy.checks.simulation import look_at_simulation
    from calstudy.figures.simulation import draw_simulation
    from calstudy.running.components import FILE, make_component
    from calstudy.stages.files import quiet_libraries, read_visibilities

    experiment = _load(file, scale, overrides)
    console = Console(soft_wrap=True, highlight=False)
    products = [
        make_component(experiment, component, folder / "check.log", console, workers, max_memory)
        for component in ("foregrounds", "eor")
    ]
    with quiet_libraries():
        look = look_at_simulation(*(read_visibilities(product.path / FILE) for product in products), experiment)
    last = float(look.eor.bin_edges[-1])
    edges = (0.0, *(edge for edge in WAVENUMBERS if edge < last), last)
    ranges = [(low, high, *look.ratio(low, high)) for low, high in pairwise(edges)]
    rows = [(f"{low:g} to {high:g}", f"{ratio:.3f}", f"{error:.3f}") for low, high, ratio, error in ranges]
    show("P(k) of S over its input", ("k, h/Mpc", "ratio", "standard deviation"), rows, console)
    _save(draw_simulation(look, _notes(experiment, "sky", "beam", "reduced")), look, folder, "simulation")


def _show_agreement(agreement: EngineAgreement, allowed: float, console: Console) -> None:
    from calstudy.bench.tables import show

    rows = [
        (
            f"{group.shortest:.0f} to {group.longest:.0f}",
            f"{group.baselines}",
            f"{group.rms_jy:.2f}",
            f"{group.largest:.1e}",
            f"{group.rms:.1e}",
        )
        for group in agreement.groups
    ]
    show(
        "difference per baseline length",
        ("m", "baselines", "rms of F, Jy", "largest / rms", "rms / rms"),
        rows,
        console,
    )
    for taper, found in agreement.floors.items():
        beyond = agreement.differences[taper]
        console.print(f"beyond the horizon, {taper}: F {found.worst_db:.1f} dB, difference {beyond.worst_db:.1f} dB")
    console.print(
        f"all visibilities: largest {agreement.largest:.1e}, rms {agreement.rms:.1e} of the rms; worst integration and "
        f"channel {agreement.worst_slot:.1e}; the nodes' tolerances sum to {allowed:.1e}"
    )
