"""``calstudy which``: which calibration to trust on an array, by the experiment `which.yaml` with that array in it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from calstudy.cli.options import MaxMemory, Runs, Scale, Set, Workers, named_as_options, with_runs

BEAMS = {"hera": "hera", "mwa": "mwa-embedded-element"}
"""Beams of the antennas of sites."""
FIELDS = (
    (r"^instrument\.layout(\.path)?(?=[ :.])", "LAYOUT"),
    (r"^instrument\.location(\.\w+)?(?= =|:)", "--site"),
    (r"^instrument\.beam \(empty\): must be", "--beam: is needed, because none is known for this array and site:"),
    (r"^instrument\.beam(\.path)?(?= =|:)", "--beam"),
    (r"^((LAYOUT|--site|--beam).*) \(in '[^']*'( and \d+ other cases?)?\)$", r"\1"),
)
"""Fields in messages, and the options that set them; cases are not named, for all have the same array."""

Layout = Annotated[
    str,
    typer.Argument(
        metavar="LAYOUT",
        help="Table of east_m, north_m, up_m, or of latitude, longitude, height_m (CSV); or a layout, such as hera-37.",
        show_default=False,
    ),
]
Site = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|LAT,LON", help="Where the array is: hera, mwa, ..., or degrees; by default the layout's own site."
    ),
]
Beam = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|FILE", help="hera, airy, ..., a .beamfits file or a file.py; by default that of HERA or the MWA."
    ),
]
Plan = Annotated[bool, typer.Option("--dry-run", help="Show what would be done, and stop.")]


def which(
    layout: Layout,
    site: Site = None,
    beam: Beam = None,
    scale: Scale = None,
    overrides: Set = None,
    output: Runs = None,
    workers: Workers = None,
    max_memory: MaxMemory = None,
    dry_run: Plan = False,
) -> None:
    """Simulate an array with the standard calibrators in the standard worlds, and say which calibration to trust.

    This is the published experiment which, with another array. calstudy init --example which writes a copy, in which
    calibrators and worlds can be changed.
    """
    from calstudy.base.package_files import published
    from calstudy.experiment.files import StudyFile
    from calstudy.run.execution import Budget
    from calstudy.studies.load import study_of
    from calstudy.studies.show import describe_plan, show_plan, show_run
    from calstudy.studies.study import run_study

    changes = [*array_changes(layout, site, beam), *with_runs(overrides, output)]
    console, budget = Console(soft_wrap=True, highlight=False), Budget(workers, max_memory)
    with named_as_options(*FIELDS):
        # The file is not the user's, and names no others: paths are those of options.
        file = StudyFile.open(published("experiments") / "which.yaml", scale, changes)
        study = study_of(replace(file, base=Path.cwd()))
    if dry_run:
        show_plan(describe_plan(study, budget), console)
        return
    show_run(run_study(study, budget, console), console)


def array_changes(layout: str, site: str | None, beam: str | None) -> list[str]:
    """Return the changes of the experiment, as of --set; the beam is empty if none is known."""
    from calstudy.instrument.settings import LAYOUTS

    changes = {"instrument.layout": _block(layout, "csv", (".csv", ".txt", ".tsv", ".dat"))}
    if site is not None:
        place = re.fullmatch(r"\s*([-+\d.]+)\s*,\s*([-+\d.]+)\s*", site)
        degrees = place and f"{{latitude: {place[1]} deg, longitude: {place[2]} deg}}"
        changes["instrument.location"] = degrees or site
    if beam is None:
        # The site of a block, or of a user's file, is not known here.
        known = layout in LAYOUTS.names()
        own = LAYOUTS.find(layout).site if known else None
        # A name of no layout is a fault by itself.
        other = "null" if known or not re.fullmatch(r"[\w-]+", layout) else "hera"
        beam = BEAMS.get(site or "") or BEAMS.get(own or "") or other
    changes["instrument.beam"] = _block(beam, "beamfits", (".beamfits", ".fits"))
    return [f"{path}={value}" for path, value in changes.items()]


def _block(text: str, kind: str, suffixes: tuple[str, ...]) -> str:
    """Return the name of a file as a block of a kind or, if it is Python code, by its absolute path."""
    if text.lower().endswith(suffixes):
        return json.dumps({"kind": kind, "path": str(Path(text).resolve())})
    is_code = text.endswith(".py") or ".py:" in text
    return json.dumps(str(Path(text).resolve())) if is_code else text
