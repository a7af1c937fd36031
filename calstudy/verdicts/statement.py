"""A sentence of a paper as a criterion, with the function that measures it on runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from calstudy.verdicts.criterion import Criterion, Finding, Outcome, Threshold, Verdict

SIGMAS = 2.0
"""Half the width of a 95 % interval, in standard deviations."""
LAST_DIGIT = 1e-9
"""Of that half width: less is rounding."""


class Unevaluated(Exception):
    """A statement cannot be evaluated on a run; the message says what is missing."""


@dataclass(frozen=True)
class Sentence:
    """A sentence of a paper to which several statements belong, and a short name for it."""

    id: str
    text: str


@dataclass(frozen=True)
class Statement(Criterion):
    """A sentence of a paper, and how to measure it.

    It is supported where the 95 % interval of the number lies within the threshold, contradicted where it lies outside,
    and undecided where it has parts of both. A bound is an interval that is open to one side. The scatter of values is
    no error of their median, and widens the interval only by the sigmas of the threshold.

    Attributes
    ----------
    name, section, sentence, quantity, threshold, why
        As in `Criterion`; `section` is that of the paper.
    roles
        The roles of the runs that are compared.
    measure
        Measures the number on the runs that play `roles`, in their order.
    sentence_id, tests_simulation
        As in `Verdict`.
    pooled
        Measures the number on runs that pool realizations, or None if it is one of single runs alone.
    """

    roles: tuple[str, ...]
    measure: Callable[..., Finding]
    sentence_id: str
    tests_simulation: bool = False
    pooled: Callable[..., Finding] | None = None

    def outcome(self, finding: Finding) -> Outcome:
        """Return "supported", "contradicted" or "undecided" for a finite number."""
        low, high = (finding.value + sign * self._margin(finding) for sign in (-1, 1))
        if finding.kind == "at least":
            high = math.inf
        elif finding.kind == "at most":
            low = -math.inf
        # An interval that ends at a limit does so whatever the last digit.
        least, most, digit = self.threshold.low, self.threshold.high, LAST_DIGIT * self._margin(finding)
        if least <= low + digit and high - digit <= most:
            return "supported"
        return "contradicted" if high < least - digit or low > most + digit else "undecided"

    def _margin(self, finding: Finding) -> float:
        """Return how far the interval reaches on either side of the number."""
        sigmas = self.threshold.sigmas
        return finding.uncertainty * (sigmas if finding.kind == "scatter" else max(sigmas, SIGMAS))

    def _verdict(self, finding: Finding | None, outcome: Outcome, runs: Sequence[str], reason: str) -> Verdict:
        verdict = super()._verdict(finding, outcome, runs, reason)
        undecided = finding is not None and outcome == "undecided" and finding.kind in ("error", "scatter")
        return replace(
            verdict,
            smallest_effect=float(self._margin(finding)) if finding is not None and undecided else None,
            sentence_id=self.sentence_id,
            tests_simulation=self.tests_simulation,
        )

    def evaluate(self, runs: Mapping[str, Any], roles: Mapping[str, str]) -> Verdict:
        """Measure it, or say why it cannot be.

        Parameters
        ----------
        runs
            The runs by the roles that they play; each has a `name`.
        roles
            Which run can play each role, in words.
        """
        missing = [roles[role] for role in self.roles if role not in runs]
        if missing:
            return self.unevaluated(f"needs {' and '.join(missing)}")
        names = tuple(runs[role].name for role in self.roles)
        try:
            return self.judge(self.measure(*(runs[role] for role in self.roles)), names)
        except Unevaluated as obstacle:
            return self.unevaluated(str(obstacle), names)


@dataclass(frozen=True)
class Source:
    """The section of a paper that statements stand in, and what they are about.

    Attributes
    ----------
    section
        Of the paper.
    roles
        Of the runs.
    tests_simulation
        As in `Verdict`.
    """

    section: str
    roles: tuple[str, ...]
    tests_simulation: bool = False

    def states(
        self,
        sentence: str | Sentence,
        quantity: str,
        threshold: Threshold,
        why: str,
        roles: tuple[str, ...] | None = None,
        pooled: Callable[..., Finding] | None = None,
    ) -> Callable[[Callable[..., Finding]], Statement]:
        """Return a decorator that makes a statement of the function that measures it, named after the function.

        Parameters
        ----------
        sentence
            Of the paper, as it stands there; a `Sentence` if other statements belong to it, too.
        quantity
            What is measured, in words.
        threshold
            What it must be.
        why
            Why this threshold.
        roles
            Of the runs that the function takes; by default those of the source.
        pooled
            As in `Statement`.
        """

        def make(measure: Callable[..., Finding]) -> Statement:
            name = measure.__name__.replace("_", "-")
            known = sentence if isinstance(sentence, Sentence) else Sentence(name, sentence)
            stated = (name, self.section, known.text, quantity, threshold, why)
            return Statement(*stated, roles or self.roles, measure, known.id, self.tests_simulation, pooled)

        return make
