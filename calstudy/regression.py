"""Regression: the kept reference results, and the comparison of arrays and claims of a run with them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError
from rich.console import Console

from calstudy.base.errors import InputError, errors_of_files
from calstudy.base.files import replacing, write_text
from calstudy.base.table import Table
from calstudy.experiment.files import dump_yaml
from calstudy.experiment.model import FIGURES
from calstudy.results.reader import EXPERIMENT, MANIFEST, NO_RUN, RunFolder
from calstudy.run.execution import Budget
from calstudy.studies.folder import manifest_text
from calstudy.studies.load import load_study
from calstudy.studies.study import run_study
from calstudy.verdicts.criterion import Verdict
from calstudy.verdicts.tables import CLAIMS_FILES, count
from calstudy.verdicts.tolerances import ROUNDING, Arrays, Drawn, Fixed, Measured, Rules, Tolerance, tolerance

KEPT = ("png", "npz")
"""Endings of the kept files of a figure: the picture and its arrays."""
TABLES = ("realizations.md", "comparison.md")
"""Tables for readers, kept beside the figures."""


@dataclass(frozen=True)
class Reference:
    """Figures (arrays by figure and name) and claims of a run or of a reference, `on_machines` if of run times.

    `tolerances` are those of the figures that the experiment of a reference names, by label.
    """

    figures: dict[str, dict[str, np.ndarray]]
    claims: list[Verdict]
    tolerances: dict[str, Rules] = field(default_factory=dict)
    on_machines: bool = False


UNKNOWN_ERROR = "moved by more than 1 % where the reference has no error"
WITHOUT_ERROR = 0.01
"""Elements whose error is not known may move by this part of the largest: other processors change fits by less."""


def find_references(folders: Sequence[Path]) -> list[Path]:
    """Return the reference folders among these and directly below; raise InputError for a folder without any."""
    found: list[Path] = []
    for folder in folders:
        inside = [*folder.glob(EXPERIMENT)] or sorted(folder.glob(f"*/{EXPERIMENT}"))
        if not inside:
            raise InputError(f"{folder}: holds no reference results (a folder with {EXPERIMENT}, or folders with one)")
        found += [path.parent for path in inside]
    return list(dict.fromkeys(found))


def read_reference(folder: Path) -> Reference:
    """Read a reference; raise InputError if an array, claim or experiment file is not readable."""
    run = RunFolder(folder)
    return Reference(run.arrays(), run.claims, _tolerances(run.content, folder), "runtime" in run.content)


def _tolerances(experiment: Mapping[str, Any], folder: Path) -> dict[str, Rules]:
    """Return the tolerances of the figures that an experiment or a collection names; none of a figure that is gone."""
    named = experiment.get("figures", (experiment.get("outputs") or {}).get("figures"))
    found = {}
    # The default figures, of a study of measured data, are null there; `rules_of` finds their tolerances by name.
    for block in named or ():
        try:
            figure = FIGURES.make(block, folder=folder)
        except (InputError, ValidationError):
            continue
        found[figure.label] = figure.tolerances
    return found


def read_run(folder: Path) -> Reference:
    """Read a finished run or collection; raise InputError for another folder."""
    run = RunFolder(folder)
    if not (folder / "figures").is_dir() or not run.manifest:
        raise InputError(f"{folder}: {NO_RUN}")
    return Reference(run.arrays(), run.claims)


def require_same_study(reference: Path, run: Path) -> None:
    """Raise InputError if a run is of another study than a reference, which it would replace."""
    name, other = RunFolder(reference).content.get("name"), RunFolder(run).name
    if name != other:
        raise InputError(
            f"--update: {run} is a run of {other!r}, and {reference} is the reference of {name!r}; give the reference "
            "of the same study, or a folder that does not exist, for a new one"
        )


def accept(run: Path, reference: Path) -> None:
    """Make a finished run the reference: its pictures, arrays, tables, claims and description replace the old ones.

    A collection keeps the experiments of its members as they are in the references beside it, by the members' names.
    The manifest does not list tables, since a reference has but some.
    Raise InputError if the run is not readable, or the folder, which need not exist, cannot be written; the complete
    run is read before anything is written.
    """
    try:
        manifest = RunFolder(run).manifest
        paths = {path.name: path for ending in KEPT for path in (run / "figures").glob(f"*.{ending}")}
        paths |= {name: run / name for name in CLAIMS_FILES if (run / name).is_file()}
        paths |= {name: run / "tables" / name for name in TABLES if (run / "tables" / name).is_file()}
        # A collection can be assembled from references with these (`calstudy.studies.kinds.collection`).
        listed = {name for entry in manifest.get("products", []) for name in entry.get("files", ())}
        paths |= {f"tables/{name}": run / "tables" / name for name in sorted(listed)}
        contents = {name: path.read_bytes() for name, path in paths.items()}
        kept = {"products": [], **manifest}
        kept.pop("tables", None)
        if "members" in manifest:
            kept["members"] = {name: name for name in manifest["members"]}
        contents[MANIFEST] = manifest_text(kept).encode()
        description = dump_yaml(_experiment(run))
    except (OSError, ValueError) as error:
        raise InputError(f"{run}: cannot be read ({error})") from None
    with errors_of_files(f"{reference}: cannot be written"):
        (reference / "tables").mkdir(parents=True, exist_ok=True)
        present = [path for ending in KEPT for path in reference.glob(f"*.{ending}")]
        present += [*(reference / name for name in (*CLAIMS_FILES, *TABLES)), *(reference / "tables").iterdir()]
        for old in present:
            if old.relative_to(reference).as_posix() not in contents:
                old.unlink(missing_ok=True)
        for name, content in (*contents.items(), (EXPERIMENT, description.encode())):
            with replacing(reference / name) as stream:
                stream.write(content)
        if not listed:
            (reference / "tables").rmdir()


def _experiment(run: Path) -> dict[str, Any]:
    """Return the description of the run, without the folders of the machine where it was made."""
    finished = RunFolder(run)
    if (run / EXPERIMENT).is_file():
        return _without_folders(finished.content)
    manifest = finished.manifest
    drawn = sorted(path.stem for path in (run / "figures").glob("*.npz"))
    return {
        "name": manifest["name"],
        "description": manifest["description"],
        "experiments": [f"../{name}/{EXPERIMENT}" for name in manifest["members"]],
        "figures": manifest.get("figures", drawn),
        "roles": manifest["roles"],
    }


def _without_folders(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return an experiment, or a comparison with one in it, without its store and folder of runs."""

    def kept(block: Mapping[str, Any], above: str = "") -> dict[str, Any]:
        return {key: value for key, value in block.items() if key not in (f"{above}store", f"{above}runs")}

    if isinstance(content.get("experiment"), Mapping):
        worlds = {world: kept(changes, "outputs.") for world, changes in content["worlds"].items()}
        return {**content, "experiment": _without_folders(content["experiment"]), "worlds": worlds}
    return {**content, "outputs": kept(content.get("outputs", {}))}


def has_results(reference: Path) -> bool:
    """Whether the study of a reference folder has results to compare; sweeps have none of their own."""
    return load_study(reference / EXPERIMENT).has_reference


def remake(reference: Path, overrides: Sequence[str], budget: Budget, console: Console) -> Path:
    """Run the study of a reference folder with ``path=value`` overrides, and return the run's folder.

    Products of other code are made again. Raise InputError if the experiment is a sweep, or as the run raises it.
    """
    study = load_study(reference / EXPERIMENT, None, overrides)
    if not study.has_reference:
        raise InputError(f"{reference}: is a {study.key}, which has no reference results")
    return run_study(study, replace(budget, strict=True), console).folder


Status = Literal["same", "moved", "beyond"]
CLAIM_SIGMAS = 3.0
"""Largest move of a number, in its uncertainties, with which a verdict may change."""


@dataclass(frozen=True)
class ArrayComparison:
    """One array of a figure against its reference: "same" to rounding, "moved" within the tolerance, or "beyond" it.

    `relative` is the largest difference over the largest magnitude of the reference; `largest`, `rms` and `shift` are
    in σ, None for arrays that are not drawn (`calstudy.verdicts.tolerances.Drawn`). `why` is the reason of the
    tolerance. `problem` names a fault other than numbers, or is empty.
    """

    figure: str
    name: str
    status: Status
    relative: float | None = None
    largest: float | None = None
    rms: float | None = None
    shift: float | None = None
    tolerance: str = ""
    why: str = ""
    problem: str = ""


@dataclass(frozen=True)
class ClaimComparison:
    """One claim against its reference: verdicts, and measured numbers (None where not evaluated)."""

    name: str
    status: Status
    reference_verdict: str
    verdict: str
    reference: float | None = None
    measured: float | None = None
    sigmas: float | None = None


def rules_of(figure: str, declared: Mapping[str, Rules] | None = None) -> Rules:
    """Return the tolerances of a figure by its label: `declared`, or those of the plug-in; an unknown figure has none.

    A label may add a word to the name of a built-in or installed figure.
    """
    if declared and figure in declared:
        return declared[figure]
    names = FIGURES.names()
    found = next((name for name in (figure, figure.rpartition("-")[0]) if name in names), None)
    return FIGURES.find(found).tolerances if found else ()


def compare_figures(
    reference: Mapping[str, Arrays], made: Mapping[str, Arrays], declared: Mapping[str, Rules] | None = None
) -> list[ArrayComparison]:
    """Compare figures, each a mapping of arrays by name, with the reference of the same label; see `rules_of`.

    A figure or array that only the reference has is beyond any tolerance; one that only the new results have, moved.
    """
    found = []
    for figure in dict.fromkeys([*reference, *made]):
        old, new, rules = reference.get(figure, {}), made.get(figure, {}), rules_of(figure, declared)
        for name in dict.fromkeys([*old, *new]):
            if name not in new:
                found.append(ArrayComparison(figure, name, _worst(tolerance(rules, name, old)), problem="missing"))
            elif name not in old:
                problem = "new, the reference does not have it"
                found.append(ArrayComparison(figure, name, "moved", problem=problem))
            else:
                found.append(compare_array(figure, name, old, new[name], rules))
    return found


def _worst(rule: Tolerance) -> Status:
    """Return the status of what differs by anything."""
    return "moved" if isinstance(rule, Measured) else "beyond"


def compare_array(
    figure: str, name: str, reference: Arrays, made: np.ndarray, rules: Rules | None = None
) -> ArrayComparison:
    """Compare one array of a figure with all reference arrays of the figure, which give the error bars.

    `rules` are by default those of the figure of that name.
    """
    old = reference[name]
    rule = tolerance(rules_of(figure) if rules is None else rules, name, reference)
    if old.shape != made.shape:
        return ArrayComparison(figure, name, _worst(rule), problem=f"shape {made.shape}, was {old.shape}")
    if old.dtype.kind not in "fc" or made.dtype.kind not in "fc":
        equal = np.array_equal(old, made)
        status: Status = "same" if equal else _worst(rule)
        problem = "" if equal else "different"
        return ArrayComparison(figure, name, status, tolerance="equal", why=rule.why, problem=problem)
    if not _same_where_not_finite(old, made):
        return ArrayComparison(figure, name, _worst(rule), problem="finite in other places, or not alike")
    relative, deviations = _relative(old, made), None
    if isinstance(rule, Drawn):
        sigma = np.broadcast_to(np.sqrt(2) * rule.error(reference, name), old.shape)
        if _relative(old, made, ~(sigma > 0)) > WITHOUT_ERROR:
            return ArrayComparison(figure, name, "beyond", relative, problem=UNKNOWN_ERROR)
        deviations = _deviations(name, old, made, sigma)
    if relative <= ROUNDING and (deviations is None or deviations[0] <= ROUNDING):
        status = "same"
    elif isinstance(rule, Fixed) or (isinstance(rule, Drawn) and deviations and _too_far(rule, deviations)):
        status = "beyond"
    else:
        status = "moved"
    largest, rms, shift = deviations or (None, None, None)
    return ArrayComparison(figure, name, status, relative, largest, rms, shift, str(rule), rule.why)


def _same_where_not_finite(old: np.ndarray, made: np.ndarray) -> bool:
    """Return whether both arrays are not finite in the same places, and have the same infinities and NaN there."""
    places = ~np.isfinite(old)
    return np.array_equal(places, ~np.isfinite(made)) and np.array_equal(old[places], made[places], equal_nan=True)


def _too_far(rule: Drawn, deviations: tuple[float, float, float]) -> bool:
    largest, rms, shift = deviations
    return largest > rule.largest or rms > rule.rms or abs(shift) > rule.shift


def _relative(old: np.ndarray, made: np.ndarray, among: np.ndarray | bool = True) -> float:
    """Return the largest difference, among some elements, over the largest magnitude of the reference."""
    finite = np.isfinite(old)
    used, scale = finite & among, np.abs(old[finite]).max(initial=0)
    difference = np.abs(made[used] - old[used]).max(initial=0)
    return float(difference / scale) if scale > 0 else float(difference)


def _deviations(name: str, old: np.ndarray, made: np.ndarray, sigma: np.ndarray) -> tuple[float, float, float]:
    """Return the largest, rms and mean of a difference in its σ; elements without a finite error bar are left out."""
    usable = np.isfinite(old) & np.isfinite(sigma) & (sigma > 0)
    difference, sigma = made[usable] - old[usable], sigma[usable]
    if not difference.size:
        return 0.0, 0.0, 0.0
    if name.rpartition(".")[2] == "power":
        difference = difference.real  # The imaginary part of a power estimates nothing.
    elif np.iscomplexobj(difference):
        difference, sigma = np.concatenate([difference.real, difference.imag]), np.tile(sigma, 2)
    scaled = difference / sigma
    rms, shift = np.sqrt(np.mean(scaled**2)), scaled.mean() * np.sqrt(scaled.size)
    return float(np.abs(scaled).max()), float(rms), float(shift)


def compare_claims(
    reference: Sequence[Verdict], made: Sequence[Verdict], on_machines: bool = False
) -> list[ClaimComparison]:
    """Compare claims by name.

    Another verdict is beyond if the number moved by more than three of its uncertainties, or has none. A claim that was
    evaluated and now is missing or not evaluated is beyond as well; those about run time and memory (`on_machines`)
    are never beyond.
    """
    old, new = ({claim.name: claim for claim in claims} for claims in (reference, made))
    names = dict.fromkeys([*old, *new])
    return [_compare_claim(name, old.get(name), new.get(name), on_machines) for name in names]


def _compare_claim(name: str, old: Verdict | None, new: Verdict | None, on_machines: bool) -> ClaimComparison:
    if old is None or new is None:
        status: Status = "moved" if old is None or old.measured is None else "beyond"
        verdicts = (old.verdict if old else "new", new.verdict if new else "missing")
        return ClaimComparison(name, status, *verdicts)
    before, after = old.measured, new.measured
    if before is None or after is None:
        evaluated: Status = "moved" if on_machines and after is not None else "beyond"
        status = "same" if old.verdict == new.verdict else evaluated
        return ClaimComparison(name, status, old.verdict, new.verdict, before, after)
    difference = abs(after - before)
    sigmas = difference / old.uncertainty if old.uncertainty else None
    if old.verdict != new.verdict:
        status = "moved" if on_machines or (sigmas is not None and sigmas <= CLAIM_SIGMAS) else "beyond"
    else:
        status = "same" if difference <= ROUNDING * max(abs(before), abs(after)) else "moved"
    return ClaimComparison(name, status, old.verdict, new.verdict, before, after, sigmas)


REGRESSION_JSON = "regression.json"
STATUSES = ("same", "moved", "beyond")
LISTED = 20
"""Largest number of listed arrays that moved within their tolerance, the farthest first; all are in the JSON."""


@dataclass(frozen=True)
class Regression:
    """A run against a reference: names of both folders, and all comparisons."""

    reference: str
    run: str
    arrays: list[ArrayComparison]
    claims: list[ClaimComparison]

    @property
    def holds(self) -> bool:
        """True if nothing is beyond its tolerance."""
        return "beyond" not in {item.status for item in self.arrays} | {item.status for item in self.claims}


def tally(items: Sequence[ArrayComparison | ClaimComparison]) -> str:
    """Count the statuses in one line."""
    return count([item.status for item in items], STATUSES)


def write_json(regression: Regression, folder: Path) -> Path:
    """Write ``regression.json`` into a folder; raise InputError if it cannot be written."""
    path = folder / REGRESSION_JSON
    text = json.dumps({**asdict(regression), "holds": regression.holds}, indent=1, ensure_ascii=False)
    with errors_of_files(f"{path}: cannot be written"):
        write_text(path, text + "\n")
    return path


def show(regression: Regression, console: Console) -> None:
    """Print the count per figure, the arrays that moved and by how much, and the claims that moved."""
    console.print(f"{regression.reference} against {regression.run}", markup=False, highlight=False)
    for figure, items in groupby(regression.arrays, lambda item: item.figure):
        console.print(f"  {figure}: {tally(list(items))}", markup=False)
    console.print(f"  claims: {tally(regression.claims) if regression.claims else 'none in the reference'}")
    arrays = list(_listed(regression.arrays))
    if arrays:
        _array_table(arrays).show(console)
        hidden = sum(item.status != "same" for item in regression.arrays) - len(arrays)
        for item in arrays:
            if item.status == "beyond":
                allowed = item.problem or f"allowed: {item.tolerance} ({item.why})"
                console.print(f"{item.figure}: {item.name}: {allowed}", markup=False)
        if hidden:
            console.print(f"... and {hidden} more that moved within their tolerance")
    claims = [item for item in regression.claims if item.status != "same"]
    if claims:
        _claim_table(claims).show(console)
    verdict = "holds" if regression.holds else "DOES NOT HOLD: what is 'beyond' is farther than its tolerance"
    console.print(f"{regression.reference}: {verdict}", markup=False, highlight=False)


def _listed(items: Sequence[ArrayComparison]) -> Iterator[ArrayComparison]:
    yield from (item for item in items if item.status == "beyond")
    moved = [item for item in items if item.status == "moved"]
    yield from sorted(moved, key=lambda item: -(item.rms or item.relative or 0))[:LISTED]


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"


def _array_table(items: Sequence[ArrayComparison]) -> Table:
    rows = [
        (f"{item.figure}: {item.name}", item.status, *map(_number, (item.relative, item.largest, item.rms, item.shift)))
        for item in items
    ]
    return Table(("array", "", "of largest", "largest σ", "rms σ", "mean σ"), rows, "what moved")


def _claim_table(items: Sequence[ClaimComparison]) -> Table:
    rows = []
    for item in items:
        was = f"{_number(item.reference)} {item.reference_verdict}".strip()
        now = f"{_number(item.measured)} {item.verdict}".strip()
        rows.append((item.name, item.status, was, now, _number(item.sigmas)))
    return Table(("claim", "", "was", "is", "σ"), rows, "claims that moved")
