"""The numbers that a reader wants first."""

from __future__ import annotations

import csv
import json
import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

BAND = (0.2, 0.5)
"""Wavenumbers of the headline, h/Mpc: beyond the wedge of short baselines, where sensitivity is highest."""
TINY = 1e-9


@dataclass(frozen=True)
class Number:
    """A name, the number as text, and a sentence that says what it is."""

    name: str
    text: str
    meaning: str


def read_headline(folder: Path) -> list[Number]:
    """Return the numbers of a run folder: T, bias and flux scale, and how many claims hold; as far as there are any.

    Parameters
    ----------
    folder
        Of a finished run.
    """
    return [number for number in (*_signal(folder / "tables"), _verdicts(folder / "claims.json")) if number is not None]


def _signal(tables: Path) -> list[Number | None]:
    transfer = tables / "transfer-bands.outside-wedge.csv"
    paths = [tables / f"{name}.outside-wedge.csv" for name in ("eor", "residual_without_eor")]
    if not all(path.is_file() for path in (transfer, *paths)):
        return []
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
        return []
    mean, spread = sum(products) / sum(weights), math.sqrt(sum(variances)) / sum(weights)
    unit = signal * scale**2
    place = f"outside the wedge, k of {BAND[0]:g} to {BAND[1]:g} h/Mpc"
    bias = f"power of the residual without EoR over that of the EoR, {place}; the error is that of the thermal noise"
    return [
        Number("T", _with_error(mean, spread), f"part of the EoR's power that is left, {place}"),
        Number("bias", _with_error(left / unit, error / abs(unit)), bias),
        Number("flux scale", f"{scale:.4f}", "of the calibrated data; T and bias are free of it"),
    ]


def _sums(rows: list[dict[str, float]], low: float, high: float) -> tuple[float, float]:
    """Return the sum of power times modes over bins with low <= k < high, and its error from the noise."""
    total = variance = 0.0
    for row in rows:
        power, modes = row["power real [mK2 h-3 Mpc3]"], row["modes"]
        if low - TINY <= row["k [h/Mpc]"] < high - TINY and math.isfinite(power):
            total += modes * power
            variance += (modes * row["noise error [mK2 h-3 Mpc3]"]) ** 2
    return total, math.sqrt(variance)


def _verdicts(path: Path) -> Number | None:
    if not path.is_file():
        return None
    counts = Counter(claim["verdict"] for claim in json.loads(path.read_text(encoding="utf-8")))
    if not counts["PASS"] + counts["FAIL"]:
        return None
    text = f"{counts['PASS']} PASS, {counts['FAIL']} FAIL"
    return Number("claims", text, f"statements of the papers; {counts.total()} in all, the others were not evaluated")


def _with_error(value: float, error: float) -> str:
    digits = max(0, 1 - math.floor(math.log10(error))) if 0 < error < 10 else 0
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def _rows(path: Path) -> list[dict[str, float]]:
    with path.open(newline="", encoding="utf-8") as file:
        return [{name: float(text) for name, text in row.items()} for row in csv.DictReader(file)]
