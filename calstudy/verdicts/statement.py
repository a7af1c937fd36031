"""A sentence of a paper as a criterion, with the function that measures it on runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from calstudy.verdicts.criterion import Criterion, Finding, Threshold, Verdict


class Unevaluated(Exception):
    """A statement cannot be evaluated on a run; the message says what is missing."""


@dataclass(frozen=True)
class Statement(Criterion):
    """A sentence of a paper, and how to measure it.

    Attributes
    ----------
    name, section, sentence, quantity, threshold, why
        As in `Criterion`; `section` is that of the paper.
    roles
        The roles of the runs that are compared.
    measure
        Measures the number on the runs that play `roles`, in their order.
    """

    roles: tuple[str, ...]
    measure: Callable[..., Finding]

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
    """The section of a paper that statements stand in, and the roles of the runs that they are about."""

    section: str
    roles: tuple[str, ...]

    def states(
        self, sentence: str, quantity: str, threshold: Threshold, why: str, roles: tuple[str, ...] | None = None
    ) -> Callable[[Callable[..., Finding]], Statement]:
        """Return a decorator that makes a statement of the function that measures it, named after the function.

        Parameters
        ----------
        sentence
            Of the paper, as it stands there.
        quantity
            What is measured, in words.
        threshold
            What it must be.
        why
            Why this threshold.
        roles
            Of the runs that the function takes; by default those of the source.
        """

        def make(measure: Callable[..., Finding]) -> Statement:
            name = measure.__name__.replace("_", "-")
            return Statement(name, self.section, sentence, quantity, threshold, why, roles or self.roles, measure)

        return make
