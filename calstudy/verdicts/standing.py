"""Which calibrators can be trusted: the bias of each in all worlds of a comparison, against a limit.

In a band of k, a calibrator

- *passes* in a world if its bias is below the limit by two standard deviations, |bias| + 2 sigma < limit, and T is
  measured,
- *fails* if it is above by two standard deviations, if T is not that of a solution (below -0.1 or above 1.2 by more
  than two standard deviations), if it keeps nothing (T is below 0.05 by two standard deviations: what removes all has
  no bias), or if the calibrator cannot work there,
- is *open* otherwise: the errors of this run are too large to tell, or no solve converged. Without a bias, the measured
  one is about sigma, so that 3 sigma must be below the limit to show it.

It passes the comparison if it passes in all worlds, and fails if it fails in one. The bias and its error are those of
the scores, in units of the EoR.

T is measured where it can be the part of the EoR's power that is left. A T below -0.1 or above 1.2 does not belong to a
calibration that found a solution: noise, interference or a fit that diverged makes such values. With an error above 0.3
the 95 % interval contains most values from 0 to 1. An error is NaN where a bin has a single sample; T is then judged by
its value.

T by injection depends on where two fits stop, and T of the linear response does not. What a calibrator keeps is the
linear response where that is lower by more than the error of T.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from calstudy.base.table import Table, two_digits

LOWEST, HIGHEST = -0.1, 1.2
LEAST = 0.05
"""A calibrator that keeps less of the EoR keeps nothing."""
LARGEST_ERROR = 0.3
"""Standard deviation above which T is not measured."""


def why_not_measured(transfer: float | None, error: float | None) -> str:
    """Explain in a few words why T is not measured; return an empty text where it is.

    A T or an error that is None is not known.
    """
    if error is not None and error > LARGEST_ERROR:
        return f"error {error:.2g}"
    if transfer is None or math.isnan(transfer):
        return "no modes"
    return "" if LOWEST <= transfer <= HIGHEST else f"T {transfer:.2g}"


def is_measured(transfer: float | None, error: float | None) -> bool:
    """Return whether T is measured."""
    return not why_not_measured(transfer, error)


def marked(text: str, transfer: float | None, error: float | None) -> str:
    """Return T as it is written, in brackets after "not measured" where it is not."""
    return f"not measured ({text})" if why_not_measured(transfer, error) else text


def settled(solves: Mapping[str, int]) -> int:
    """Count the solves that ended at a solution, given their numbers by status."""
    return sum(solves.get(status, 0) for status in SETTLED)


Standing = Literal["passes", "open", "fails"]
WORST = ("fails", "open", "passes")
LIMIT = 0.1
"""Largest tolerated bias, over the EoR."""
SIGMAS = 2.0
AT_LIMIT, OUT_OF_REACH = 1.05, 1000.0
"""Factors by which errors must be smaller to tell: below the first the bias is near the limit; those beyond the second
are not named."""
SETTLED = ("converged", "by-file")
"""Statuses of solves that ended at a solution, as in `calstudy.calibrate.records`."""
NAMED = 3
"""Number of worlds, and of calibrators that fail in few, that are named; others are counted."""
MORE = 0.02
"""By how much T of a calibrator that fails in few worlds must be larger for it to be named."""


def upper_limit(bias: float, error: float) -> float:
    """Return the 95 % upper limit of the size of a bias, from its standard deviation: |bias| + 2 sigma.

    The measured bias is not reduced by its error: a bias of 1.9 standard deviations may as well be 3.9 as zero.
    """
    return abs(bias) + SIGMAS * error


@dataclass(frozen=True)
class InWorld:
    """A calibrator in a band of k and a world, with its numbers of solves by status.

    T and bias are NaN where they are not known, or it cannot work.
    """

    world: str
    transfer: float = math.nan
    transfer_error: float = math.nan
    bias: float = math.nan
    bias_error: float = math.nan
    linear_transfer: float = math.nan
    refused: bool = False
    solves: Mapping[str, int] = field(default_factory=dict)

    def standing(self, limit: float) -> Standing:
        """Return whether the bias is below the limit."""
        if self.refused or self._is_no_solution or self._keeps_nothing:
            return "fails"
        # With NaN, no comparison is true.
        if abs(self.bias) - SIGMAS * self.bias_error > limit:
            return "fails"
        known = is_measured(self.transfer, self.transfer_error) and self.has_solution
        return "passes" if known and self.upper_limit < limit else "open"

    @property
    def has_solution(self) -> bool:
        """Whether a solve ended at a solution, as far as is known."""
        return not self.solves or settled(self.solves) > 0

    @property
    def kept(self) -> float:
        """T, or that of the linear response where it is lower by more than the error of T; NaN if T is not measured."""
        if not is_measured(self.transfer, self.transfer_error):
            return math.nan
        # With NaN, no comparison is true.
        return self.linear_transfer if self.transfer - self.linear_transfer > self.transfer_error else self.transfer

    @property
    def _is_no_solution(self) -> bool:
        margin = SIGMAS * self.transfer_error
        return self.transfer + margin < LOWEST or self.transfer - margin > HIGHEST

    @property
    def _keeps_nothing(self) -> bool:
        return self.kept + SIGMAS * self.transfer_error < LEAST

    @property
    def upper_limit(self) -> float:
        """Size of the bias that is excluded with 95 %."""
        return upper_limit(self.bias, self.bias_error)

    @property
    def reason(self) -> str:
        """The world with the number for which a calibrator fails there."""
        if self.refused:
            return f"{self.world} (cannot work)"
        name, value = "bias", self.bias
        if self._is_no_solution or self._keeps_nothing:
            name, value = "T", self.transfer if self._is_no_solution else self.kept
        return f"{self.world} ({name} {two_digits(value)})"


@dataclass(frozen=True)
class InBand:
    """A calibrator in a band of k, h/Mpc, and all worlds."""

    calibrator: str
    band: tuple[float, float]
    worlds: Sequence[InWorld]
    limit: float = LIMIT

    @property
    def standing(self) -> Standing:
        """The worst of all worlds."""
        found = [world.standing(self.limit) for world in self.worlds]
        return min(found, key=WORST.index)

    @property
    def transfer(self) -> float:
        """The smallest part of the EoR that is kept in a world, of all where T is measured."""
        return min(self._measured, default=math.nan)

    @property
    def _measured(self) -> list[float]:
        return [world.kept for world in self.worlds if not math.isnan(world.kept)]

    @property
    def kept(self) -> str:
        """The smallest T, and in how many worlds T is measured if that is not in all."""
        known, n_worlds = len(self._measured), len(self.worlds)
        where = f" where measured, {known} of {n_worlds} worlds" if known < n_worlds else ""
        return f"T ≥ {self.transfer:.2f}{where}" if known else "T not measured"

    @property
    def decisive(self) -> list[InWorld]:
        """The worlds with the worst standing: refused ones first, then unknown biases, then from the largest bias."""
        found = [world for world in self.worlds if world.standing(self.limit) == self.standing]
        return sorted(found, key=lambda world: (not world.refused, not math.isnan(world.bias), -abs(world.bias)))

    @property
    def upper_limit(self) -> float:
        """The largest upper limit of the bias of all worlds, NaN if it is not known in one."""
        limits = [world.upper_limit for world in self.worlds]
        return max(limits) if all(map(math.isfinite, limits)) else math.nan

    @property
    def numbers(self) -> str:
        """The upper limit of the bias in all worlds, the smallest T, and how many solves of data did not converge."""
        limit = self.upper_limit
        bias = "bias or its error not known" if math.isnan(limit) else f"bias < {two_digits(limit)}"
        count = sum(sum(world.solves.values()) - world.solves.get("skipped", 0) for world in self.worlds)
        rest = count - sum(settled(world.solves) for world in self.worlds)
        return f"{bias}, {self.kept}" + (f", {rest} of {count} solves not converged" if rest else "")

    def __str__(self) -> str:
        decisive = self.decisive
        if self.standing == "passes":
            return f"passes: {self.numbers}"
        if len(self.worlds) > 1 and all(world.refused for world in self.worlds):
            return "cannot work in any world"
        if self.standing == "fails":
            more = f" and {len(decisive) - NAMED} more" if len(decisive) > NAMED else ""
            return f"fails in {', '.join(world.reason for world in decisive[:NAMED])}{more}"
        large = [world.bias_error for world in decisive if not world.upper_limit < self.limit]
        smaller = (SIGMAS + 1) * max(large, default=0.0) / self.limit
        cause = f"errors {smaller:.1f} times smaller would tell" if smaller > AT_LIMIT else "the bias is near the limit"
        cause = f"errors would have to be over {OUT_OF_REACH:g} times smaller" if smaller > OUT_OF_REACH else cause
        unsolved = all(is_measured(world.transfer, world.transfer_error) for world in decisive)
        cause = cause if large else "no solve converged there" if unsolved else "T is not measured there"
        if not all(math.isfinite(world.upper_limit) for world in decisive):
            cause = "a wider band of k, or more baselines, would tell"
        return f"open in {len(decisive)} of {len(self.worlds)} worlds: {self.numbers}; {cause}"


def standings(
    scores: Mapping[str, Mapping[str, Mapping[str, Any]]],
    refusals: Sequence[tuple[str, str, str]] = (),
    limit: float = LIMIT,
) -> list[InBand]:
    """Return the verdict on every calibrator in every band of k, band by band.

    Scores are by world and calibrator, as in comparison.json; refusals are world, calibrator and reason of those that
    cannot work. The limit is the largest tolerated bias, over the EoR.
    """
    refused = dict.fromkeys((world, calibrator) for world, calibrator, _ in refusals if world in scores)
    scored = [name for cases in scores.values() for name in cases]
    calibrators = dict.fromkeys([*scored, *(calibrator for _, calibrator in refused)])
    summaries = [summary for cases in scores.values() for summary in cases.values()]
    bands = dict.fromkeys(tuple(band["k"]) for summary in summaries for band in summary["bands"])
    found = []
    for band, name in itertools.product(bands, calibrators):
        rows: list[InWorld] = []
        for world, cases in scores.items():
            if name in cases:
                solves, entries = cases[name].get("by_status", {}), cases[name]["bands"]
                rows += [_in_world(world, entry, solves) for entry in entries if tuple(entry["k"]) == band]
            elif (world, name) in refused:
                rows.append(InWorld(world, refused=True))
        if rows:
            found.append(InBand(name, band, rows, limit))
    return found


def _in_world(world: str, band: Mapping[str, Any], solves: Mapping[str, int]) -> InWorld:
    names = ("transfer", "transfer_error", "bias", "bias_error", "linear_transfer")
    found: dict[str, Any] = {name: math.nan if band.get(name) is None else band[name] for name in names}
    return InWorld(world, solves=solves, **found)


def advice(found: Sequence[InBand]) -> list[str]:
    """Return the question, and for each band of k which calibrator to take and what would break it first."""
    n_worlds = len({world.world for entry in found for world in entry.worlds})
    where = f"all {n_worlds} worlds" if n_worlds > 1 else "the world"
    sentences = [f"Bias below {found[0].limit:g} of the EoR in {where}?"] if found else []
    for low, high in dict.fromkeys(entry.band for entry in found):
        entries = [entry for entry in found if entry.band == (low, high)]
        sentences.append(f"k {low:g} to {high:g} h/Mpc: {'; '.join(_advice_in_band(entries))}")
    return sentences


def _advice_in_band(entries: Sequence[InBand]) -> list[str]:
    """Name the passing calibrator with the largest T first, then others that pass, are open, or fail in few worlds."""
    ranked = sorted(entries, key=lambda entry: -entry.transfer if math.isfinite(entry.transfer) else math.inf)
    passed, undecided, failed = (
        [entry for entry in ranked if entry.standing == standing] for standing in ("passes", "open", "fails")
    )
    parts, least = ["no calibrator passes"], 0.0
    if passed:
        first, *others = passed
        parts, least = [f"take {first.calibrator} ({first.numbers})"], first.transfer + MORE
        seen = next((found for found in first.decisive if abs(found.bias) > SIGMAS * found.bias_error), None)
        parts.append(f"a bias is seen in {seen.world} ({two_digits(seen.bias)})" if seen else "no bias is seen")
        parts += [f"others that pass: {_listed(others)}"] if others else []
    parts += [f"open: {_listed(undecided)}"] if undecided else []
    tempting = [entry for entry in failed if entry.transfer > least and 2 * len(entry.decisive) <= len(entry.worlds)]
    words = "{} keeps more ({}), but {}" if passed else "{} ({}) {}"
    parts += [words.format(entry.calibrator, entry.kept, entry) for entry in tempting[:NAMED]]
    unnamed = len(failed) > len(tempting[:NAMED])
    return [*parts, f"{len(failed)} of {len(entries)} fail"] if unnamed else parts


def _listed(entries: Sequence[InBand]) -> str:
    return ", ".join(f"{entry.calibrator} ({entry.numbers})" for entry in entries)


def standing_table(found: Sequence[InBand]) -> Table:
    """Return a row for each calibrator, with a column for each band of k."""
    bands = list(dict.fromkeys(entry.band for entry in found))
    cells = {(entry.calibrator, entry.band): str(entry) for entry in found}
    names = dict.fromkeys(entry.calibrator for entry in found)
    limit = found[0].limit if found else LIMIT
    note = (
        f"A calibrator passes if |bias| + {SIGMAS:g}σ is below {limit:g} of the EoR in all worlds, and fails if "
        f"|bias| - {SIGMAS:g}σ is above it in one; otherwise this run cannot tell. T is the smallest of all worlds, "
        "or the linear response where that is lower by more than the error of T. Errors fall with the number of "
        "integrations within power.coherent_time, and with the square of the noise."
    )
    columns = ("calibrator", *(f"k {low:g} to {high:g} h/Mpc" for low, high in bands))
    rows = [(name, *(cells.get((name, band), "-") for band in bands)) for name in names]
    return Table(columns, rows, "Which calibrator to trust", note)
