"""The headline of a report: its most important numbers."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

from calstudy.base.errors import InputError
from calstudy.verdicts.criterion import Verdict
from calstudy.verdicts.sentences import counts, outcomes_of_sentences
from calstudy.verdicts.tables import from_json

BAND = (0.2, 0.5)
"""Wavenumbers of the headline, h/Mpc: beyond the wedge of short baselines, where sensitivity is highest."""
PLACE = f"outside the wedge, k of {BAND[0]:g} to {BAND[1]:g} h/Mpc"
SIGNIFICANT = 5.0
"""Standard deviations of the thermal noise below which a bias may be noise."""
TINY = 1e-9


@dataclass(frozen=True)
class Number:
    """A name, the number as text, and a sentence that explains it."""

    name: str
    text: str
    meaning: str


@dataclass(frozen=True)
class Signal:
    """EoR and other power that is left outside the wedge, in the band of the headline.

    The transfer is the fraction of the EoR's power that is left; the bias is the power of the residual without EoR
    over that of the EoR, with its error from the thermal noise. Both are free of the flux scale of the calibrated
    data.
    """

    transfer: float
    transfer_error: float
    bias: float
    bias_error: float
    scale: float

    @property
    def numbers(self) -> list[Number]:
        """The same numbers as text."""
        left = f"part of the EoR's power that is left, {PLACE}"
        bias = (
            f"power of the residual without EoR over that of the EoR, {PLACE}; the error is that of the thermal noise"
        )
        return [
            Number("T", _with_error(self.transfer, self.transfer_error), left),
            Number("bias", _with_error(self.bias, self.bias_error), bias),
            Number("flux scale", f"{self.scale:.4f}", "of the calibrated data; T and bias are free of it"),
        ]

    @property
    def excess(self) -> str | None:
        """A warning if the bias exceeds the EoR by more than the noise explains; else None."""
        if abs(self.bias) < 1 or abs(self.bias) < SIGNIFICANT * self.bias_error:
            return None
        return (
            f"{PLACE}, the residual without EoR has {_rounded(abs(self.bias))} times the power of the EoR: "
            "its power spectrum says nothing of the EoR there"
        )


def read_headline(folder: Path) -> list[Number]:
    """Return T, bias and flux scale of the folder of a finished run, and counts of its claims, if it has them."""
    signal = read_signal(folder)
    numbers = [] if signal is None else signal.numbers
    verdicts = _verdicts(folder / "claims.json")
    return [*numbers, *([] if verdicts is None else [verdicts])]


def read_excess(folder: Path) -> list[str]:
    """Return the warning of a run folder whose bias exceeds the EoR; usually none."""
    signal = read_signal(folder)
    return [] if signal is None or signal.excess is None else [signal.excess]


def read_signal(folder: Path) -> Signal | None:
    """Return T and bias of a run folder, or None if it has no such tables or no bins in the band."""
    tables = folder / "tables"
    transfer = tables / "transfer-bands.outside-wedge.csv"
    paths = [tables / f"{name}.outside-wedge.csv" for name in ("eor", "residual_without_eor")]
    if not all(path.is_file() for path in (transfer, *paths)):
        return None
    eor, residual = (_rows(path) for path in paths)
    weights, products, variances = [], [], []
    scale = math.nan
    for band in _rows(transfer):
        low, high, value = band["k from [h/Mpc]"], band["k to [h/Mpc]"], band["transfer without flux scale"]
        if low >= BAND[0] - TINY and high <= BAND[1] + TINY and math.isfinite(value):
            scale = band["flux scale"]
            weights.append(_sums(eor, low, high)[0])
            products.append(weights[-1] * value)
            variances.append((weights[-1] * band["transfer without flux scale error"]) ** 2)
    signal, _ = _sums(eor, *BAND)
    left, error = _sums(residual, *BAND)
    if not weights or sum(weights) == 0 or signal == 0:
        return None
    mean, spread = sum(products) / sum(weights), math.sqrt(sum(variances)) / sum(weights)
    # As in the score of a comparison: calibration multiplies powers by 1 / s^2.
    unit = signal / scale**2
    return Signal(mean, spread, left / unit, error / abs(unit), scale)


def _sums(rows: list[dict[str, float]], low: float, high: float) -> tuple[float, float]:
    """Return the sum of power times modes over bins with low <= k < high, and its error from the noise."""
    total = variance = 0.0
    for row in rows:
        power, modes = row["power real [mK2 h-3 Mpc3]"], row["modes"]
        if low - TINY <= row["k [h/Mpc]"] < high - TINY and math.isfinite(power):
            total += modes * power
            variance += (modes * row["noise error [mK2 h-3 Mpc3]"]) ** 2
    return total, math.sqrt(variance)


def read_claims(path: Path) -> list[Verdict]:
    """Return the verdicts of a claims.json; raises InputError if it is damaged."""
    try:
        return from_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError, KeyError):
        raise InputError(f"{path}: is damaged; write it again: calstudy claims {path.parent}") from None


def _verdicts(path: Path) -> Number | None:
    if not path.is_file():
        return None
    outcomes = list(outcomes_of_sentences(read_claims(path)).values())
    evaluated = counts(outcome for outcome in outcomes if outcome != "not evaluated")
    meaning = f"sentences of the papers; {len(outcomes)} in all, the others were not evaluated"
    return Number("claims", evaluated, meaning) if evaluated else None


def _with_error(value: float, error: float) -> str:
    digits = max(0, 1 - math.floor(math.log10(error))) if 0 < error < 10 else 0
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def _rounded(value: float) -> str:
    """Write a ratio with two digits, without an exponent."""
    return f"{float(f'{value:.2g}'):,.10g}"


def _rows(path: Path) -> list[dict[str, float]]:
    with path.open(newline="", encoding="utf-8") as file:
        return [{name: float(text) for name, text in row.items()} for row in csv.DictReader(file)]
