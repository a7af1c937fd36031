"""A measured number, the condition that it must meet, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

Outcome = Literal["PASS", "FAIL", "supported", "contradicted", "undecided", "not evaluated"]
"""PASS and FAIL are for limits of our own; the next three are for statements of others."""
Kind = Literal["error", "scatter", "at least", "at most"]


class Finding(NamedTuple):
    """A measured number with its uncertainty.

    The kind is "error" if that is the standard deviation of the number, "scatter" if it is that of the values whose
    median the number is, and "at least" or "at most" if the number is a bound of the measured quantity.
    """

    value: float
    uncertainty: float
    kind: Kind = "error"


@dataclass(frozen=True)
class Within:
    """From `low` to `high`."""

    low: float
    high: float
    sigmas: ClassVar[float] = 0.0

    def holds(self, finding: Finding) -> bool:
        """Return true if the value is in the interval."""
        return self.low <= finding.value <= self.high

    def __str__(self) -> str:
        return f"from {self.low:.3g} to {self.high:.3g}"


@dataclass(frozen=True)
class AtLeast:
    """At least `low`, by `sigmas` times the uncertainty."""

    low: float
    sigmas: float = 0.0
    high: ClassVar[float] = math.inf

    def holds(self, finding: Finding) -> bool:
        """Return true if the value is that far above the bound."""
        return finding.value - self.sigmas * finding.uncertainty >= self.low

    def __str__(self) -> str:
        return f">= {self.low:.3g}" + (f" by {self.sigmas:g} sigma" if self.sigmas else "")


@dataclass(frozen=True)
class AtMost:
    """At most `high`, by `sigmas` times the uncertainty."""

    high: float
    sigmas: float = 0.0
    low: ClassVar[float] = -math.inf

    def holds(self, finding: Finding) -> bool:
        """Return true if the value is that far below the bound."""
        return finding.value + self.sigmas * finding.uncertainty <= self.high

    def __str__(self) -> str:
        return f"<= {self.high:.3g}" + (f" by {self.sigmas:g} sigma" if self.sigmas else "")


@dataclass(frozen=True)
class Equal:
    """Equal to `target` within `sigmas` times the uncertainty."""

    target: float
    sigmas: float = 2.0

    @property
    def low(self) -> float:
        """The target."""
        return self.target

    @property
    def high(self) -> float:
        """The target."""
        return self.target

    def holds(self, finding: Finding) -> bool:
        """Return true if the value is that close to the target."""
        return abs(finding.value - self.target) <= self.sigmas * finding.uncertainty

    def __str__(self) -> str:
        return f"{self.target:.3g} within {self.sigmas:g} sigma"


Threshold = Within | AtLeast | AtMost | Equal
"""A condition on a measured number: it `holds` from `low` to `high`, and `str` gives its words.

By `sigmas` uncertainties a number must be within it or, for a single value, may deviate."""


@dataclass(frozen=True)
class Verdict:
    """A criterion, evaluated.

    Attributes
    ----------
    name : short and unique
    section, sentence : the tested sentence, and its section
    quantity : the measured quantity, in words
    measured, uncertainty : the number and its uncertainty; None if there is none
    threshold, why : the condition for the number, and the reason for it
    runs : names of the runs that it was measured on
    reason : why there is no number, or empty
    kind : meaning of number and uncertainty, as in `Finding`
    smallest_effect : of an undecided statement: the smallest distance of the number from it that the data could show
    sentence_id : id of the paper's sentence, which may have several statements; empty for criteria of our own
    tests_simulation : true if the number does not depend on a calibration, so that it tests the simulated data alone
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
    kind: Kind = "error"
    smallest_effect: float | None = None
    sentence_id: str = ""
    tests_simulation: bool = False


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
        """Return the verdict on a measured number, which is "not evaluated" if the number is not finite."""
        if not (math.isfinite(finding.value) and math.isfinite(finding.uncertainty)):
            return self.unevaluated("the measured number is not finite", runs)
        return self._verdict(finding, self.outcome(finding), runs, "")

    def outcome(self, finding: Finding) -> Outcome:
        """Return PASS or FAIL for a finite number."""
        return "PASS" if self.threshold.holds(finding) else "FAIL"

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
            kind="error" if finding is None else finding.kind,
        )
