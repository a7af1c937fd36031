"""A sentence of a paper as a criterion, with the function that measures it on runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from calstudy.base.errors import InputError
from calstudy.verdicts.criterion import Criterion, Equal, Finding, Threshold, Verdict

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

    def _outcome(self, finding: Finding) -> dict[str, Any]:
        """Return "supported", "contradicted" or "undecided" for a finite number, and the smallest effect."""
        sigmas = self.threshold.sigmas
        margin = float(finding.uncertainty * (sigmas if finding.kind == "scatter" else max(sigmas, SIGMAS)))
        low = -math.inf if finding.kind == "at most" else finding.value - margin
        high = math.inf if finding.kind == "at least" else finding.value + margin
        # An interval that ends at a limit does not depend on rounding.
        least, most, digit = self.threshold.low, self.threshold.high, LAST_DIGIT * margin
        if least <= low + digit and high - digit <= most:
            return {"verdict": "supported"}
        if high < least - digit or low > most + digit:
            return {"verdict": "contradicted"}
        return {"verdict": "undecided", "smallest_effect": margin if math.isfinite(high - low) else None}

    def unevaluated(self, reason: str, runs: Sequence[str] = ()) -> Verdict:
        """Return the verdict "not evaluated", with the reason."""
        verdict = super().unevaluated(reason, runs)
        # No interval lies within a single number.
        exact = f"exactly {self.threshold.low:.3g}, which errors can only contradict"
        return replace(
            verdict,
            threshold=exact if isinstance(self.threshold, Equal) else verdict.threshold,
            sentence_id=self.sentence_id,
            tests_simulation=self.tests_simulation,
        )

    def evaluate(self, runs: Mapping[str, Any], roles: Mapping[str, str]) -> Verdict:
        """Return the verdict on runs, which have a `name`, by role; the reason names a role of `roles` not played."""
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
    """The section of a paper with some statements, and the roles of their runs; `tests_simulation` as in `Verdict`."""

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
