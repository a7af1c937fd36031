"""Results of a calibration: the record of every solve, and gains, model and residual as UVCal and UVData."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.files import json_number
from calstudy.base.gains import make_uvcal
from calstudy.base.visibilities import from_cube, polarization_names, positions

if TYPE_CHECKING:
    from pyuvdata import UVCal, UVData

Status = Literal["converged", "max-steps", "stalled", "failed", "skipped", "by-file"]
USABLE: tuple[Status, ...] = ("converged", "max-steps", "stalled", "by-file")
"""Statuses of solves that gave gains; samples of other solves are flagged."""
SETTLED: tuple[Status, ...] = ("converged", "by-file")
"""Statuses that need no warning."""
# The AIPS convention, which UVCal's Jones numbers share.
PARALLEL_HANDS = {-5: "xx", -6: "yy", -1: "rr", -2: "ll"}
NOT_FINITE = ("newton_decrement", "decrement_rms")
"""Numbers of a solve that are null in JSON where they are NaN."""


@dataclass(frozen=True, eq=False)
class Solve:
    """How a solve ended: what a calibrator returns, and the record in ``solution.json``.

    Attributes
    ----------
    status
        ``converged``; ``max-steps`` or ``stalled`` for gains that are usable but short of the minimum; ``failed`` for
        none; ``skipped`` if there were no data to fit; ``by-file`` for gains of another program, of which nothing else
        is known.
    message : one sentence on why it stopped
    steps : steps taken; None if the calibrator does not iterate
    loss_history : the minimized quantity, before the first step and after each
    seconds : wall time; None for an equal share of the whole
    cpu_seconds
        Processor time, all threads together, also of programs that the calibrator starts; None for an equal share of
        the whole.
    newton_decrement
        Relative Newton decrement, a measure of the distance from the minimum: the decrease of the loss that one more
        Gauss-Newton step is predicted to bring, d^T H^-1 d with the descent direction d and the Gauss-Newton matrix H
        (lambda^2 / 2 of Boyd & Vandenberghe 2004, section 9.5), over the loss. NaN if unknown. To first order, this
        fraction of the power of the residual is due to the early end of the iteration, and orthogonal to the residual
        at the minimum.
    decrement_rms
        Root mean square of that part of the calibrated residual R, in the unit of the data; NaN likewise. Two solves
        that stop at the same point have it in common, and their cross power rises by up to its square.
    peak_memory : largest resident memory of the process during the solve, bytes; None for that of the whole
    diagnostics : any other numbers and texts that are worth keeping, JSON-able, by name
    integration, n_integrations
        Index of the first integration, and the number that were solved together. These and the next two are set by
        `calstudy.calibrate.execution.run_calibrator`.
    time : Julian date of the first integration
    polarization : polarization number of the AIPS convention, such as -5 for XX
    """

    status: Status
    message: str
    _: KW_ONLY
    steps: int | None = None
    loss_history: np.ndarray = field(default_factory=lambda: np.empty(0))
    seconds: float | None = None
    cpu_seconds: float | None = None
    newton_decrement: float = np.nan
    decrement_rms: float = np.nan
    peak_memory: int | None = None
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    integration: int = 0
    n_integrations: int = 1
    time: float = np.nan
    polarization: int = 0

    @property
    def usable(self) -> bool:
        """Whether the solve gave gains."""
        return self.status in USABLE

    @property
    def times(self) -> slice:
        """The integrations that were solved together."""
        return slice(self.integration, self.integration + self.n_integrations)

    def summary(self) -> dict[str, Any]:
        """Return all fields as plain JSON types."""
        losses = [json_number(loss) for loss in self.loss_history]
        return {
            **{name: getattr(self, name) for name in ("integration", "n_integrations", "time", "polarization")},
            "status": self.status,
            "message": self.message,
            "n_steps": self.steps,
            "first_loss": losses[0] if losses else None,
            "last_loss": losses[-1] if losses else None,
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            **{name: json_number(getattr(self, name)) for name in NOT_FINITE},
            "peak_memory": self.peak_memory,
            **({"diagnostics": dict(self.diagnostics)} if self.diagnostics else {}),
            "loss_history": losses,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """Return the record of a summary; products of earlier versions have only the first and the last loss."""
        fields = dict(content)
        ends = [fields.pop("first_loss"), fields.pop("last_loss")]
        losses = np.array(fields.pop("loss_history", ends), float)
        numbers = {name: np.nan if fields[name] is None else fields[name] for name in NOT_FINITE}
        return cls(steps=fields.pop("n_steps"), loss_history=losses, **{**fields, **numbers})


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """The result of `calstudy.calibrate.execution.run_calibrator`.

    Attributes
    ----------
    gains
        Gains g of each antenna, channel and integration, gain convention ``divide``: V = g_a g_b* m. Flagged where
        an antenna has no data in a channel of an integration, even if it shares its gain with others, and where a solve
        was skipped or failed; unity there.
    model : the intrinsic foregrounds F, in the unit of the data, times the closure factors c_ab if there are any
    residual : R = V / (c_ab g_a g_b*) - F, zero where flagged
    solutions : one record per solve, polarization by polarization, each in the order of time
    """

    gains: UVCal
    model: UVData
    residual: UVData
    solutions: tuple[Solve, ...]

    def solved_gains(self, solve: Solve, rows: np.ndarray, place: int) -> np.ndarray:
        """Return the gains of a solve, (len(rows), Nfreqs): each of an integration in which it is not flagged.

        Rows are places of antennas, and `place` is that of the polarization. Unity where all integrations are flagged.
        """
        times = solve.times
        gains, flags = (array[rows, :, times, place] for array in (self.gains.gain_array, self.gains.flag_array))
        return np.take_along_axis(gains, flags.argmin(axis=2)[..., None], axis=2)[..., 0]

    def summary(self) -> dict[str, Any]:
        """Return the number of solves by status, total seconds, and every record, as plain JSON types."""
        statuses = [record.status for record in self.solutions]
        return {
            "solves": len(statuses),
            "by_status": {status: statuses.count(status) for status in sorted(set(statuses))},
            "seconds": sum(record.seconds for record in self.solutions),
            "records": [record.summary() for record in self.solutions],
        }


def require_parallel_hands(data: UVData) -> None:
    """Raise InputError unless all polarizations are xx, yy, rr or ll."""
    if not np.isin(data.polarization_array, list(PARALLEL_HANDS)).all():
        found, taken = map(polarization_names, (data.polarization_array, PARALLEL_HANDS))
        raise InputError(f"polarizations: {found}; calibration takes {taken} only")


def make_gains(data: UVData, numbers: np.ndarray, gains: np.ndarray, flags: np.ndarray) -> UVCal:
    """Return gains as a UVCal object for the whole telescope; antennas without data are flagged, with unit gains.

    `numbers` are the antenna numbers of the rows, (Nants,). Gains and flags are (Nants, Nfreqs, Ntimes, Npols).
    """
    known = data.telescope.antenna_numbers
    places = positions(known, numbers)
    everywhere = np.ones((len(known), *gains.shape[1:]), complex)
    nowhere = np.ones(everywhere.shape, bool)
    everywhere[places], nowhere[places] = gains, flags
    return make_uvcal(data, everywhere, nowhere)


def make_visibilities(data: UVData, cube: np.ndarray, flags: np.ndarray) -> UVData:
    """Return a copy of `data` with other visibilities and flags, (Ntimes, Nbls, Nfreqs, Npols)."""
    result = from_cube(data, cube)
    result.flag_array = flags.reshape(result.data_array.shape)
    return result
