"""The sentences of papers: what the verdicts on the statements that belong to each say together, and their counts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from calstudy.verdicts.criterion import Verdict

OUTCOMES = ("supported", "contradicted", "mixed", "undecided", "not evaluated")
"""Of a sentence; a statement is never mixed."""


def outcomes_of_sentences(verdicts: Iterable[Verdict]) -> dict[str, str]:
    """Return the outcome of each sentence by its id, statements on the simulation alone left out.

    It is that of its statements that were evaluated, and "mixed" where these differ.
    """
    found: dict[str, set[str]] = {}
    for verdict in verdicts:
        if not verdict.tests_simulation:
            found.setdefault(verdict.sentence_id or verdict.name, set()).add(verdict.verdict)
    return {sentence: _together(outcomes) for sentence, outcomes in found.items()}


def _together(outcomes: set[str]) -> str:
    evaluated = outcomes - {"not evaluated"}
    return "mixed" if len(evaluated) > 1 else next(iter(evaluated or outcomes))


def counts(outcomes: Iterable[str]) -> str:
    """Count outcomes in words, those that there are: ``3 supported, 1 mixed``."""
    found = Counter(outcomes)
    return ", ".join(f"{found[outcome]} {outcome}" for outcome in OUTCOMES if found[outcome])


def tally_of_sentences(verdicts: Sequence[Verdict]) -> str:
    """Count sentences and statements in one line, and apart those statements that test the simulation alone."""
    sentences = outcomes_of_sentences(verdicts)
    parts = []
    for simulated, about in ((False, ""), (True, " on the simulation alone")):
        words = [verdict.verdict for verdict in verdicts if verdict.tests_simulation == simulated]
        if words:
            parts.append(f"{_some(len(words), 'statement')}{about}: {counts(words)}")
    if sentences:
        parts.insert(0, f"{_some(len(sentences), 'sentence')}: {counts(sentences.values())}")
    return "; ".join(parts)


def _some(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
