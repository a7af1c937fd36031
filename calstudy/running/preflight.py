"""Checks that need the antennas' positions, made before anything heavy starts."""

from __future__ import annotations

import numpy as np

from calstudy.calibrate.basis import make_basis
from calstudy.calibrate.joint import other_baselines, place_groups, read_joint_groups
from calstudy.errors import InputError
from calstudy.experiment.model import Experiment
from calstudy.instrument.layouts import make_layout


def require_basis_fits(experiment: Experiment) -> None:
    """Raise InputError if the channels cannot hold the foreground basis of the longest baseline.

    Or if joint groups cannot be read or do not fit the array; the longest baseline is that of the others then.
    """
    own = experiment.calibration.code is not None
    if own or not any(variant.calibrate for variant in experiment.variants.values()):
        return
    channels = experiment.instrument.channels
    layout, calibration = make_layout(experiment.instrument.layout), experiment.calibration
    first, second = np.triu_indices(len(layout.enu), 0 if calibration.autos else 1)
    lengths = np.linalg.norm(layout.enu[second] - layout.enu[first], axis=1)
    if calibration.joint_basis is not None:
        antennas = layout.numbers[np.column_stack([first, second])]
        placed = place_groups(read_joint_groups(calibration.joint_basis.path), antennas, channels.count)
        lengths = lengths[other_baselines(placed, lengths.size)]
        if lengths.size == 0:
            return
    longest = lengths.max()
    frequencies = channels.first + channels.width * np.arange(channels.count)
    try:
        make_basis(np.array([longest]), frequencies, calibration.basis)
    except ValueError as error:
        raise InputError(f"{error} (the longest baseline has {longest:.0f} m)") from None
