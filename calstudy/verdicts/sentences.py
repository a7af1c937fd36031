"""Outcomes of the sentences of papers from the verdicts on their statements, and their counts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from calstudy.verdicts.criterion import Verdict

OUTCOMES = ("supported", "contradicted", "mixed", "undecided", "not evaluated")
"""Outcomes of a sentence; a statement is never mixed."""


def outcomes_of_sentences(verdicts: Iterable[Verdict]) -> dict[str, str]:
    """Return the outcome of each sentence by its id, without statements on the simulation alone.

    It is that of its evaluated statements, and "mixed" if these differ.
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


def _some(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
