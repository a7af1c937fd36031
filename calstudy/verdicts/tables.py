"""Tables of verdicts: for the terminal, as JSON for programs, as Markdown for documents."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, asdict, fields
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table as TerminalTable

from calstudy.base.files import write_text
from calstudy.base.table import Table, coloured, number
from calstudy.verdicts.criterion import Verdict

OUTCOMES = ("supported", "contradicted", "mixed", "undecided", "not evaluated")
"""Outcomes of a sentence; a statement is never mixed."""


def outcomes_of_sentences(verdicts: Iterable[Verdict]) -> dict[str, str]:
    """Return the outcome of each sentence by its id, without statements on the simulation alone.

    It is that of its evaluated statements. Supported statements beside others that are undecided or not evaluated leave
    it undecided; it is "mixed" if some are contradicted and others are not.
    """
    found: dict[str, set[str]] = {}
    for verdict in verdicts:
        if not verdict.tests_simulation:
            found.setdefault(verdict.sentence_id or verdict.name, set()).add(verdict.verdict)
    return {sentence: _together(outcomes) for sentence, outcomes in found.items()}


def _together(outcomes: set[str]) -> str:
    if "supported" in outcomes and "contradicted" not in outcomes and len(outcomes) > 1:
        return "undecided"
    evaluated = outcomes - {"not evaluated"}
    return "mixed" if len(evaluated) > 1 else next(iter(evaluated or outcomes))


def counts(outcomes: Iterable[str]) -> str:
    """Count the outcomes that occur, in words: ``3 supported, 1 mixed``."""
    found = Counter(outcomes)
    return ", ".join(f"{found[outcome]} {outcome}" for outcome in OUTCOMES if found[outcome])


def tally_of_sentences(verdicts: Sequence[Verdict]) -> str:
    """Count sentences and statements in one line, and separately the statements that test the simulation alone."""
    sentences = outcomes_of_sentences(verdicts)
    parts = []
    for simulated, about in ((False, ""), (True, " on the simulation alone")):
        words = [verdict.verdict for verdict in verdicts if verdict.tests_simulation == simulated]
        if words:
            parts.append(f"{_some(len(words), 'statement')}{about}: {counts(words)}")
    if sentences:
        parts.insert(0, f"{_some(len(sentences), 'sentence')}: {counts(sentences.values())}")
    return "; ".join(parts)


def combined(parts: Iterable[Sequence[Verdict]]) -> list[Verdict]:
    """Return one verdict for each statement, that of the last part that evaluates it, section by section."""
    found: dict[str, Verdict] = {}
    for verdict in (verdict for part in parts for verdict in part):
        if verdict.name not in found or verdict.verdict != "not evaluated":
            found[verdict.name] = verdict
    sections = list(dict.fromkeys(verdict.section for verdict in found.values()))
    return sorted(found.values(), key=lambda verdict: sections.index(verdict.section))


def _some(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


LIMIT_OUTCOMES = ("PASS", "FAIL", "not evaluated")
CLAIMS_JSON, CLAIMS_MARKDOWN = "claims.json", "claims.md"
BY_SOLVER_JSON, BY_SOLVER_MARKDOWN = "claims-by-solver.json", "claims-by-solver.md"
CLAIMS_FILES = (CLAIMS_JSON, CLAIMS_MARKDOWN, BY_SOLVER_JSON, BY_SOLVER_MARKDOWN)


def measured(verdict: Verdict) -> str:
    """Write the number and its uncertainty with the smallest visible effect, or the reason why there is no number."""
    if verdict.measured is None:
        return verdict.reason
    text = number(verdict.measured, verdict.uncertainty)
    if verdict.kind in ("at least", "at most"):
        return f"{verdict.kind} {text}"
    if verdict.kind == "scatter":
        text = text.replace(" ± ", ", scatter ")
    return text if verdict.smallest_effect is None else f"{text}; smallest effect seen {verdict.smallest_effect:.2g}"


def count(words: Sequence[str], kinds: Iterable[str]) -> str:
    """Count words of some kinds in one line: ``3 PASS, 1 FAIL``."""
    return ", ".join(f"{words.count(kind)} {kind}" for kind in kinds)


def tally(verdicts: Sequence[Verdict]) -> str:
    """Count outcomes in one line: statements by the sentences of their papers, limits of our own one by one."""
    if any(verdict.sentence_id for verdict in verdicts):
        return tally_of_sentences(verdicts)
    return count([verdict.verdict for verdict in verdicts], LIMIT_OUTCOMES)


def to_json(verdicts: Sequence[Verdict]) -> str:
    """Return verdicts as a JSON list, without the fields that have their default."""
    defaults = {field.name: field.default for field in fields(Verdict) if field.default is not MISSING}
    return _dumped(
        [
            {name: value for name, value in asdict(verdict).items() if name not in defaults or value != defaults[name]}
            for verdict in verdicts
        ]
    )


def _dumped(found: list[dict[str, Any]]) -> str:
    return json.dumps(found, indent=1, ensure_ascii=False, allow_nan=False)


def from_json(text: str) -> list[Verdict]:
    """Return the verdicts that `to_json` wrote; raises TypeError, KeyError or ValueError for other texts."""
    items = json.loads(text)
    if not isinstance(items, list):
        raise TypeError(f"expected a list of verdicts, not {type(items).__name__}")
    return [Verdict(**{**item, "runs": tuple(item["runs"])}) for item in items]


def to_markdown(
    verdicts: Sequence[Verdict],
    title: str,
    headings: tuple[str, str],
    summary: str | None = None,
    notes: Sequence[str] = (),
) -> str:
    """Return verdicts as a Markdown document, one table per section.

    The headings are those of names and sentences, and the notes are substitutions for the paper's own ingredients.
    """
    rows = [(verdict.section, _cells(verdict)) for verdict in verdicts]
    summary = summary or tally(verdicts)
    return _document(f"# {title}\n\n{summary}\n", notes, (*headings, "measured", "must be", "why", ""), rows)


def _document(
    head: str, notes: Sequence[str], headings: Sequence[str], rows: Sequence[tuple[str, tuple[str, ...]]]
) -> str:
    """Return a Markdown document with a table of each section; rows are preceded by theirs."""
    lines = [head, *(f"Stand-in: {note}." for note in notes), *([""] if notes else [])]
    for section in dict.fromkeys(section for section, _ in rows):
        table = Table(headings, [cells for place, cells in rows if place == section])
        lines += ([f"## {section}", ""] if section else []) + [table.markdown(numbers=False)]
    return "\n".join(lines)


def verdict_table(verdicts: Sequence[Verdict], title: str, note: str) -> Table:
    """Return verdicts as a table of a report."""
    columns = ("section", "sentence", "measured is", "measured", "must be", "verdict")
    rows = [
        (item.section, marked(item, item.sentence), item.quantity, measured(item), item.threshold, item.verdict)
        for item in verdicts
    ]
    return Table(columns, rows, title, note)


def _cells(verdict: Verdict) -> tuple[str, ...]:
    runs = f"; {', '.join(verdict.runs)}" if verdict.runs else ""
    number_and_quantity = f"**{measured(verdict)}** ({verdict.quantity}{runs})"
    return *_named(verdict), number_and_quantity, verdict.threshold, verdict.why, verdict.verdict


def marked(verdict: Verdict, text: str) -> str:
    """Return a text on a verdict with a mark if the statement tests the simulation alone."""
    return f"{text} (simulation alone)" if verdict.tests_simulation else text


def _named(verdict: Verdict) -> tuple[str, str]:
    """Return the name, marked if it tests the simulation alone, and the sentence with its id."""
    shared = verdict.sentence_id and verdict.sentence_id != verdict.name
    return marked(verdict, verdict.name), f"{verdict.sentence} [{verdict.sentence_id}]" if shared else verdict.sentence


def show_verdicts(
    verdicts: Sequence[Verdict],
    title: str,
    console: Console,
    heading: str = "claim",
    summary: str | None = None,
) -> None:
    """Print verdicts as a table, with the `heading` of the first column, and then those without a number by reason."""
    heading_line = escape(f"{title}: {summary or tally(verdicts)}")
    table = TerminalTable(title=heading_line, title_justify="left", show_lines=True, expand=True)
    for text, ratio in ((heading, 5), ("measured", 4), ("must be", 2)):
        table.add_column(text, ratio=ratio)
    table.add_column("", no_wrap=True)
    lacking: dict[str, list[str]] = {}
    for verdict in verdicts:
        if verdict.verdict == "not evaluated":
            lacking.setdefault(verdict.reason, []).append(verdict.name)
            continue
        tested = f"[bold]{escape(marked(verdict, verdict.name))}[/bold]\n{escape(verdict.sentence)}"
        value = f"{escape(measured(verdict))}\n[dim]{escape(verdict.quantity)}[/dim]"
        table.add_row(tested, value, escape(verdict.threshold), coloured(verdict.verdict))
    console.print(table)
    for reason, names in lacking.items():
        console.print(f"not evaluated: {', '.join(names)}: {reason}", markup=False)


def write_claims(
    verdicts: Sequence[Verdict],
    folder: Path,
    title: str,
    notes: Sequence[str] = (),
    without_role: Sequence[str] = (),
) -> None:
    """Write verdicts to claims.json and claims.md in a folder, with reasons why papers have none, `without_role`."""
    write_text(folder / CLAIMS_JSON, to_json(verdicts) + "\n")
    summary = None if verdicts else "No claims."
    text = to_markdown(verdicts, f"Claims of the paper: {title}", ("claim", "the paper"), summary, notes)
    write_text(folder / CLAIMS_MARKDOWN, "\n".join([text, *without_role]).rstrip() + "\n")


STATEMENT = ("name", "section", "sentence", "sentence_id", "tests_simulation", "quantity", "threshold", "why")
RESULT = ("measured", "uncertainty", "kind", "smallest_effect", "verdict", "runs", "reason")


def write_claims_by_solver(
    columns: Mapping[str, Sequence[Verdict]], folder: Path, title: str, notes: Sequence[str] = ()
) -> None:
    """Write verdicts on the same statements in the same order, by solver, to claims-by-solver.json and .md.

    A statement that could not be evaluated with any solver is left out.
    """
    rows = [row for row in zip(*columns.values(), strict=True) if any(item.measured is not None for item in row)]
    found = []
    for row in rows:
        statement = {name: getattr(row[0], name) for name in STATEMENT}
        results = ({name: getattr(item, name) for name in RESULT} for item in row)
        found.append({**statement, "solvers": dict(zip(columns, results, strict=True))})
    write_text(folder / BY_SOLVER_JSON, _dumped(found) + "\n")
    tallies = "\n".join(f"- {name}: {tally([row[place] for row in rows])}" for place, name in enumerate(columns))
    differing = f"The verdict differs: {', '.join(_differing(rows)) or 'nowhere'}."
    head = f"# Claims of the paper, by solver: {title}\n\n{tallies}\n\n{differing}\n"
    headings = ("claim", "the paper", "measured is", "must be", *(cell for name in columns for cell in (name, "")))
    text = _document(head, notes, headings, [(row[0].section, _cells_by_solver(row)) for row in rows])
    write_text(folder / BY_SOLVER_MARKDOWN, text.rstrip() + "\n")


def _differing(rows: Iterable[Sequence[Verdict]]) -> list[str]:
    """Return the names of the statements that were evaluated with every solver and have different verdicts."""
    evaluated = (row for row in rows if all(item.measured is not None for item in row))
    return [row[0].name for row in evaluated if len({item.verdict for item in row}) > 1]


def _cells_by_solver(row: Sequence[Verdict]) -> tuple[str, ...]:
    first = row[0]
    found = (("-", item.verdict) if item.measured is None else (f"**{measured(item)}**", item.verdict) for item in row)
    return *_named(first), first.quantity, first.threshold, *(cell for pair in found for cell in pair)
