"""``calstudy check``: quality of the ingredients of an experiment's simulation, in figures and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from calstudy.base.errors import InputError
from calstudy.base.table import Table
from calstudy.verdicts.criterion import AtMost, Criterion, Finding
from calstudy.verdicts.tables import show_verdicts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calstudy.experiment.model import Experiment
    from calstudy.validation.engine_agreement import EngineAgreement

WAVENUMBERS = (0.1, 0.2, 0.5, 1.0, 2.0)
"""Lower limits of the ranges of k, h/Mpc, for which `simulation` prints a ratio."""

check_app = typer.Typer(
    help="Check the ingredients of an experiment's simulation; writes a figure and its arrays.", no_args_is_help=True
)

File = Annotated[
    Path, typer.Argument(help="The experiment file (YAML), or the name of a published one.", show_default=False)
]
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
    from calstudy.base.package_files import find_experiment
    from calstudy.experiment.files import load

    return load(find_experiment(file), scale, overrides or ())


def _notes(experiment: Experiment, *subjects: str) -> list[str]:
    """Return the stand-ins that concern these subjects, such as the beam."""
    from calstudy.claims.paper import stand_ins

    return [note for note in stand_ins(experiment) if note.startswith(subjects)]


def _save(figure: Figure, shown: Any, folder: Path, name: str) -> None:
    from calstudy.plotting.save import figure_arrays, save_figure

    for path in save_figure(figure, figure_arrays(shown), folder, name):
        typer.echo(f"{path}")


@check_app.command()
def sky(file: File, scale: Scale = None, overrides: Set = None, folder: Folder = Path("checks")) -> None:
    """Compare the differential source counts of the foreground sky with Franzen et al. (2019)."""
    import numpy as np

    from calstudy.instrument.telescope import make_template
    from calstudy.sky.foregrounds import make_foregrounds
    from calstudy.validation.source_counts import count_sources, draw_counts

    experiment = _load(file, scale, overrides)
    foregrounds = make_foregrounds(experiment.sky.foregrounds, make_template(experiment.instrument).freq_array)
    counts = count_sources(foregrounds.sky)
    rows = [
        (f"{low:.3f} to {high:.3f}", f"{number}", f"{ratio:.3f}", f"{error:.3f}")
        for low, high, number, ratio, error in zip(
            counts.edges[:-1], counts.edges[1:], counts.number, counts.ratio, counts.error, strict=True
        )
    ]
    headings = ("Jy", "sources", "over expected", "Poisson")
    Table(headings, rows, "differential counts at 200 MHz").show(Console())
    typer.echo(f"largest deviation: {100 * np.abs(counts.ratio - 1).max():.1f} %")
    _save(draw_counts(counts, _notes(experiment, "sky", "reduced")), counts, folder, "counts")


@check_app.command()
def beam(file: File, scale: Scale = None, overrides: Set = None, folder: Folder = Path("checks")) -> None:
    """Compare the beam's smooth fit in frequency with its table, and the other interpolations with the fit."""
    from calstudy.validation.beam_interpolation import compare_interpolations, draw_interpolations

    experiment = _load(file, scale, overrides)
    fit = compare_interpolations(experiment.instrument)
    typer.echo(f"fit - table: rms {(fit.fit_rms**2).mean() ** 0.5:.1e}, largest {fit.fit_max.max():.1e} of the zenith")
    for name, rms in fit.others.items():
        typer.echo(f"{name} - fit: rms {(rms**2).mean() ** 0.5:.1e}")
    _save(draw_interpolations(fit, _notes(experiment, "beam")), fit, folder, "beam_fit")


@check_app.command()
def floor(file: File, scale: Scale = None, overrides: Set = None, folder: Folder = Path("checks")) -> None:
    """Measure the foregrounds' delay floor for every interpolation of the beam, at one integration."""
    from calstudy.validation.delay_floor import compare_floors, draw_delay_floors

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
    Table(headings, rows, "highest floor of any baseline length, dB of brightness").show(console)
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
    """Compare the foregrounds with the same foregrounds simulated completely by another engine.

    Both are products in the store: what a run has made is not made again, and an interrupted check is resumed.
    """
    from calstudy.products.files import VISIBILITIES, read_visibilities, write_json
    from calstudy.simulate.arguments import missing_package
    from calstudy.simulate.settings import ENGINES
    from calstudy.studies.components import make_component
    from calstudy.studies.study import Budget
    from calstudy.validation.engine_agreement import compare_simulations, draw_engine_agreement

    experiment = _load(file, scale, overrides)
    try:
        ENGINES.find(reference)
    except InputError as error:
        raise InputError(f"--reference {error}") from None
    if (missing := missing_package(reference)) is not None:
        raise InputError(f"--reference {reference}: {missing}")
    other = _load(file, scale, [*(overrides or ()), f"simulation.engine={reference}", *(reference_set or ())])
    console = Console(soft_wrap=True, highlight=False)
    products = [
        make_component(each, "foregrounds", folder / "check.log", console, Budget(workers, max_memory))
        for each in (experiment, other)
    ]
    if products[0].record["key"] == products[1].record["key"]:
        raise InputError(f"--reference {reference}: the experiment's own engine; there is nothing to compare")
    agreement = compare_simulations(*(read_visibilities(product.path / VISIBILITIES) for product in products))
    allowed = sum(each.simulation.nodes.tolerance for each in (experiment, other) if each.simulation.nodes.enabled)
    names = (experiment.simulation.engine.label, other.simulation.engine.label)
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
    if tolerance is not None and not _within(agreement, tolerance, names, console):
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
    """Measure the simulated components alone: wedge of F, P(k) of S against its input, delay spectra of baselines.

    Both are products in the store: what a run has made is not made again.
    """
    from calstudy.products.files import VISIBILITIES, quiet_libraries, read_visibilities
    from calstudy.studies.components import make_component
    from calstudy.studies.study import Budget
    from calstudy.validation.simulated_components import draw_components, measure_components

    experiment = _load(file, scale, overrides)
    console = Console(soft_wrap=True, highlight=False)
    products = [
        make_component(experiment, component, folder / "check.log", console, Budget(workers, max_memory))
        for component in ("foregrounds", "eor")
    ]
    with quiet_libraries():
        foregrounds, eor = (read_visibilities(product.path / VISIBILITIES) for product in products)
        found = measure_components(foregrounds, eor, experiment)
    last = float(found.eor.bin_edges[-1])
    edges = (0.0, *(edge for edge in WAVENUMBERS if edge < last), last)
    ranges = [(low, high, *found.ratio(low, high)) for low, high in pairwise(edges)]
    rows = [(f"{low:g} to {high:g}", f"{ratio:.3f}", f"{error:.3f}") for low, high, ratio, error in ranges]
    Table(("k, h/Mpc", "ratio", "standard deviation"), rows, "P(k) of S over its input").show(console)
    _save(draw_components(found, _notes(experiment, "sky", "beam", "reduced")), found, folder, "simulation")


def _within(agreement: EngineAgreement, tolerance: float, names: tuple[str, str], console: Console) -> bool:
    """Print the verdict on the largest difference, and return true if it is within the tolerance."""
    criterion = Criterion(
        name="largest difference",
        section="",
        sentence=f"{names[0]} agrees with {names[1]}",
        quantity="largest difference of any visibility, over the rms",
        threshold=AtMost(tolerance),
        why="--tolerance",
    )
    verdict = criterion.judge(Finding(agreement.largest, 0.0))
    show_verdicts([verdict], "engines", console, "check")
    return verdict.verdict == "PASS"


def _show_agreement(agreement: EngineAgreement, allowed: float, console: Console) -> None:

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
    headings = ("m", "baselines", "rms of F, Jy", "largest / rms", "rms / rms")
    Table(headings, rows, "difference per baseline length").show(console)
    for taper, found in agreement.floors.items():
        beyond = agreement.differences[taper]
        console.print(f"beyond the horizon, {taper}: F {found.worst_db:.1f} dB, difference {beyond.worst_db:.1f} dB")
    console.print(
        f"all visibilities: largest {agreement.largest:.1e}, rms {agreement.rms:.1e} of the rms; worst integration and "
        f"channel {agreement.worst_slot:.1e}; the nodes' tolerances sum to {allowed:.1e}"
    )
