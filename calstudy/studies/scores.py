"""Files of scores of calibrators, and the page that ranks them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, StringConstraints, TypeAdapter, ValidationError, field_validator
from rich.console import Console

from calstudy import __version__
from calstudy.base.errors import InputError, errors_of_files
from calstudy.base.files import digest_json, sha256
from calstudy.base.identity import identity
from calstudy.base.schema import Section
from calstudy.base.table import Table, one_line, plain_text
from calstudy.calibrate.records import Status
from calstudy.experiment.model import Experiment
from calstudy.power.score import BANDS
from calstudy.products.comparison import score_table
from calstudy.products.files import SCORE, read_json
from calstudy.products.score import MEASURED
from calstudy.products.tolerances import COUNTS
from calstudy.run.execution import Budget, Workers
from calstudy.run.store import Store
from calstudy.studies.folder import folder_of_runs, log_to
from calstudy.studies.kinds.comparison import Comparison, WorldData
from calstudy.studies.study import make
from calstudy.verdicts.standing import LARGEST_ERROR, is_measured, standing_table, standings, upper_limit

LOG = "score.log"
NUMBERS = ("bias", "bias_error", "transfer", "transfer_error")
"""Fields of a band that decide whether it counts."""
VERIFIED = "verified.txt"
"""File of the page's maintainer: lines of the SHA-256 of a file of scores, and who repeated its scoring."""
Label = Annotated[str, StringConstraints(pattern=r"^[\w(][\w.,:;()+\-−±%=°'² ]*$", max_length=80)]
"""One line of letters, digits, spaces and common signs without a meaning in Markdown or HTML."""
Measured = Annotated[float, Field(ge=-1e30, le=1e30)] | None
Positive = Annotated[float, Field(ge=0, le=1e30)] | None


class _Band(Section):
    """Scores in a band of k, h/Mpc, None if not known; other content of a file is ignored."""

    model_config = ConfigDict(extra="ignore")

    k: list[float]
    transfer: Measured
    transfer_error: Positive
    bias: Measured
    bias_error: Positive
    recovered: Measured = None
    recovered_error: Positive = None
    cross_transfer: Measured = None
    linear_transfer: Measured = None

    @field_validator("k")
    @classmethod
    def _is_a_band(cls, value: list[float]) -> list[float]:
        if value not in (list(pair) for pair in pairwise(BANDS)):
            raise ValueError(f"must be one of the bands between {', '.join(map(str, BANDS))} h/Mpc")
        return value


class _Summary(Section):
    """The numbers of score.json that a page shows."""

    model_config = ConfigDict(extra="ignore")

    bands: list[_Band] = Field(min_length=1)
    flux_scale: Measured
    sky_model_error: Positive = None
    gain_error_aligned: Positive
    gain_error_as_fitted: Positive
    held_out_chi_squared: Positive
    by_status: dict[Status, Annotated[int, Field(ge=0, le=10**9)]]
    cpu_seconds_per_integration: Positive = None
    peak_memory: Positive

    @field_validator("bands")
    @classmethod
    def _have_each_band_once(cls, value: list[_Band]) -> list[_Band]:
        if len({tuple(band.k) for band in value}) != len(value):
            raise ValueError("has a band of k twice")
        return value


class Row(Section):
    """The scores of one calibrator in one world.

    `digest` is that of data and sky model, as in the manifest of an export; `scoring` is from `scoring_of`.
    """

    world: Label
    calibrator: Label
    digest: str
    scoring: str
    scores: dict[str, Any]

    @field_validator("scores")
    @classmethod
    def _are_numbers(cls, value: dict[str, Any]) -> dict[str, Any]:
        try:
            return _Summary.model_validate(value).model_dump()
        except ValidationError as error:
            raise ValueError(_first(error)) from None

    @property
    def k(self) -> list[list[float]]:
        """The bands of k, h/Mpc."""
        return [band["k"] for band in self.scores["bands"]]


class Scores(Section):
    """Content of a file of scores; a refusal has world, calibrator and reason."""

    calstudy: str
    name: Label
    rows: tuple[Row, ...]
    refusals: tuple[tuple[Label, Label, str], ...] = ()


def scoring_of(experiment: Experiment) -> str:
    """Return a digest of the definition of T and bias: settings of the power spectra, and a version."""
    return digest_json([identity(experiment.power), MEASURED])


def measure_scores(study: Comparison, budget: Budget, console: Console) -> Scores:
    """Return the scores of all cases of a comparison, from `load_worlds`, and make products that are missing."""
    for label in (study.name, *study.file.worlds, *study.file.calibrators):
        try:
            TypeAdapter(Label).validate_python(label)
        except ValidationError:
            raise InputError(
                f"{label!r}: cannot label a row of scores; use at most 80 letters, digits, spaces and "
                ". , : ; ( ) + - % = '"
            ) from None
    study, count = study.sized_to(budget)
    runs, tasks = folder_of_runs(study.outputs), list(study.scores.values())
    with log_to(runs / LOG):
        workers = Workers(count, runs / LOG, budget.scheduler)
        made = make(tasks, Store(study.outputs.store), workers, console)
    rows = [
        Row(
            world=case.world,
            calibrator=case.calibrator,
            digest=WorldData.of(case.experiment, study.file.salt).digest,
            scoring=scoring_of(case.experiment),
            scores=read_json(made.products[task.key].path / SCORE),
        )
        for case, task in zip((case for case in study.cases if not case.refusal), tasks, strict=True)
    ]
    return Scores(calstudy=__version__, name=study.name, rows=tuple(rows), refusals=tuple(study.refused))


def tables(scores: Scores) -> dict[str, Table]:
    """Return a table for each world, as in the comparison of calibrators, and one of which calibrators pass."""
    worlds = dict.fromkeys([*(row.world for row in scores.rows), *(world for world, _, _ in scores.refusals)])
    found = {world: {row.calibrator: row.scores for row in scores.rows if row.world == world} for world in worlds}
    trusted = standing_table(standings(found, scores.refusals))
    return {**{world: score_table(cases) for world, cases in found.items() if cases}, trusted.title: trusted}


def read_scores(path: Path) -> Scores:
    """Read a file of scores; raises InputError if it is not one."""
    try:
        with errors_of_files(f"{path}: cannot be read"):
            return Scores.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise InputError(f"{path}: is not a file of 'calstudy score --output' ({_first(error)})") from None


def _first(error: ValidationError) -> str:
    first = error.errors()[0]
    return plain_text(f"{'.'.join(map(str, first['loc'])) or 'its content'}: {first['msg']}")


@dataclass(frozen=True)
class _Standing:
    """The rank of a row: the number of bands that count, and the mean T in them, or the bias if none counts."""

    clean: int
    bands: int
    transfer: float
    worst: float

    @classmethod
    def of(cls, row: Row) -> _Standing:
        limits, kept = [], []
        for band in row.scores["bands"]:
            bias, bias_error, transfer, error = (band[name] for name in NUMBERS)
            known = None not in (bias, bias_error, transfer, error)
            limits.append(upper_limit(bias, bias_error) if known else float("inf"))
            # No calibration can leave more than the whole signal, or less than nothing.
            if limits[-1] < COUNTS and is_measured(transfer, error) and -error <= transfer <= 1 + error:
                kept.append(transfer)
        return cls(len(kept), len(limits), sum(kept) / len(kept) if kept else 0.0, min(limits))

    @property
    def order(self) -> tuple[float, ...]:
        return -self.clean, -min(self.transfer, 1.0), self.worst

    @property
    def text(self) -> str:
        return f"{self.clean} of {self.bands}" + (f", T {self.transfer:.2f}" if self.clean else "")


def leaderboard(folder: Path) -> str:
    """Return a page (Markdown) that ranks the files of scores in a folder; InputError if they do not fit together."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise InputError(f"{folder}: has no files of scores (*.json, from 'calstudy score --output')")
    found = {path: read_scores(path) for path in paths}
    worlds: dict[str, dict[str, Row]] = {}
    known, verified = _read_verified(folder / VERIFIED), dict[str, str]()
    for path, scores in found.items():
        who = known.get(sha256(path), "")
        for row in scores.rows:
            rows = worlds.setdefault(row.world, {})
            _require_fitting(path, row, rows)
            rows[row.calibrator] = row
            verified[row.calibrator] = who if verified.get(row.calibrator, who) == who else ""
    if not worlds:
        raise InputError(f"{folder}: its files of scores have no rows")
    names = ", ".join(dict.fromkeys(scores.name for scores in found.values()))
    lines = [f"# Leaderboard: {names}", "", *_explanation(), "", _overview(worlds, verified).markdown()]
    for world, rows in worlds.items():
        ranked = sorted(rows.values(), key=lambda row: _Standing.of(row).order)
        lines += [f"## {world}", "", score_table({row.calibrator: row.scores for row in ranked}).markdown()]
        refusals = (refusal for scores in found.values() for refusal in scores.refusals)
        refused = [f"- {name} cannot work here: {one_line(why)}" for place, name, why in refusals if place == world]
        lines += [*refused, ""] if refused else []
    return "\n".join(lines).rstrip() + "\n"


def _explanation() -> list[str]:
    return [
        "Each cell: in how many bands of k the bias is below the EoR with two standard deviations, |bias| + 2σ < 1, "
        "and the mean of T in these bands. Rows are ordered by these two, added up over worlds. T is the part of the "
        "EoR's power that is left, the bias the power of the residual without EoR over that of the EoR; both are free "
        "of the flux scale. A band in which T is below 0 or above 1 by more than its error, or has an error above "
        f"{LARGEST_ERROR:g}, does not count. All columns of the tables are explained in the "
        "[guide](guide.md#comparisons).",
        "",
        "Numbers are the word of a row's author, unless the column `verified` says who scored the gains or the program "
        "again.",
        "",
        "Built-in calibrators have the weights of their own gains unless `weights` says otherwise "
        "([weights](weights.md)).",
    ]


def _read_verified(path: Path) -> dict[str, str]:
    if not path.exists():
        return {}
    lines = [line.split(maxsplit=1) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    if any(len(line) != 2 or not re.fullmatch("[0-9a-f]{64}", line[0]) for line in lines):
        raise InputError(f"{path}: lines must be a SHA-256 of a file of scores, and who scored it again")
    return {digest: one_line(who) for digest, who in lines}


def _require_fitting(path: Path, row: Row, rows: Mapping[str, Row]) -> None:
    others = [other for other in rows.values() if other.digest != row.digest]
    if others:
        raise InputError(
            f"{path}: {row.calibrator!r} was scored on other data than {others[0].calibrator!r} in the world "
            f"{row.world!r} (their digests differ); score it again with the same experiment and version"
        )
    if any(other.scoring != row.scoring or other.k != row.k for other in rows.values()):
        raise InputError(
            f"{path}: {row.calibrator!r} was measured otherwise than others in the world {row.world!r} (bands of k, "
            "settings of 'power', or another version of scores); score it again with the same experiment and version"
        )
    if row.calibrator in rows:
        raise InputError(f"{path}: {row.calibrator!r} has scores in the world {row.world!r} twice; use another --name")


def _overview(worlds: Mapping[str, Mapping[str, Row]], verified: Mapping[str, str]) -> Table:
    standings = {
        name: {world: _Standing.of(rows[name]) for world, rows in worlds.items() if name in rows}
        for name in dict.fromkeys(name for rows in worlds.values() for name in rows)
    }

    def order(name: str) -> tuple[float, ...]:
        found = standings[name].values()
        return -sum(item.clean for item in found), -sum(item.clean * min(item.transfer, 1.0) for item in found)

    rows: Sequence[Sequence[str]] = [
        (
            name,
            *(standings[name][world].text if world in standings[name] else "-" for world in worlds),
            verified[name] or "-",
        )
        for name in sorted(standings, key=order)
    ]
    return Table(("calibrator", *worlds, "verified"), rows)
