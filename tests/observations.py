"""Observations that are small enough for tests."""

from __future__ import annotations

import numpy as np
from pyuvdata import UVData

from calstudy.instrument.settings import InstrumentSettings


def small_instrument(**changes: object) -> InstrumentSettings:
    """Return a five-antenna, 16-channel, 3-integration observation, with sections replaced by `changes`."""
    sections = {
        "layout": {"kind": "hex", "side": 2, "spacing": "14 m"},
        "beam": "gaussian",
        "channels": {"count": 16, "width": "240 kHz"},
        "times": {"count": 3},
        **changes,
    }
    return InstrumentSettings.model_validate(sections)


def with_autos(data: UVData, power: float) -> UVData:
    """Return data with autocorrelations of a constant power, and the durations and widths of a radiometer."""
    times = np.unique(data.time_array)
    autos = UVData.new(
        freq_array=data.freq_array,
        polarization_array=data.polarization_array,
        times=times,
        antpairs=[(number, number) for number in data.telescope.antenna_numbers],
        telescope=data.telescope,
        integration_time=float(data.integration_time[0]),
        channel_width=np.asarray(data.channel_width),
        do_blt_outer=True,
        empty=True,
        vis_units=data.vis_units,
    )
    autos.data_array[:] = power
    autos.nsample_array[:] = 1
    both = data.copy()
    both.nsample_array[:] = 1
    both = both.__add__(autos, run_check=False)
    both.reorder_blts(order="time", minor_order="baseline", run_check=False)
    return both
