"""Bins in which P^R can be divided by T: enough of the EoR is left, and most of what is left is the EoR at this k.

T is the power of the response D to the EoR S over P^S, whatever D contains. C is the part of S that D contains
(`calstudy.power.transfer`). A projection of a white S has T = C. T - C is power from elsewhere: gain errors, or weights
that vary between channels, multiply the EoR in frequency, and leak power of other delays into this one. Such power
measures P(k') at those delays. Divided by T, it is the EoR at k only if the EoR has the same ratio of P(k') to P(k) as
the simulated one that gave T. The simulated ones are flat, which alone makes their quotients right. A result is
therefore given only where

- T is above five times its error; otherwise there is nothing to correct;
- C is above five times its error, for a leak correlates with S by chance. Errors are often from four draws, and
  deviations over them have the wide tails of Student's t: with three degrees of freedom 3 % are above three errors, and
  0.8 % above five;
- C is above half of T: more than half of the power behaves as under a projection. Errors of C fall with every
  realization, and a C of a tenth of T becomes significant, but the leak in P^R / T does not decrease.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

LEAST_SIGNIFICANCE = 5.0
LEAST_SHARE = 0.5


def _significant(values: ArrayLike, errors: ArrayLike) -> np.ndarray:
    """Return where values are above `LEAST_SIGNIFICANCE` times their errors; False where an error is not known."""
    return np.asarray(values) > LEAST_SIGNIFICANCE * np.asarray(errors)


def correctable(
    transfer: np.ndarray, transfer_error: np.ndarray, cross_transfer: np.ndarray, cross_transfer_error: np.ndarray
) -> np.ndarray:
    """Return where P^R can be divided by T, bool; T, C and their errors have the same shape."""
    own = _significant(cross_transfer, cross_transfer_error) & (cross_transfer > LEAST_SHARE * transfer)
    return _significant(transfer, transfer_error) & own


def why_not(transfer: float, transfer_error: float, cross_transfer: float, cross_transfer_error: float) -> str:
    """Explain in one sentence why P^R cannot be divided by T; return an empty text where it can."""
    if not _significant(transfer, transfer_error):
        return f"T = {transfer:.2f} is not above {LEAST_SIGNIFICANCE:g} times its error, {transfer_error:.2g}"
    if not _significant(cross_transfer, cross_transfer_error):
        return (
            f"C = {cross_transfer:.2g} is not above {LEAST_SIGNIFICANCE:g} times its error, "
            f"{cross_transfer_error:.2g}: nothing that is left is known to be the EoR at this k"
        )
    if not cross_transfer > LEAST_SHARE * transfer:
        return (
            f"C = {cross_transfer:.2g} is not above {LEAST_SHARE:g} T, T = {transfer:.2f}: most of the power is from "
            "elsewhere"
        )
    return ""
