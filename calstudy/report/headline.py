"""The headline of a report: its most important numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calstudy.base.errors import InputError
from calstudy.results.folder import RunFolder
from calstudy.verdicts.criterion import Verdict
from calstudy.verdicts.sentences import counts, outcomes_of_sentences

BAND = (0.2, 0.5)
"""Wavenumbers of the headline, h/Mpc: beyond the wedge of short baselines, where sensitivity is highest."""
PLACE = f"outside the wedge, k of {BAND[0]:g} to {BAND[1]:g} h/Mpc"
SIGNIFICANT = 5.0
"""Standard deviations below which a bias may be noise."""


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

    @property
    def numbers(self) -> list[Number]:
        """The same numbers as text."""
        left = f"part of the EoR's power that is left, {PLACE}"
        bias = f"power of the residual without EoR over that of the EoR, {PLACE}; errors by leaving out antennas"
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


def read_headline(run: RunFolder) -> list[Number]:
    """Return T, bias and flux scale of a finished run, and counts of its claims, if it has them."""
    signal = read_signal(run)
    numbers = [] if signal is None else signal.numbers
    verdicts = _verdicts(run.claims)
    return [*numbers, *([] if verdicts is None else [verdicts])]


def read_signal(run: RunFolder) -> Signal | None:
    """Return T and bias of a run, or None if it has no scores or no EoR in the band."""
    try:
        score = run.tables.score_in_bands
    except InputError:
        return None
    band = int(np.argmin(np.abs(score.bin_edges[:-1] - BAND[0])))
    signal = Signal(
        float(score.transfer[band]),
        float(score.transfer_error[band]),
        float(score.bias[band]),
        float(score.bias_error[band]),
        score.flux_scale,
    )
    return signal if math.isfinite(signal.transfer) and math.isfinite(signal.bias) else None


def _verdicts(claims: Sequence[Verdict]) -> Number | None:
    outcomes = list(outcomes_of_sentences(claims).values())
    evaluated = counts(outcome for outcome in outcomes if outcome != "not evaluated")
    meaning = f"sentences of the papers; {len(outcomes)} in all, the others were not evaluated"
    return Number("claims", evaluated, meaning) if evaluated else None


def _with_error(value: float, error: float) -> str:
    digits = max(0, 1 - math.floor(math.log10(error))) if 0 < error < 10 else 0
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def _rounded(value: float) -> str:
    """Write a ratio with two digits, without an exponent."""
    return f"{float(f'{value:.2g}'):,.10g}"
