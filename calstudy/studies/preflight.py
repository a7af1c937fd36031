"""Checks that need the antennas' positions, made before anything heavy starts."""

from __future__ import annotations

import numpy as np

from calstudy.base.observation import Frame
from calstudy.calibrate.execution import require_calibratable
from calstudy.experiment.model import Experiment
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.settings import InstrumentSettings


def require_calibration(experiment: Experiment) -> None:
    """Raise InputError if the calibrator refuses the antennas, baselines and channels of an experiment."""
    if any(variant.calibrate for variant in experiment.variants.values()):
        has_sky_model = experiment.sky.foregrounds.kind != "none"
        require_calibratable(experiment.calibration, frame_of(experiment.instrument), has_sky_model)


def frame_of(instrument: InstrumentSettings) -> Frame:
    """Return antennas, baselines and channels of an instrument's data, which have no autocorrelations."""
    layout, channels = make_layout(instrument.layout), instrument.channels
    order = np.argsort(layout.numbers)
    places = np.argsort(order)
    return Frame(
        layout.numbers[order],
        layout.enu[order],
        places[np.column_stack(np.triu_indices(len(order), 1))],
        channels.first + channels.width * np.arange(channels.count),
        instrument.times.count,
        len(instrument.polarizations),
    )
