"""Losses of packets between the boards of a correlator, estimated from gains by hera_cal's skycal, and corrected.

The gains of a fit to baselines between boards are (1 - p_a) times those of the antennas, with the loss p_a of a board,
which is constant in blocks of channels. The gains themselves are smooth, so that the steps between blocks tell the
losses, but for what all blocks of a board have in common.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.observation import Frame, Observation
from calstudy.base.quiet import without_warnings
from calstudy.base.schema import Section
from calstudy.base.units import Delay, Frequency
from calstudy.base.visibilities import channels_per_block
from calstudy.calibrate.interface import Calibration
from calstudy.calibrate.problem import gain_products, sum_by_antenna

LEAST = 3
"""Smallest number of boards: baselines between two leave open how the gains of one compare with those of the other."""


class Boards(Section):
    """Which antennas share a board of the correlator, and which channels a block."""

    per_board: int = Field(3, ge=1, description="How many consecutive antennas of the data share a board.")
    block: Frequency = Field(
        11.71875e6,
        gt=0,
        description="Width of the blocks of channels, from the first on, rounded to whole channels; the default is "
        "HERA's, 96 channels of 122 kHz.",
    )
    smooth_delay: Delay = Field(100e-9, gt=0, description="Up to this delay gains themselves have structure.")
    detection: float = Field(
        2.0,
        ge=0,
        description="Losses below this many of their errors are zero, and shrunk up to 1.5 times as many; the default "
        "is HERA's, for losses that are rare. 0: losses are as fitted.",
    )

    def refusal(self, frame: Frame) -> str | None:
        """Return a sentence if there are too few boards."""
        count = -(-frame.n_antennas // self.per_board)
        if count >= LEAST:
            return None
        return (
            f"boards.per_board: {frame.n_antennas} antennas are on {count} {'board' if count == 1 else 'boards'}, and "
            f"{LEAST} are needed; it must be at most {(frame.n_antennas - 1) // (LEAST - 1)}"
        )

    def within(self, frame: Frame) -> np.ndarray:
        """Whether the antennas of each baseline share a board, bool, (Nbls,)."""
        first, second = frame.antennas.T // self.per_board
        return first == second

    def corrected(
        self, found: Calibration, data: Observation, sky: Observation, groups: Sequence[slice]
    ) -> Calibration:
        """Return a calibration by baselines between boards with the losses taken out of its gains.

        They become the closure factors of the baselines between boards. Data and sky model have the baselines of the
        calibration, which has flags, an outcome for each solve, and gains as an array (Nants, Nfreqs, Ngroups, Npols).
        All solves have failed if the estimate does not converge.
        """
        assert isinstance(found.gains, np.ndarray)
        assert found.gain_flags is not None
        assert isinstance(found.outcomes, Sequence)
        gains = np.where(found.gain_flags, np.nan, found.gains)
        try:
            kept = 1 - self._losses(gains, self._information(gains, data, sky, found, groups), data)
        except RuntimeError as error:
            text = f"hera_cal finds no losses between boards: {error}"
            return replace(found, outcomes=[replace(ended, status="failed", message=text) for ended in found.outcomes])
        closure = np.ones(data.shape)
        between = np.flatnonzero(~self.within(data))
        first, second = data.antennas[between].T
        for number, times in enumerate(groups):
            closure[times, between] = (kept[first, :, number] * kept[second, :, number])[..., None]
        largest = 1 - kept.min(axis=(0, 1))
        outcomes = [
            replace(ended, diagnostics={**ended.diagnostics, "largest_loss": float(largest[place % len(groups)])})
            for place, ended in enumerate(found.outcomes)
        ]
        return replace(found, gains=found.gains / kept[..., None], closure=closure, outcomes=outcomes)

    def _information(
        self, gains: np.ndarray, data: Observation, sky: Observation, found: Calibration, groups: Sequence[slice]
    ) -> np.ndarray:
        """Return the inverse variance of ln|g| of every gain with all others held, zero where there is none.

        The noise of calibrated samples is taken as equal, with the variance of what the fit leaves.
        """
        assert found.flags is not None
        information = np.zeros(gains.shape)
        between = ~self.within(data)
        antennas = data.antennas[between]
        for number, p in np.ndindex(gains.shape[2:]):
            times = groups[number]
            products = gain_products(gains[..., number, p], antennas)
            model = sky.visibilities[times][:, between, :, p]
            used = ~found.flags[times][:, between, :, p] & np.isfinite(products)
            residual = np.where(used, data.visibilities[times][:, between, :, p] / products - model, 0)
            freedom = used.sum() - np.isfinite(gains[..., number, p]).sum()
            power = np.sum(np.where(used, np.abs(model) ** 2, 0), axis=0)
            variance = np.sum(np.abs(residual) ** 2) / max(freedom, 1)
            each = 2 * power / max(variance, np.finfo(float).tiny)
            information[..., number, p] = sum_by_antenna(each, antennas, len(gains))
        return information

    def _losses(self, gains: np.ndarray, information: np.ndarray, frame: Frame) -> np.ndarray:
        """Return the loss of the board of each antenna, (Nants, Nfreqs, Ngroups); zero where there is no estimate."""
        from hera_cal.skycal import estimate_SNAP_decoherence

        channels = channels_per_block(frame.frequencies, self.block)
        boards = np.arange(len(gains)) // self.per_board
        names = [(a, f"J{p}") for a in range(len(gains)) for p in range(gains.shape[3])]
        spectra, weights = ({(a, feed): v[a, :, :, int(feed[1:])].T for a, feed in names} for v in (gains, information))
        try:
            with without_warnings():
                found, _ = estimate_SNAP_decoherence(
                    spectra,
                    weights,
                    dict(enumerate(boards.tolist())),
                    frame.frequencies,
                    nchans_per_block=channels,
                    gain_smoothing_scale=self.smooth_delay,
                    detection_sigma=self.detection,
                    full_sigma=1.5 * self.detection,
                    band_split_freq=0.0,
                )
        except ValueError as error:
            raise InputError(f"calibration.boards: hera_cal finds no losses: {error}") from None
        losses = np.stack([found[board] for board in boards.tolist()])
        by_channel = np.nan_to_num(losses)[:, :, np.arange(frame.n_channels) // channels]
        return np.moveaxis(by_channel, 1, 2)
