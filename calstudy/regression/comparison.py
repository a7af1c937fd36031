"""Compare the arrays of figures, and the claims, with a reference, one by one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calstudy.claims.computation import COMPUTATION
from calstudy.claims.statement import Claim
from calstudy.regression.tolerances import ROUNDING, Arrays, Drawn, Fixed, Measured, tolerance

Status = Literal["same", "moved", "beyond"]
CLAIM_SIGMAS = 3.0
"""A verdict may change with a number that moved by no more than so many of its uncertainties."""


@dataclass(frozen=True)
class ArrayComparison:
    """One array of a figure against its reference.

    Attributes
    ----------
    figure, name
        Which.
    status
        "same" to rounding, "moved" within the tolerance, or "beyond" it.
    relative
        Largest difference over the largest magnitude of the reference; None if it cannot be told.
    largest, rms, shift
        In σ, see `calstudy.regression.tolerances.Drawn`; None for arrays that are not drawn.
    tolerance, why
        What was allowed, and why.
    told
        What is wrong besides numbers: another shape, an array that is missing or new; or empty.
    """

    figure: str
    name: str
    status: Status
    relative: float | None
    largest: float | None
    rms: float | None
    shift: float | None
    tolerance: str
    why: str
    told: str = ""


@dataclass(frozen=True)
class ClaimComparison:
    """One claim against its reference: verdicts, and measured numbers (None where not evaluated)."""

    name: str
    status: Status
    reference_verdict: str
    verdict: str
    reference: float | None
    measured: float | None
    sigmas: float | None


def compare_figures(reference: Mapping[str, Arrays], made: Mapping[str, Arrays]) -> list[ArrayComparison]:
    """Compare figures, each a mapping of arrays by name, with the reference of the same name.

    A figure or array that only the reference has is beyond any tolerance; one that only the new results have, moved.
    """
    found = []
    for figure in dict.fromkeys([*reference, *made]):
        old, new = reference.get(figure, {}), made.get(figure, {})
        for name in dict.fromkeys([*old, *new]):
            if name not in new:
                anything = isinstance(tolerance(figure, name, old), Measured)
                found.append(_told(figure, name, "moved" if anything else "beyond", "missing"))
            elif name not in old:
                found.append(_told(figure, name, "moved", "new, the reference does not have it"))
            else:
                found.append(compare_array(figure, name, old, new[name]))
    return found


def _told(figure: str, name: str, status: Status, told: str) -> ArrayComparison:
    return ArrayComparison(figure, name, status, None, None, None, None, "", "", told)


def compare_array(figure: str, name: str, reference: Arrays, made: np.ndarray) -> ArrayComparison:
    """Compare one array of a figure.

    Parameters
    ----------
    figure, name
        Which; they decide the tolerance.
    reference
        All reference arrays of the figure, from which error bars are taken.
    made
        The array to compare.
    """
    old = reference[name]
    rule = tolerance(figure, name, reference)
    anything = isinstance(rule, Measured)
    if old.shape != made.shape:
        return _told(figure, name, "moved" if anything else "beyond", f"shape {made.shape}, was {old.shape}")
    if old.dtype.kind not in "fc" or made.dtype.kind not in "fc":
        equal = np.array_equal(old, made)
        told = "" if equal else "different"
        status: Status = "same" if equal else "moved" if anything else "beyond"
        return ArrayComparison(figure, name, status, None, None, None, None, "equal", rule.why, told)
    if not np.array_equal(np.isfinite(old), np.isfinite(made)):
        return _told(figure, name, "moved" if anything else "beyond", "finite in other places")
    relative = _relative(old, made)
    deviations = _deviations(rule, reference, name, made) if isinstance(rule, Drawn) else None
    if relative <= ROUNDING and (deviations is None or deviations[0] <= ROUNDING):
        status = "same"
    elif isinstance(rule, Fixed) or (isinstance(rule, Drawn) and _too_far(rule, deviations)):
        status = "beyond"
    else:
        status = "moved"
    return ArrayComparison(figure, name, status, relative, *(deviations or (None,) * 3), str(rule), rule.why)


def _too_far(rule: Drawn, deviations: tuple[float, float, float]) -> bool:
    largest, rms, shift = deviations
    return largest > rule.largest or rms > rule.rms or abs(shift) > rule.shift


def _relative(old: np.ndarray, made: np.ndarray) -> float:
    finite = np.isfinite(old)
    if not finite.any():
        return 0.0
    difference, scale = np.abs(made[finite] - old[finite]).max(), np.abs(old[finite]).max()
    return float(difference / scale) if scale > 0 else float(difference)


def _deviations(rule: Drawn, reference: Arrays, name: str, made: np.ndarray) -> tuple[float, float, float]:
    """Return the largest, rms and mean deviation in σ of a difference; elements without an error bar are left out."""
    old = reference[name]
    sigma = np.broadcast_to(np.sqrt(2) * rule.error(reference, name), old.shape)
    usable = np.isfinite(old) & np.isfinite(sigma) & (sigma > 0)
    difference = made[usable] - old[usable]
    sigma = sigma[usable]
    if name.rpartition(".")[2] == "power":
        difference = difference.real  # The imaginary part of a power estimates nothing.
    elif np.iscomplexobj(difference):
        difference, sigma = np.concatenate([difference.real, difference.imag]), np.concatenate([sigma, sigma])
    if not difference.size:
        return 0.0, 0.0, 0.0
    scaled = difference / sigma
    return (
        float(np.abs(scaled).max()),
        float(np.sqrt(np.mean(scaled**2))),
        float(scaled.mean() * np.sqrt(scaled.size)),
    )


def compare_claims(reference: Sequence[Claim], made: Sequence[Claim]) -> list[ClaimComparison]:
    """Compare claims by name.

    Another verdict is beyond if the number moved by more than three of its uncertainties, or has none; nearer than
    that another draw of the noise changes it as well. So is a claim that is missing, or is no longer evaluated.
    Claims on run time and memory are about a machine, and never beyond for their numbers.
    """
    old, new = ({claim.name: claim for claim in claims} for claims in (reference, made))
    return [_compare_claim(name, old.get(name), new.get(name)) for name in dict.fromkeys([*old, *new])]


def _compare_claim(name: str, old: Claim | None, new: Claim | None) -> ClaimComparison:
    if old is None or new is None:
        status: Status = "moved" if old is None else "beyond"
        verdicts = (old.verdict if old else "new", new.verdict if new else "missing")
        return ClaimComparison(name, status, *verdicts, None, None, None)
    numbers = (old.measured, new.measured)
    machines = old.section == COMPUTATION.section
    if None in numbers:
        evaluated = "moved" if machines and new.measured is not None else "beyond"
        status = "same" if old.verdict == new.verdict else evaluated
        return ClaimComparison(name, status, old.verdict, new.verdict, *numbers, None)
    difference = abs(new.measured - old.measured)
    sigmas = difference / old.uncertainty if old.uncertainty else None
    if old.verdict != new.verdict:
        status = "moved" if machines or (sigmas is not None and sigmas <= CLAIM_SIGMAS) else "beyond"
    else:
        status = "same" if difference <= ROUNDING * max(abs(old.measured), abs(new.measured)) else "moved"
    return ClaimComparison(name, status, old.verdict, new.verdict, *numbers, sigmas)
