"""The solution of one solve."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calstudy.calibrate.interface import USABLE, Status


@dataclass(frozen=True, eq=False)
class Solution:
    """Gains and foreground model of one integration and polarization.

    Attributes
    ----------
    gains
        Shape (Nants, Nfreqs), complex128, dimensionless.
    model
        Intrinsic visibilities F, shape (Nbls, Nfreqs), complex128, in the unit of the data.
    loss_history
        Loss before the first step and after each, shape (n_steps + 1,), in the unit of the data squared.
    status
        ``converged``; ``max-steps`` or ``stalled`` for a usable estimate that is short of the minimum; ``failed`` for
        none; ``skipped`` if there were no data to fit.
    message
        One sentence on why it stopped.
    seconds
        Wall time.
    cpu_seconds
        Processor time of this process over the same time, all threads together, also for solves on a GPU.
    newton_decrement
        Relative Newton decrement, a measure of the distance from the minimum: the decrease of the loss that one more
        Gauss-Newton step is predicted to bring, d^T H^-1 d with the descent direction d and the Gauss-Newton matrix H
        (lambda^2 / 2 of Boyd & Vandenberghe 2004, section 9.5), over the loss. NaN if there is no estimate. To first
        order, this fraction of the power of the residual is due to the early end of the iteration, and orthogonal to
        the residual at the minimum.
    decrement_rms
        Root mean square of that part of the calibrated residual R, in the unit of the data; NaN likewise. Two solves
        that stop at the same point have it in common, and their cross power rises by up to its square.
    """

    gains: np.ndarray
    model: np.ndarray
    loss_history: np.ndarray
    status: Status
    message: str
    n_steps: int
    seconds: float
    cpu_seconds: float
    newton_decrement: float = math.nan
    decrement_rms: float = math.nan

    @property
    def usable(self) -> bool:
        """Whether gains and model are a usable estimate."""
        return self.status in USABLE
