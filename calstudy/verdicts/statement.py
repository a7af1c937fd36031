"""A sentence of a paper as a criterion, with the function that measures it on runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from calstudy.base.errors import InputError
from calstudy.verdicts.criterion import Criterion, Equal, Finding, Outcome, Threshold, Verdict

SIGMAS = 2.0
"""Half the width of a 95 % interval, in standard deviations."""
LAST_DIGIT = 1e-9
"""Fraction of that half width below which a difference is rounding."""


class Unevaluated(InputError):
    """A statement cannot be evaluated on a run, or a table is not there; the message says what is missing."""


@dataclass(frozen=True)
class Sentence:
    """A sentence of a paper to which several statements belong, and a short name for it."""

    id: str
    text: str


@dataclass(frozen=True)
class Statement(Criterion):
    """A sentence of a paper, and the function that measures it.

    It is supported if the 95 % interval of the number lies within the threshold, contradicted if it lies outside,
    and undecided if it has parts of both. A bound is an interval that is open to one side. The scatter of values is
    not an error of their median, and widens the interval only by the sigmas of the threshold.

    `measure` measures the number on the runs that play `roles`, in their order, and `pooled` on runs that pool
    realizations, or is None if the number exists only for single runs. The section is that of the paper; `sentence_id`
    and `tests_simulation` are as in `Verdict`.
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
        # An interval that ends at a limit does not depend on rounding.
        least, most, digit = self.threshold.low, self.threshold.high, LAST_DIGIT * self._margin(finding)
        if least <= low + digit and high - digit <= most:
            return "supported"
        return "contradicted" if high < least - digit or low > most + digit else "undecided"

    def _margin(self, finding: Finding) -> float:
        """Return the half width of the interval around the number."""
        sigmas = self.threshold.sigmas
        return finding.uncertainty * (sigmas if finding.kind == "scatter" else max(sigmas, SIGMAS))

    def _verdict(self, finding: Finding | None, outcome: Outcome, runs: Sequence[str], reason: str) -> Verdict:
        verdict = super()._verdict(finding, outcome, runs, reason)
        if isinstance(self.threshold, Equal):
            # No interval lies within a single number.
            exact = f"exactly {self.threshold.target:.3g}, which errors can only contradict"
            verdict = replace(verdict, threshold=exact)
        undecided = finding is not None and outcome == "undecided" and finding.kind in ("error", "scatter")
        return replace(
            verdict,
            smallest_effect=float(self._margin(finding)) if finding is not None and undecided else None,
            sentence_id=self.sentence_id,
            tests_simulation=self.tests_simulation,
        )

    def evaluate(self, runs: Mapping[str, Any], roles: Mapping[str, str]) -> Verdict:
        """Return the verdict on runs, which have a `name`, by the roles that they play.

        It is "not evaluated" if a role is not played; the reason contains the description of the role in `roles`.
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
    """The section of a paper with some statements, and the roles of their runs.

    `tests_simulation` is as in `Verdict`.
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

        A sentence of the paper with several statements is a `Sentence`. Roles of the runs that the function takes are
        by default those of the source; all else is as in `Statement`.
        """

        def make(measure: Callable[..., Finding]) -> Statement:
            name = measure.__name__.replace("_", "-")
            known = sentence if isinstance(sentence, Sentence) else Sentence(name, sentence)
            stated = (name, self.section, known.text, quantity, threshold, why)
            return Statement(*stated, roles or self.roles, measure, known.id, self.tests_simulation, pooled)

        return make
