"""Results of a calibration: gains, model and residual in standard formats, and a record of every solve."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.calibrate.interface import SETTLED

if TYPE_CHECKING:
    from pyuvdata import UVCal, UVData


@dataclass(frozen=True, kw_only=True, eq=False)
class SolveRecord:
    """The record of one solve; other fields are as in `calstudy.calibrate.solution.Solution`.

    Attributes
    ----------
    integration
        Index of the first integration.
    n_integrations
        Number of consecutive integrations that were solved together.
    time
        Julian date of the first.
    polarization
        Polarization number of the AIPS convention, such as -5 for XX.
    n_steps
        None if the calibrator does not iterate.
    cpu_seconds
        None if unknown: records of earlier versions lack it.
    peak_memory
        Largest resident memory of the process during the solve, bytes.
    diagnostics
        Further diagnostics of the calibrator, JSON-able, by name.
    """

    integration: int
    n_integrations: int
    time: float
    polarization: int
    status: str
    message: str
    n_steps: int | None
    loss_history: np.ndarray
    seconds: float
    cpu_seconds: float | None
    newton_decrement: float
    decrement_rms: float
    peak_memory: int
    diagnostics: Mapping[str, Any] = field(default_factory=dict)

    def summary(self) -> dict[str, Any]:
        """Return all fields as plain JSON types."""
        losses = self.loss_history
        return {
            "integration": self.integration,
            "n_integrations": self.n_integrations,
            "time": self.time,
            "polarization": self.polarization,
            "status": self.status,
            "message": self.message,
            "n_steps": self.n_steps,
            "first_loss": _number(losses[0]) if losses.size else None,
            "last_loss": _number(losses[-1]) if losses.size else None,
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "newton_decrement": _number(self.newton_decrement),
            "decrement_rms": _number(self.decrement_rms),
            "peak_memory": self.peak_memory,
            **({"diagnostics": dict(self.diagnostics)} if self.diagnostics else {}),
            "loss_history": [_number(loss) for loss in losses],
        }


def _number(value: float) -> float | None:
    """Return a float for JSON, None if it is not finite."""
    return float(value) if np.isfinite(value) else None


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """The result of `calstudy.calibrate.execution.run_calibrator`.

    Attributes
    ----------
    gains
        Gains g of each antenna, channel and integration, gain convention ``divide``: V = g_a g_b* m. Flagged where
        an antenna has no data in a channel, and where a solve was skipped or failed; unity there.
    model
        The intrinsic foregrounds F, in the unit of the data.
    residual
        R = V / (g_a g_b*) - F, zero where flagged.
    solutions
        One record per solve, polarization by polarization, each in the order of time.
    """

    gains: UVCal
    model: UVData
    residual: UVData
    solutions: tuple[SolveRecord, ...]

    @property
    def unconverged(self) -> tuple[SolveRecord, ...]:
        """The solves that did not reach the minimum."""
        return tuple(record for record in self.solutions if record.status not in SETTLED)

    def summary(self) -> dict[str, Any]:
        """Return the number of solves by status, total seconds, and every record, as plain JSON types."""
        statuses = [record.status for record in self.solutions]
        return {
            "solves": len(statuses),
            "by_status": {status: statuses.count(status) for status in sorted(set(statuses))},
            "seconds": sum(record.seconds for record in self.solutions),
            "records": [record.summary() for record in self.solutions],
        }
