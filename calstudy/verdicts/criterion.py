"""A measured number, the condition that it must meet, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

Outcome = Literal["PASS", "FAIL", "not evaluated"]


class Finding(NamedTuple):
    """A measured number and its uncertainty: one standard deviation, or the scatter that the quantity names."""

    value: float
    uncertainty: float


class Threshold(Protocol):
    """The condition on a measured number; `str` puts it into words."""

    def holds(self, finding: Finding) -> bool:
        """Return whether the number meets it."""


@dataclass(frozen=True)
class Within:
    """From `low` to `high`."""

    low: float
    high: float

    def holds(self, finding: Finding) -> bool:
        """Return whether the value is in the interval."""
        return self.low <= finding.value <= self.high

    def __str__(self) -> str:
        return f"from {self.low:.3g} to {self.high:.3g}"


@dataclass(frozen=True)
class AtLeast:
    """At least `bound`, by `sigmas` times the uncertainty."""

    bound: float
    sigmas: float = 0.0

    def holds(self, finding: Finding) -> bool:
        """Return whether the value is that far above the bound."""
        return finding.value - self.sigmas * finding.uncertainty >= self.bound

    def __str__(self) -> str:
        return f">= {self.bound:.3g}" + (f" by {self.sigmas:g} sigma" if self.sigmas else "")


@dataclass(frozen=True)
class AtMost:
    """At most `bound`, by `sigmas` times the uncertainty."""

    bound: float
    sigmas: float = 0.0

    def holds(self, finding: Finding) -> bool:
        """Return whether the value is that far below the bound."""
        return finding.value + self.sigmas * finding.uncertainty <= self.bound

    def __str__(self) -> str:
        return f"<= {self.bound:.3g}" + (f" by {self.sigmas:g} sigma" if self.sigmas else "")


@dataclass(frozen=True)
class Equal:
    """Equal to `target` within `sigmas` times the uncertainty."""

    target: float
    sigmas: float = 2.0

    def holds(self, finding: Finding) -> bool:
        """Return whether the value is that close to the target."""
        return abs(finding.value - self.target) <= self.sigmas * finding.uncertainty

    def __str__(self) -> str:
        return f"{self.target:.3g} within {self.sigmas:g} sigma"


@dataclass(frozen=True)
class Verdict:
    """A criterion, evaluated.

    Attributes
    ----------
    name
        Short and unique.
    section, sentence
        Where the sentence stands that is tested, and the sentence.
    quantity
        What is measured, in words.
    measured, uncertainty
        The number and its uncertainty; None if there is none.
    threshold, why
        The condition that the number must meet, and why that condition.
    verdict
        Whether it meets it.
    runs
        Names of the runs that it was measured on.
    reason
        Why there is no number, or empty.
    """

    name: str
    section: str
    sentence: str
    quantity: str
    measured: float | None
    uncertainty: float | None
    threshold: str
    why: str
    verdict: Outcome
    runs: tuple[str, ...]
    reason: str


@dataclass(frozen=True)
class Criterion:
    """A condition on a number that is to be measured; fields as in `Verdict`."""

    name: str
    section: str
    sentence: str
    quantity: str
    threshold: Threshold
    why: str

    def judge(self, finding: Finding, runs: Sequence[str] = ()) -> Verdict:
        """Return PASS or FAIL for a measured number; one that is not finite is not evaluated."""
        if not (math.isfinite(finding.value) and math.isfinite(finding.uncertainty)):
            return self.unevaluated("the measured number is not finite", runs)
        return self._verdict(finding, "PASS" if self.threshold.holds(finding) else "FAIL", runs, "")

    def unevaluated(self, reason: str, runs: Sequence[str] = ()) -> Verdict:
        """Return the verdict "not evaluated", with the reason."""
        return self._verdict(None, "not evaluated", runs, reason)

    def _verdict(self, finding: Finding | None, outcome: Outcome, runs: Sequence[str], reason: str) -> Verdict:
        return Verdict(
            name=self.name,
            section=self.section,
            sentence=self.sentence,
            quantity=self.quantity,
            measured=None if finding is None else float(finding.value),
            uncertainty=None if finding is None else float(finding.uncertainty),
            threshold=str(self.threshold),
            why=self.why,
            verdict=outcome,
            runs=tuple(runs),
            reason=reason,
        )
