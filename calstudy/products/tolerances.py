"""The severity of a fault up to which a calibrator's bias is tolerable, from worlds that differ only in the severity.

Worlds with labels such as ``positions: 2 cm`` and ``positions: 5 cm`` are severities of one fault: the text before the
colon is its name, the number after it the severity. The first world without a colon is severity zero of all faults that
have no world of severity zero themselves. Negative numbers, such as levels in dB, are no severities: zero is more.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from astropy import units

from calstudy.base.errors import InputError
from calstudy.verdicts.standing import LIMIT, SIGMAS, upper_limit

COUNTS = 1.0
"""A band of k counts if the upper limit of the bias is below this part of the EoR."""
# A hyphen within a word is no sign, and a full stop within one no decimal point.
_NUMBER = re.compile(r"(?:(?<!\S)[-+])?(?:\d+\.?\d*|(?<![^\s+-])\.\d+)(?:[eE][-+]?\d+)?")


@dataclass(frozen=True)
class Fault:
    """Worlds that differ only in the severity of one fault.

    Labels of worlds and severities are ascending in severity, which is zero for worlds without the fault.
    """

    name: str
    unit: str
    worlds: tuple[str, ...]
    severities: tuple[float, ...]


def faults(worlds: Sequence[str]) -> list[Fault]:
    """Return the faults in the labels of worlds, in their order, each in the unit of its first label.

    Raises InputError if the units of one fault cannot be converted into each other.
    """
    without = [(0.0, world, "") for world in worlds if ":" not in world][:1]
    found: dict[str, list[tuple[float, str, str]]] = {}
    for world in worlds:
        name, colon, severity = world.partition(":")
        severity = severity.strip()
        if colon and (number := _NUMBER.search(severity)) and float(number.group()) >= 0:
            unit, entries = severity[number.end() :].strip(), found.setdefault(name.strip(), [])
            wanted = entries[0][2] if entries else unit
            entries.append((_converted(float(number.group()), unit, wanted, world), world, wanted))
    result = []
    for name, entries in found.items():
        if all(severity == 0 for severity, *_ in entries):
            continue
        own_zero = any(severity == 0 for severity, *_ in entries)
        ordered = sorted(entries if own_zero else [*without, *entries])
        severities, labels, _ = zip(*ordered, strict=True)
        result.append(Fault(name, entries[0][2], labels, severities))
    return result


def _converted(severity: float, unit: str, wanted: str, world: str) -> float:
    """Return a severity in another unit."""
    if unit == wanted:
        return severity
    try:
        return severity * float(units.Unit(unit).to(wanted))
    except (ValueError, units.UnitConversionError):
        raise InputError(f"{world!r} has the unit {unit!r}, and others of this fault have {wanted!r}") from None


@dataclass(frozen=True)
class Tolerance:
    """The severity of a fault at which the bias of a calibrator reaches `LIMIT`.

    Attributes
    ----------
    severity : in the fault's unit; NaN if it is not known
    relation
        ``=``; ``<`` if the bias is above the limit at the lowest severity other than zero; ``>`` if it is below it at
        the highest; ``?`` if the noise is too large to tell.
    """

    severity: float
    relation: str


def tolerance(severities: Sequence[float], bias: np.ndarray, error: np.ndarray) -> Tolerance:
    """Return the severity of a fault at which a bias that grows with it reaches `LIMIT`.

    The bias is a power law between two severities. Severities are ascending, and the first may be zero; `error` is the
    standard deviation of the bias.
    """
    used = [place for place, severity in enumerate(severities) if severity > 0 and np.isfinite(bias[place])]
    reached = [place for place in used if abs(bias[place]) >= LIMIT and abs(bias[place]) >= SIGMAS * error[place]]
    # An error that is not known is unclear too.
    unclear = [place for place in used if place not in reached and not upper_limit(bias[place], error[place]) <= LIMIT]
    if not reached:
        return Tolerance(math.nan, "?") if unclear or not used else Tolerance(float(severities[used[-1]]), ">")
    high = reached[0]
    if min([*unclear, high]) < high or high == used[0]:
        return Tolerance(float(severities[high]), "<")
    low = used[used.index(high) - 1]
    below = max(abs(bias[low]), SIGMAS * error[low], np.finfo(float).tiny)
    part = math.log(LIMIT / below) / math.log(abs(bias[high]) / below)
    return Tolerance(float(severities[low] * (severities[high] / severities[low]) ** part), "=")
