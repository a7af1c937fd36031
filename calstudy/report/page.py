"""Reports as self-contained HTML pages: of one run, and of several.

The page of several runs has the fields that differ, their spectra and T in one chart each, and all else side by side.
"""

from __future__ import annotations

import base64
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calstudy.base.errors import InputError, errors_of_files
from calstudy.base.files import replacing, rounded
from calstudy.base.paths import leaves
from calstudy.base.table import Table
from calstudy.report.headline import Number, read_headline, read_signal
from calstudy.results.reader import EXPERIMENT, MANIFEST, RunFolder, Unevaluated, arrays_of_figure
from calstudy.run.progress import duration
from calstudy.verdicts.standing import advice, standing_table
from calstudy.verdicts.tables import CLAIMS_JSON, tally, verdict_table

# Series in the order of the legend: field, label, and name of the colour in page.css.
SERIES = {
    "eor": ("EoR, P^S", "grey"),
    "uncorrupted": ("perfect gains, P^(S+F+N)", "black"),
    "uncalibrated": ("uncalibrated, P^V", "red"),
    "residual": ("residual, P^R", "orange"),
    "residual_without_eor": ("residual without EoR", "cyan"),
    "noise": ("noise, P^N", "magenta"),
    "outside": ("outside the wedge", "orange"),
    "inside": ("inside the wedge", "cyan"),
}
POWER = "P [mK² h⁻³ Mpc³]"
NUMBER = re.compile(r"\d[\d.,]*(e[-+]?\d+)?")


@dataclass(frozen=True)
class Chart:
    """Curves over k, or maps over k_perp and k_parallel.

    `data` is the input of the page's script: `kind`, labels and series, ready for JSON.
    """

    title: str
    data: Mapping[str, Any]


def read_charts(path: Path) -> list[Chart]:
    """Return the charts of the arrays of a figure (``NAME.npz`` from `calstudy.plotting.style`); none for other arrays.

    An entry ``GROUP.FIELD`` is a field of a spectrum: `power` over `k`, a transfer function over `k`, or either over
    `k_perp` and `k_parallel`. Items of lists, which have numbers for names, are left out.
    """
    groups: dict[str, dict[str, np.ndarray]] = {}
    for name, values in arrays_of_figure(path).items():
        group, _, field = name.rpartition(".")
        groups.setdefault(group, {})[field] = values
    return [chart for chart in (*_spectra(groups), _transfer(groups), _maps(groups)) if chart is not None]


def _is_named(series: str) -> bool:
    """Return whether a series is no item of a list, nor a part of one."""
    return not any(part.isdigit() for part in series.split("."))


def _spectra(groups: Mapping[str, Mapping[str, np.ndarray]]) -> list[Chart]:
    """Return a chart for each column of spherical power spectra."""
    columns: dict[str, dict[str, Any]] = {}
    for name, fields in groups.items():
        column, _, series = name.rpartition(".")
        if _is_named(series) and {"k", "power", "noise_error", "sample_error"} <= fields.keys():
            error = fields["noise_error"] + fields["sample_error"]
            columns.setdefault(column, {})[series] = (fields["k"], fields["power"].real, error)
    titles = {column: str(groups.get(column, {}).get("title", np.array(""))) for column in columns}
    counts, charts = Counter(titles.values()), []
    for column, found in columns.items():
        parts = [titles[column], column.replace("_", " ") if counts[titles[column]] > 1 else ""]
        charts.append(_curves(", ".join(["Power spectra", *filter(None, parts)]), POWER, True, found))
    return charts


def _transfer(groups: Mapping[str, Mapping[str, np.ndarray]]) -> Chart | None:
    """Return the chart of transfer functions, free of the flux scale."""
    found = {
        name: (fields["k"], fields["scale_free_transfer"], fields["scale_free_transfer_error"])
        for name, fields in groups.items()
        if _is_named(name) and {"k", "scale_free_transfer", "scale_free_transfer_error"} <= fields.keys()
    }
    return _curves("T, free of the flux scale", "T", False, found) if found else None


def _curves(title: str, label: str, logarithmic: bool, found: Mapping[str, tuple[np.ndarray, ...]]) -> Chart:
    ordered = [name for name in dict.fromkeys((*SERIES, *found)) if name in found]
    series = [curve(*SERIES.get(name, (name.replace("_", " "), "grey")), found[name]) for name in ordered]
    return chart_of_curves(title, label, logarithmic, series)


def curve(label: str, colour: str, points: tuple[np.ndarray, ...]) -> dict[str, Any]:
    """Return a series of a chart: k in h/Mpc, values and errors where values are finite."""
    kept = np.isfinite(points[1])
    drawn = {key: rounded(array[kept]) for key, array in zip(("x", "y", "error"), points, strict=True)}
    return {"label": label, "colour": colour, **drawn}


def chart_of_curves(title: str, label: str, logarithmic: bool, series: Sequence[Mapping[str, Any]]) -> Chart:
    """Return a chart over k; `label` is that of the vertical axis."""
    data = {"kind": "curves", "x": "k [h/Mpc]", "y": label, "logarithmic": logarithmic, "series": list(series)}
    return Chart(title, data)


def _maps(groups: Mapping[str, Mapping[str, np.ndarray]]) -> Chart | None:
    """Return the chart of cylindrical spectra, or of a cylindrical transfer function."""
    series: list[dict[str, Any]] = []
    logarithmic, label = True, POWER
    for name in [*SERIES, *(name for name in groups if name not in SERIES and _is_named(name))]:
        fields = groups.get(name, {})
        quantity = "power" if "power" in fields else "transfer"
        if not {"k_perp", "k_parallel", "horizon_delay", "delay", quantity} <= fields.keys():
            continue
        values = np.asarray(fields[quantity].real, "<f4")
        if quantity == "transfer":
            logarithmic, label = False, "T"
        axes = {key: rounded(fields[key]) for key in ("k_perp", "k_parallel", "baseline_length")}
        axes["horizon"] = rounded(fields["horizon_delay"] / fields["delay"][-1])
        encoded = base64.b64encode(values.tobytes()).decode("ascii")
        series.append({"label": SERIES.get(name, (name,))[0], "values": encoded, **axes})
    if not series:
        return None
    kind = {"kind": "maps", "value": label, "logarithmic": logarithmic, "series": series}
    return Chart("Cylindrical power spectra" if logarithmic else "Cylindrical T", kind)


CLAIMS_TITLE = "Claims of the paper"


@dataclass(frozen=True)
class Picture:
    """A figure of the report: the png, its other files relative to the run folder, and charts of its arrays."""

    name: str
    caption: str
    path: Path
    files: Sequence[str] = ()
    charts: Sequence[Chart] = ()

    @property
    def image(self) -> str:
        """The png, encoded for the page."""
        return base64.b64encode(self.path.read_bytes()).decode("ascii")


@dataclass(frozen=True)
class Contents:
    """All contents of a report.

    Facts are short statements by name, such as the time, the machine and versions. Answers say which calibrators of a
    comparison pass. Pictures and tables are in the order of the page, below the headline. Files, tables and records,
    are relative to the run folder. Parts are the run folders of which this one consists: name and relative path of
    their reports. The experiment is the resolved file, or empty.
    """

    title: str
    description: str
    setup: str
    facts: Mapping[str, str]
    stand_ins: Sequence[str]
    warnings: Sequence[str]
    pictures: Sequence[Picture]
    tables: Sequence[Table]
    headline: Sequence[Number]
    answers: Sequence[str]
    files: Sequence[str]
    parts: Sequence[tuple[str, str]]
    experiment: str


def read_contents(run: RunFolder) -> Contents:
    """Read the folder of a finished run of any study; raises InputError for others."""
    manifest = run.manifest
    experiment = run.path / EXPERIMENT
    text = experiment.read_text(encoding="utf-8") if experiment.is_file() else ""
    sky_model = f" Sky model: {manifest['sky_model']}." if "sky_model" in manifest else ""
    found = run.standings()
    tables = [
        standing_table(found) if found else None,
        _claims_table(run),
        *run.shown,
        _convergence(run.products, sky_model),
        _simulation(run.products),
        _stages(run.products),
    ]
    signal = read_signal(run)
    lost = [f"missing, and written by the run: {', '.join(run.lost)}; run it again"] if run.lost else []
    excess = [signal.excess] if signal is not None and signal.excess else []
    return Contents(
        title=run.name,
        description=manifest.get("description") or (run.content.get("description", "") if text else ""),
        setup=manifest.get("setup", ""),
        facts=_facts(manifest),
        stand_ins=manifest.get("stand_ins", []),
        warnings=[*lost, *excess, *manifest.get("warnings", []), *recorded_warnings(run.products)],
        pictures=_pictures(run),
        tables=[table for table in tables if table is not None],
        headline=read_headline(run),
        answers=advice(found),
        files=_files(run.path),
        parts=_parts(run),
        experiment=text,
    )


def _facts(manifest: Mapping[str, Any]) -> dict[str, str]:
    machine, versions = manifest.get("machine"), manifest.get("versions", {})
    facts = {
        "finished": manifest.get("finished"),
        "commit": manifest.get("git_commit"),
        "sky model of the calibrator": manifest.get("sky_model"),
        "machine": machine and f"{machine['cores']} cores, {machine['memory_gb']} GB, {machine['system']}",
        "seeds": ", ".join(f"{name} {value}" for name, value in manifest.get("seeds", {}).items()),
        "versions": ", ".join(f"{name} {value}" for name, value in versions.items() if value),
    }
    return {name: str(value) for name, value in facts.items() if value}


def recorded_warnings(records: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the warnings in the records of products; of those that differ in numbers alone, the first and a count."""
    alike: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for record in records:
        for text in record.get("notes", {}).get("warnings", []):
            alike.setdefault((record["stage"], NUMBER.sub("", text)), []).append((record["label"], text))
    sentences = []
    for (stage, _), ((label, text), *others) in alike.items():
        sentences.append(f"{stage} ({label}{f', and {len(others)} more' if others else ''}): {text}")
    return sentences


def _pictures(run: RunFolder) -> list[Picture]:
    """Return the pictures of the manifest in its order and with its captions, then others by name."""
    found = {path.stem: path for path in sorted((run.path / "figures").glob("*.png"))}
    drawn = [item for item in run.products if item["stage"] == "figure"]
    captions = {item["label"]: item.get("notes", {}).get("caption", "") for item in drawn}
    captions = run.manifest.get("captions", captions)
    order = dict.fromkeys(name for name in (*captions, *found) if name in found)
    return [_picture(name, captions.get(name, ""), found[name]) for name in order]


def _picture(name: str, caption: str, path: Path) -> Picture:
    others = [path.with_suffix(suffix) for suffix in (".pdf", ".npz")]
    files = [f"figures/{other.name}" for other in others if other.is_file()]
    return Picture(name, caption, path, files, read_charts(others[1]) if others[1].is_file() else ())


def _files(folder: Path) -> list[str]:
    tables = sorted(path for path in (folder / "tables").glob("*") if path.is_file())
    records = [folder / name for name in ("claims.md", CLAIMS_JSON, EXPERIMENT, MANIFEST, "run.log")]
    return [str(path.relative_to(folder)) for path in (*records, *tables) if path.is_file()]


def _parts(run: RunFolder) -> list[tuple[str, str]]:
    # Members may come from references, which have no page.
    pages = {name: part.path.resolve() / "report.html" for name, part in run.parts.items()}
    return [(name, os.path.relpath(page, run.path.resolve())) for name, page in pages.items() if page.is_file()]


def _claims_table(run: RunFolder) -> Table | None:
    """Return the verdicts on the papers' statements, or a sentence without a role in any paper; None without papers."""
    if not run.has_claims:
        return None
    claims = run.claims
    evaluated = [claim for claim in claims if claim.measured is not None]
    if not evaluated:
        reasons = [text for item in run.products for text in item.get("notes", {}).get("without_role", [])]
        return Table((), (), CLAIMS_TITLE, " ".join(reasons)) if reasons else None
    others = len(claims) - len(evaluated)
    lacking = f" {others} further claims were not evaluated; claims.md says why." if others else ""
    return verdict_table(evaluated, CLAIMS_TITLE, f"{tally(claims)}.{lacking}")


def _convergence(products: Sequence[Mapping[str, Any]], sky_model: str) -> Table | None:
    found = [(item["label"], item["notes"]) for item in products if item["stage"] == "calibrate"]
    rows = [
        (
            label,
            ", ".join(f"{count} {status}" for status, count in notes["by_status"].items()),
            f"{notes['median_steps']:g}" if "median_steps" in notes else "",
            f"{notes['median_seconds_per_solve']:.2f} s",
        )
        for label, notes in found
    ]
    columns = ("calibration of", "solves", "median steps", "median time per solve")
    return Table(columns, rows, "Solver convergence", sky_model.strip()) if rows else None


def _simulation(products: Sequence[Mapping[str, Any]]) -> Table | None:
    found = [(item["label"], item["notes"]) for item in products if item["stage"] == "simulate"]
    rows = [
        (
            label,
            f"{notes['interpolation']['max_error']:.1e}" if notes.get("interpolation") else "not interpolated",
            ", ".join(f"{floor['worst_db']} dB ({taper})" for taper, floor in notes.get("delay_floor", {}).items()),
        )
        for label, notes in found
    ]
    columns = ("component", "largest interpolation error", "delay floor beyond the horizon")
    note = "Errors relative to the rms; the floor is that of the worst baseline."
    return Table(columns, rows, "Accuracy of the simulation", note) if rows else None


def _stages(products: Sequence[Mapping[str, Any]]) -> Table | None:
    stages: dict[str, list[Mapping[str, Any]]] = {}
    for item in products:
        if "cpu_seconds" in item:
            stages.setdefault(item["stage"], []).append(item)
    rows = [
        (
            stage,
            str(len(items)),
            str(sum(item["made_by_this_run"] for item in items)),
            duration(sum(item["seconds"] for item in items)),
            duration(sum(item["cpu_seconds"] for item in items)),
            f"{max(item['peak_memory_bytes'] for item in items) / 1e9:.2f} GB",
        )
        for stage, items in stages.items()
    ]
    columns = ("stage", "products", "made by this run", "time", "cpu time", "peak memory of the process")
    note = "Time and memory when each product was made, by this run or an earlier one."
    return Table(columns, rows, "Stages", note) if rows else None


REPORT = "report.html"


def page_of(template: str, **values: Any) -> str:
    """Return the page of a template, with its style and script."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("calstudy.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    css, script = ((Path(__file__).parent / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    return environment.get_template(template).render(css=css, script=script, **values)


def write_report(folder: Path) -> Path:
    """Write report.html into the folder of a finished run, completely or not at all, and return its path.

    Raises InputError for other folders.
    """
    return write_page(page_of("page.html", contents=read_contents(RunFolder(folder))), folder / REPORT)


def write_page(page: str, path: Path) -> Path:
    """Write a page, completely or not at all, and return its path; raises InputError if it cannot be written."""
    with errors_of_files(f"{path}: cannot be written"), replacing(path) as stream:
        stream.write(page.encode())
    return path


ALWAYS_DIFFERENT = ("name", "description", "outputs")
"""Sections of an experiment whose differences do not concern its results."""
COLOURS = ("orange", "cyan", "magenta", "red", "black", "grey")
"""Colours of the runs in charts of all; the EoR is grey."""
MOST = len(COLOURS) - 1


@dataclass(frozen=True)
class Several:
    """Some runs, and their common contents.

    Names are those of the runs, or of their folders if two runs have one name. Differences are the fields of the
    experiments that differ. Claims, the papers' statements with the verdicts on all, are None if no run has any. A
    picture or table is None where a run lacks it.
    """

    contents: Sequence[Contents]
    names: Sequence[str]
    differences: Table
    charts: Sequence[Chart]
    claims: Table | None
    pictures: Sequence[Sequence[Picture | None]]
    tables: Sequence[tuple[str, Sequence[Table | None]]]


def read_several(folders: Sequence[Path]) -> Several:
    """Read run folders; raises InputError if one of them is not that of a finished run, or there are too many."""
    if not 2 <= len(folders) <= MOST:
        raise InputError(f"a page of several runs has 2 to {MOST}, not {len(folders)}")
    places = [folder.resolve() for folder in folders]
    if twice := [str(folder) for folder, place in zip(folders, places, strict=True) if places.count(place) > 1]:
        raise InputError(f"{twice[-1]}: the same run twice; a page of several runs compares different ones")
    runs = [RunFolder(folder) for folder in folders]
    contents = [read_contents(run) for run in runs]
    names = [found.title for found in contents]
    if len(set(names)) < len(names):
        names = [place.name for place in places]
    pictures = _matched([{item.name: item for item in found.pictures} for found in contents])
    tables = _matched([{item.title: item for item in found.tables} for found in contents])
    claims = tables.pop(CLAIMS_TITLE, None)
    return Several(
        contents,
        names,
        _differences([found.experiment for found in contents], names),
        _overlaid(runs, names),
        None if claims is None else _claims(claims, names),
        list(pictures.values()),
        list(tables.items()),
    )


def _matched(found: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    return {name: [one.get(name) for one in found] for name in dict.fromkeys(name for one in found for name in one)}


def _differences(texts: Sequence[str], names: Sequence[str]) -> Table:
    fields = [dict(leaves(yaml.safe_load(text) or {})) if text else {} for text in texts]
    rows = []
    for name in dict.fromkeys(name for one in fields for name in one):
        values = [one.get(name) for one in fields]
        if name.partition(".")[0] not in ALWAYS_DIFFERENT and any(value != values[0] for value in values):
            rows.append((name, *(str(one.get(name, "-")) for one in fields)))
    note = "" if rows else "The experiments do not differ."
    return Table(("field", *names), rows, "Fields that differ", note)


def _overlaid(runs: Sequence[RunFolder], names: Sequence[str]) -> list[Chart]:
    """Return P^R of all runs with their EoR, once where it is the same, and T of all, outside the wedge.

    There are none where one run has it.
    """
    spectra: list[dict[str, Any]] = []
    signals: list[np.ndarray] = []
    transfers: list[dict[str, Any]] = []
    for run, name, colour in zip(runs, names, COLOURS, strict=False):
        for variant in ("residual", "eor"):
            label, grey = SERIES[variant]
            with suppress(Unevaluated, InputError):
                found = run.tables.spherical(variant, "outside-wedge")
                points = (found.k, found.power.real, found.error)
                if variant == "residual":
                    spectra.append(curve(f"{label}, {name}", colour, points))
                elif not any(np.array_equal(found.power.real, other) for other in signals):
                    signals.append(found.power.real)
                    spectra.append(curve(f"{label}, {name}", grey, points))
        with suppress(Unevaluated, InputError):
            loss = run.tables.transfer("outside-wedge")
            points = (loss.k, loss.scale_free_transfer, loss.scale_free_transfer_error)
            transfers.append(curve(name, colour, points))
    charts = [
        chart_of_curves("Power spectra outside the wedge", POWER, True, spectra),
        chart_of_curves("T outside the wedge, free of the flux scale", "T", False, transfers),
    ]
    return [chart for chart in charts if sum(one["colour"] != "grey" for one in chart.data["series"]) > 1]


def _claims(found: Sequence[Table | None], names: Sequence[str]) -> Table | None:
    """Return one row for each statement, with the numbers and the verdicts of all runs."""
    rows: dict[tuple[str, ...], list[tuple[str, str] | None]] = {}
    for side, table in enumerate(found):
        for row in table.rows if table is not None else ():
            section, sentence, quantity, measured, threshold, verdict = row
            rows.setdefault((section, sentence, quantity, threshold), [None] * len(found))[side] = (measured, verdict)
    cells = [
        (*statement, *(text for texts in zip_longest(*(side or ("", "") for side in sides)) for text in texts))
        for statement, sides in rows.items()
    ]
    columns = ("section", "sentence", "measured is", "must be", *names, *(f"verdict, {name}" for name in names))
    return Table(columns, cells, CLAIMS_TITLE) if cells else None


def write_several(folders: Sequence[Path], output: Path, overwrite: bool = False) -> Path:
    """Write the page of several runs, completely or not at all, and return its path.

    Raises InputError if a folder is not that of a finished run, or the file exists and `overwrite` is false.
    """
    if output.exists() and not overwrite:
        raise InputError(f"{output}: exists; choose another --output, or --overwrite it")
    return write_page(page_of("several.html", several=read_several(folders)), output)
