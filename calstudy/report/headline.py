"""The headline of a report: its most important numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calstudy.base.table import number, two_digits
from calstudy.power.score import HEADLINE_BAND
from calstudy.products.files import SCORE
from calstudy.results.reader import RunFolder
from calstudy.verdicts.standing import SIGMAS, marked, why_not_measured
from calstudy.verdicts.statement import Unevaluated
from calstudy.verdicts.tables import counts, outcomes_of_sentences

MEASURED_BAND = (0.3, 0.5)
"""The same for measured data, whose T is in other bands."""
PLACE = f"outside the wedge, k of {HEADLINE_BAND[0]:g} to {HEADLINE_BAND[1]:g} h/Mpc"


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
    over that of the EoR. Both are free of the flux scale of the calibrated data, and are the scores of the run, with
    errors from leaving out antennas.
    """

    transfer: float
    transfer_error: float
    bias: float
    bias_error: float
    scale: float
    linear_transfer: float | None

    @property
    def numbers(self) -> list[Number]:
        """The same numbers as text."""
        pair = (self.transfer, self.transfer_error)
        transfer = marked(number(*pair), *pair)
        left = f"part of the EoR's power that is left, {PLACE}"
        if self.linear_transfer is not None:
            transfer += f" (linear response of the fit {self.linear_transfer:.3f})"
            left += "; the linear response of the fit says what must be left"
        bias = f"power of the residual without EoR over that of the EoR, {PLACE}; errors by leaving out antennas"
        return [
            Number("T", transfer, left),
            Number("bias", number(self.bias, self.bias_error), bias),
            Number("flux scale", f"{self.scale:.4f}", "of the calibrated data; T and bias are free of it"),
        ]

    @property
    def excess(self) -> str | None:
        """A warning if the bias exceeds the EoR by more than the noise explains, or by an unknown error; else None."""
        if not abs(self.bias) - SIGMAS * np.nan_to_num(self.bias_error) > 1:
            return None
        return (
            f"{PLACE}, the residual without EoR has {two_digits(abs(self.bias))} times the power of the EoR: "
            "its power spectrum says nothing of the EoR there"
        )


def read_headline(run: RunFolder) -> list[Number]:
    """Return T, bias and flux scale of a finished run, or the fit to measured data, and counts of its claims."""
    signal = read_signal(run)
    numbers = measured_numbers(run) if signal is None else signal.numbers
    outcomes = list(outcomes_of_sentences(run.claims).values())
    if evaluated := counts(outcome for outcome in outcomes if outcome != "not evaluated"):
        meaning = f"sentences of the papers; {len(outcomes)} in all, the others were not evaluated"
        numbers.append(Number("claims", evaluated, meaning))
    return numbers


def read_signal(run: RunFolder) -> Signal | None:
    """Return T and bias of a run, or None if it has no scores or no EoR in the band."""
    try:
        score = run.tables.score_in_bands
    except Unevaluated:
        return None
    band = int(np.argmin(np.abs(score.bin_edges[:-1] - HEADLINE_BAND[0])))
    bands = run.tables.summary["bands"] if run.tables.has(SCORE) else ()
    linear = next((entry.get("linear_transfer") for entry in bands if entry["k"][0] == score.bin_edges[band]), None)
    columns = (score.transfer, score.transfer_error, score.bias, score.bias_error)
    transfer, transfer_error, bias, bias_error = (float(column[band]) for column in columns)
    signal = Signal(transfer, transfer_error, bias, bias_error, score.flux_scale, linear)
    return signal if math.isfinite(signal.transfer) and math.isfinite(signal.bias) else None


def measured_numbers(run: RunFolder) -> list[Number]:
    """Return the fit and T of measured data, from the notes of their products; empty for other runs."""
    notes = {entry.get("stage"): entry.get("notes", {}) for entry in run.products}
    halves = notes.get("observed-quality", {}).get("chi_squared", {})
    fits = {half: found.get("per_degree_of_freedom") for half, found in halves.items()}
    known = [f"{half} {value:.3f}" for half, value in fits.items() if value is not None]
    numbers = [Number("χ² per degree of freedom", ", ".join(known), "1 for a fit to the noise")] if known else []
    for band in notes.get("observed-transfer", {}).get("transfer", {}).get("outside-wedge", ()):
        if tuple(band["k"]) == MEASURED_BAND and band["error"] is not None:
            # Runs of earlier versions have no reason.
            why = band.get("not_measured") or why_not_measured(band["transfer"], band["error"])
            text = f"not measured ({why})" if why else number(band["transfer"], band["error"])
            low, high = MEASURED_BAND
            left = f"part of an injected EoR's power that is left, outside the wedge, k of {low:g} to {high:g} h/Mpc"
            numbers.append(Number(f"T at k of {low:g} to {high:g} h/Mpc", text, left))
    return numbers
