"""Where T is measured: T is the part of the EoR's power that is left after calibration, and must be able to be that.

- A T below -0.1 or above 1.2 does not belong to a calibration that found a solution: noise, interference or a fit that
  diverged makes such values.
- With an error above 0.3 the 95 % interval contains most values from 0 to 1, and nothing is learnt about T.

An error is NaN where a bin has a single sample; T is then judged by its value.
"""

from __future__ import annotations

import math

LOWEST, HIGHEST = -0.1, 1.2
LARGEST_ERROR = 0.3
"""Standard deviation above which T is not measured."""


def is_measured(transfer: float | None, error: float | None) -> bool:
    """Return whether T is measured; a T or an error that is None is not known."""
    return why_not_measured(transfer, error) == ""


def why_not_measured(transfer: float | None, error: float | None) -> str:
    """Explain in a few words why T is not measured; return an empty text where it is."""
    if error is not None and error > LARGEST_ERROR:
        return f"error {error:.2g}"
    if transfer is None or math.isnan(transfer):
        return "no modes"
    return "" if LOWEST <= transfer <= HIGHEST else f"T {transfer:.2g}"


def marked(text: str, transfer: float | None, error: float | None) -> str:
    """Return T as it is written, in brackets after "not measured" where it is not."""
    return f"not measured ({text})" if why_not_measured(transfer, error) else text
