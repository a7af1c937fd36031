"""Where T is measured: T is the part of the EoR's power that is left after calibration, and must be able to be that.

- A T below -0.1 or above 1.2 is that of no calibration which ended at a solution: noise, interference or a fit that
  diverged has made it.
- The 95 % interval of a T with an error above 0.3 holds most of 0 to 1, which is known of any T without a measurement.

An error is NaN where a bin has a single sample; T is then judged by its value.
"""

from __future__ import annotations

LOWEST, HIGHEST = -0.1, 1.2
LARGEST_ERROR = 0.3
"""Standard deviation above which T is not measured."""


def is_measured(transfer: float | None, error: float | None) -> bool:
    """Return whether T is measured; a T or an error that is None is not known."""
    return why_not_measured(transfer, error) == ""


def why_not_measured(transfer: float | None, error: float | None) -> str:
    """Explain in a few words why T is not measured; return an empty text where it is."""
    if transfer is None or transfer != transfer:
        return "no modes"
    if error is not None and error > LARGEST_ERROR:
        return f"error {error:.2g}"
    return "" if LOWEST <= transfer <= HIGHEST else f"T {transfer:.2g}"
