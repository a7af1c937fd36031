"""What a claim is: a sentence of the paper, a number that is measured, and what that number must be."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

from calstudy.claims.facts import Role
from calstudy.claims.run_times import RunTimes
from calstudy.claims.study import Study, Unevaluated

Verdict = Literal["PASS", "FAIL", "not evaluated"]
ROLES: dict[Role, str] = {
    "minimally_redundant": "a run of an array that is not redundant, with gains per channel",
    "redundant": "a run of a redundant array, each baseline modelled by itself",
    "redundant_modelling": "a run of the redundant array with one model per group (calibrator: calamity-redundant)",
    "low_snr": "a run with reflection gains",
    "paper_solver": "a run of the minimally redundant array with the paper's solver (solver: adamax)",
    "run_time": "a run of experiments/runtime.yaml",
}
"""The parts that runs play in the paper, and which run can play each."""


class Finding(NamedTuple):
    """A measured number and its uncertainty: one standard deviation, or the scatter that the quantity names."""

    value: float
    uncertainty: float


class Threshold(Protocol):
    """What a number must be for a claim to hold; `str` puts it into words."""

    def holds(self, finding: Finding) -> bool:
        """Return whether it is that."""


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
class Above:
    """At least `bound`, by `sigmas` times the uncertainty."""

    bound: float
    sigmas: float = 0.0

    def holds(self, finding: Finding) -> bool:
        """Return whether the value is that far above the bound."""
        return finding.value - self.sigmas * finding.uncertainty >= self.bound

    def __str__(self) -> str:
        return f">= {self.bound:.3g}" + (f" by {self.sigmas:g} sigma" if self.sigmas else "")


@dataclass(frozen=True)
class Below:
    """At most `bound`, by `sigmas` times the uncertainty."""

    bound: float
    sigmas: float = 0.0

    def holds(self, finding: Finding) -> bool:
        """Return whether the value is that far below the bound."""
        return finding.value + self.sigmas * finding.uncertainty <= self.bound

    def __str__(self) -> str:
        return f"<= {self.bound:.3g}" + (f" by {self.sigmas:g} sigma" if self.sigmas else "")


@dataclass(frozen=True)
class Consistent:
    """Equal to `target` within `sigmas` times the uncertainty."""

    target: float
    sigmas: float = 2.0

    def holds(self, finding: Finding) -> bool:
        """Return whether the value is that close to the target."""
        return abs(finding.value - self.target) <= self.sigmas * finding.uncertainty

    def __str__(self) -> str:
        return f"{self.target:.3g} within {self.sigmas:g} sigma"


@dataclass(frozen=True)
class Claim:
    """A statement of the paper, evaluated.

    Attributes
    ----------
    name
        Short and unique.
    section, sentence
        Where the paper says what.
    quantity
        What is measured, and which reading of the sentence that is.
    measured, uncertainty
        The number and its uncertainty; None if it was not evaluated.
    threshold, why
        What it must be for the claim to hold, and why that.
    verdict
        Whether it holds.
    runs
        Names of the runs that it was measured on.
    reason
        Why it was not evaluated, or empty.
    """

    name: str
    section: str
    sentence: str
    quantity: str
    measured: float | None
    uncertainty: float | None
    threshold: str
    why: str
    verdict: Verdict
    runs: tuple[str, ...]
    reason: str


@dataclass(frozen=True)
class Statement:
    """A statement of the paper, and how to measure it on the runs that play `roles`; fields as in `Claim`."""

    name: str
    section: str
    sentence: str
    quantity: str
    threshold: Threshold
    why: str
    roles: tuple[Role, ...]
    measure: Callable[..., Finding]

    def evaluate(self, studies: Mapping[Role, Study | RunTimes]) -> Claim:
        """Measure it, or say why it cannot be."""
        missing = [ROLES[role] for role in self.roles if role not in studies]
        if missing:
            return self._claim(None, "not evaluated", (), f"needs {' and '.join(missing)}")
        runs = tuple(studies[role].name for role in self.roles)
        try:
            finding = self.measure(*(studies[role] for role in self.roles))
        except Unevaluated as obstacle:
            return self._claim(None, "not evaluated", runs, str(obstacle))
        if not (math.isfinite(finding.value) and math.isfinite(finding.uncertainty)):
            return self._claim(None, "not evaluated", runs, "the measured number is not finite")
        return self._claim(finding, "PASS" if self.threshold.holds(finding) else "FAIL", runs, "")

    def _claim(self, finding: Finding | None, verdict: Verdict, runs: tuple[str, ...], reason: str) -> Claim:
        return Claim(
            name=self.name,
            section=self.section,
            sentence=self.sentence,
            quantity=self.quantity,
            measured=None if finding is None else float(finding.value),
            uncertainty=None if finding is None else float(finding.uncertainty),
            threshold=str(self.threshold),
            why=self.why,
            verdict=verdict,
            runs=runs,
            reason=reason,
        )


@dataclass(frozen=True)
class Source:
    """Where a statement stands."""

    section: str
    roles: tuple[Role, ...]

    def states(
        self, sentence: str, quantity: str, threshold: Threshold, why: str, roles: tuple[Role, ...] | None = None
    ) -> Callable[[Callable[..., Finding]], Statement]:
        """Return a decorator that makes a statement of the function that measures it, named after the function."""

        def make(measure: Callable[..., Finding]) -> Statement:
            name = measure.__name__.replace("_", "-")
            return Statement(name, self.section, sentence, quantity, threshold, why, roles or self.roles, measure)

        return make
