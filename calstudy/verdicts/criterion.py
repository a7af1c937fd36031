"""A measured number, the condition that it must meet, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

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


class Threshold:
    """A condition on a measured number: from `low` to `high`, and `str` gives its words.

    By `sigmas` uncertainties a number must be within it or, for a single value, may deviate.
    """

    low: float
    high: float
    sigmas: float

    def holds(self, finding: Finding) -> bool:
        """Return true if a finite value is in the interval, by that much."""
        margin = self.sigmas * finding.uncertainty if self.sigmas else 0.0
        return self.low <= finding.value - margin and finding.value + margin <= self.high

    def __str__(self) -> str:
        by = f" by {self.sigmas:g} sigma" if self.sigmas else ""
        if math.isinf(self.high):
            return f">= {self.low:.3g}{by}"
        return f"<= {self.high:.3g}{by}" if math.isinf(self.low) else f"from {self.low:.3g} to {self.high:.3g}"


@dataclass(frozen=True)
class Within(Threshold):
    """From `low` to `high`."""

    low: float
    high: float
    sigmas: float = field(default=0.0, init=False)


@dataclass(frozen=True)
class AtLeast(Threshold):
    """At least `low`, by `sigmas` times the uncertainty."""

    low: float
    sigmas: float = 0.0
    high: float = field(default=math.inf, init=False)


@dataclass(frozen=True)
class AtMost(Threshold):
    """At most `high`, by `sigmas` times the uncertainty."""

    high: float
    sigmas: float = 0.0
    low: float = field(default=-math.inf, init=False)


@dataclass(frozen=True)
class Equal(Threshold):
    """Equal to `target` within `sigmas` times the uncertainty."""

    target: float
    sigmas: float = 2.0
    low: float = field(init=False)
    high: float = field(init=False)

    def __post_init__(self) -> None:
        for end in ("low", "high"):
            object.__setattr__(self, end, self.target)

    def holds(self, finding: Finding) -> bool:
        """Return true if the value is that close to the target."""
        return abs(finding.value - self.target) <= self.sigmas * finding.uncertainty

    def __str__(self) -> str:
        return f"{self.target:.3g} within {self.sigmas:g} sigma"


@dataclass(frozen=True)
class Verdict:
    """A criterion, evaluated: its texts, the number with its uncertainty, of the kind of `Finding`, and the outcome.

    `runs` are the names of the runs that it was measured on, and `reason` says why there is no number, or is empty. Of
    an undecided statement, `smallest_effect` is the smallest distance of the number from it that the data could show.
    `sentence_id` is the id of the paper's sentence, which may have several statements, and empty for criteria of our
    own. `tests_simulation` is true if no calibration enters the number, so that it tests the simulated data alone.
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
        value, uncertainty = map(float, finding[:2])
        found = replace(self.unevaluated("", runs), measured=value, uncertainty=uncertainty, kind=finding.kind)
        return replace(found, **self._outcome(finding))

    def _outcome(self, finding: Finding) -> dict[str, Any]:
        """Return PASS or FAIL for a finite number, as a field of its verdict."""
        return {"verdict": "PASS" if self.threshold.holds(finding) else "FAIL"}

    def unevaluated(self, reason: str, runs: Sequence[str] = ()) -> Verdict:
        """Return the verdict "not evaluated", with the reason."""
        texts = (self.name, self.section, self.sentence, self.quantity)
        return Verdict(*texts, None, None, str(self.threshold), self.why, "not evaluated", tuple(runs), reason)
