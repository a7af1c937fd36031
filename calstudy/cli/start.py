"""``calstudy init``, from `starter.yaml` or `observed.yaml`, and the JSON schema."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from calstudy.base.errors import InputError, errors_of_files
from calstudy.base.files import write_text
from calstudy.cli.options import named_as_options

if TYPE_CHECKING:
    from calstudy.realdata.halves import Facts

MODELINE = "# yaml-language-server: $schema="
"""Start of the line from which editors know the schema of a file."""
PLAIN_PATH = re.compile(r"[A-Za-z./][\w./-]*\.[A-Za-z]\w*")
"""Paths that YAML reads as they are, without quotes."""
SCALE = "flux_scale: {kind: system-temperature, receiver: 100 K}   # or {kind: factor, unit: 1 Jy}"
LARGE = 5e6
"""Most samples that are searched for interference, which takes about a minute."""

Name = Annotated[str, typer.Argument(help="Of the experiment; the file is NAME.yaml.")]
Example = Annotated[str | None, typer.Option(metavar="NAME", help="Copy a published experiment instead; see --list.")]
Data = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="Measured visibilities, or PACKAGE:PATH: write a file about these instead."),
]
List = Annotated[
    bool, typer.Option("--list", help="List the published experiments, which other commands take by name.")
]
Beam = Annotated[
    str | None, typer.Option(help="The beam of measured data: hera (the default), airy, gaussian, ..., or a file.py.")
]


def init(
    name: Name = "my-study", example: Example = None, data: Data = None, beam: Beam = None, listed: List = False
) -> None:
    """Write a commented experiment file, NAME.yaml, into this folder; nothing is overwritten.

    With --data it is one of measured data: calibration, power spectra, and signal loss by injection.
    """
    from calstudy.base.package_files import published
    from calstudy.experiment.model import STUDY_NAME
    from calstudy.studies.reference import SCHEMA_FILE

    if listed:
        _list_examples()
        return
    name = name.removesuffix(".yaml")
    path = Path(f"{name}.yaml")
    if example is not None and data is not None:
        raise InputError("--example and --data: choose one")
    _require_usable(beam, data)
    if not STUDY_NAME.fullmatch(name):
        raise InputError(f"{name!r} cannot name an experiment: use at most 64 letters, digits, '_', '.', '-'")
    if data is not None:
        guess = "" if beam else "                                              # a guess: files of data do not say it"
        text = _filled("observed", name=name, beam=beam or "hera", beam_reason=guess, **_described(data))
    else:
        text = _filled("starter", name=name) if example is None else _copy(example, name)
    if path.exists():
        raise InputError(f"{path}: exists already, and is not overwritten; choose another name or remove it")
    schema = published("experiments") / SCHEMA_FILE
    if schema.is_relative_to(Path.cwd()):
        schema = schema.relative_to(Path.cwd())
    with errors_of_files(f"{path}: cannot be written"):
        write_text(path, f"{MODELINE}{schema}\n{text}")
    if data is not None and beam is None:
        typer.echo(
            f"{path}: observed.beam = hera is a guess, which sets the level of power spectra; --beam names another"
        )
    typer.echo(f"{path}: next, `calstudy plan {path}`")


def _require_usable(beam: str | None, data: str | None) -> None:
    """Raise InputError for a beam of no measured data, and for the name of no beam."""
    from calstudy.base.plugins import FILE_REFERENCE
    from calstudy.instrument.settings import BEAMS

    if beam is not None and data is None:
        raise InputError(f"--beam {beam}: is the beam of measured data, which --data names; else set instrument.beam")
    if beam is not None and not beam.startswith("{") and not FILE_REFERENCE.fullmatch(beam):
        with named_as_options(("^", "--beam: ")):
            BEAMS.find(beam)


def _list_examples() -> None:
    from calstudy.base.package_files import experiment_names, published
    from calstudy.base.table import Table
    from calstudy.experiment.files import read_mapping
    from calstudy.studies.study import kind_of

    rows, folder = [], published("experiments")
    for name in experiment_names():
        content = read_mapping(folder / f"{name}.yaml")
        kind = kind_of(content, folder).__module__.rpartition(".")[2]
        rows.append((name, kind, " ".join(str(content.get("description", "")).split())))
    Table(("name", "kind", "description"), rows, "published experiments").show(Console(highlight=False), numbers=False)


def _described(data: str) -> dict[str, str]:
    """Return entries of a file on measured data, after a look at them."""
    from calstudy.instrument.layouts import redundant_groups
    from calstudy.power.settings import PowerSettings
    from calstudy.realdata.halves import read_facts
    from calstudy.realdata.interference import has_surroundings
    from calstudy.realdata.selection import Selection
    from calstudy.realdata.settings import find_data

    with named_as_options(("^", "--data: ")):
        paths = (find_data(data, Path()),)
        facts = read_facts(paths, Selection(), even=False)
    if facts.times.size < 2:
        raise InputError(
            f"--data: {data} has 1 integration, and a study needs two, for even and odd: join it with others of the "
            "same night; or write a file with other data of the same sky as observed.odd, or the differences of a "
            "correlator as observed.difference; or calibrate it alone with `calstudy calibrate`"
        )
    frame, whole = facts.frame, _band(facts.frequencies[0], facts.frequencies[-1])
    vectors = frame.vectors[~frame.autos]
    groups = redundant_groups(vectors, PowerSettings().redundancy_tolerance).index.tolist()
    redundant = sum(count for count in Counter(groups).values() if count > 1)
    return {
        "path": data if PLAIN_PATH.fullmatch(data) else json.dumps(data, ensure_ascii=False),
        "summary": f"{facts.antennas} antennas with baselines of up to {frame.lengths.max():.0f} m, "
        f"{redundant} of {len(vectors)} with a redundant partner, "
        f"{facts.frequencies.size} channels of {whole}, {facts.times.size} integrations, in {facts.unit!r}.",
        "scale": "# " + SCALE if facts.unit.lower() == "jy" else SCALE,
        "autos": "" if facts.autos else "# ",
        "search": "" if has_surroundings(facts.times.size, facts.frequencies.size) else "# ",
        **_proposed(facts, whole, paths),
    }


def _proposed(facts: Facts, whole: str, paths: tuple[Path, ...]) -> dict[str, str]:
    """Return a band and antennas, after a look at the data unless they are large, with the reasons for them."""
    from calstudy.products.files import quiet_libraries
    from calstudy.realdata.interference import quiet_band
    from calstudy.realdata.noise import uncorrelated
    from calstudy.realdata.reading import prepare, read_visibilities
    from calstudy.realdata.selection import antenna_text

    proposed = {"band": whole, "antennas": "# antennas: 0,1,12"}
    if facts.size(facts.times.size).samples > LARGE:
        return {**proposed, "band_reason": "All channels; data so large were not searched for interference"}
    with named_as_options(("^", "--data: ")), quiet_libraries():
        data, _ = prepare(read_visibilities(paths))
    if lost := uncorrelated(data):
        kept = [antenna_text(data, number) for number in facts.frame.numbers.tolist() if number not in lost]
        proposed["antennas"] = (
            f"# All but {', '.join(map(str, lost))}, of whose cross-correlations at most one is above the noise; "
            f"without this line: all.\n    antennas: {','.join(kept)}"
        )
    found = quiet_band(data)
    if found is None:
        return {**proposed, "band_reason": "All channels: leave out edges and interference"}
    reason = f"The longest stretch of channels that are not flagged and do not stand out from others; all: {whole}"
    return {**proposed, "band": _band(*found), "band_reason": reason}


def _band(first: float, last: float) -> str:
    return f"{math.floor(first / 1e3) / 1e3:.3f} MHz..{math.ceil(last / 1e3) / 1e3:.3f} MHz"


def write_schema(path: Path) -> None:
    """Write the JSON schema of experiment files; raises InputError if it cannot be, or would replace another file."""
    from calstudy.studies.reference import SCHEMA_TITLE, experiment_schema

    with errors_of_files(f"--schema {path}: cannot be written"):
        if path.exists() and SCHEMA_TITLE not in path.read_text(encoding="utf-8", errors="replace"):
            raise InputError(f"--schema {path}: is another file, and is not overwritten; choose another name")
        write_text(path, experiment_schema())
    typer.echo(f"{path}")


def _copy(example: str, name: str) -> str:
    """Return the text of a published experiment under another name."""
    from calstudy.base.package_files import find_experiment
    from calstudy.experiment.files import read_mapping

    path = find_experiment(Path(example))
    content = read_mapping(path)
    if "experiments" in content or isinstance(content.get("experiment"), str):
        raise InputError(f"--example {example}: is made of other files; copy one of those")
    lines = path.read_text(encoding="utf-8").splitlines()
    kept = "\n".join(line for line in lines if not line.startswith(MODELINE))
    return re.sub(r"^name: .*$", f"name: {name}", kept, count=1, flags=re.MULTILINE) + "\n"


def _filled(template: str, **entries: str) -> str:
    """Return the text of a file beside this module, with entries in place of their names."""
    text = Path(__file__).with_name(f"{template}.yaml").read_text(encoding="utf-8")
    return Template(text).substitute(entries)
