"""Checks that need the antennas' positions, made before anything heavy starts."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import pdist

from calstudy.calibrate.basis import make_basis
from calstudy.errors import InputError
from calstudy.experiment.model import Experiment
from calstudy.instrument.layouts import make_layout


def require_basis_fits(experiment: Experiment) -> None:
    """Raise InputError if the channels cannot hold the foreground basis of the longest baseline."""
    own = experiment.calibration.code is not None
    if own or not any(variant.calibrate for variant in experiment.variants.values()):
        return
    channels = experiment.instrument.channels
    longest = pdist(make_layout(experiment.instrument.layout).enu).max()
    frequencies = channels.first + channels.width * np.arange(channels.count)
    try:
        make_basis(np.array([longest]), frequencies, experiment.calibration.basis)
    except ValueError as error:
        raise InputError(f"{error} (the longest baseline has {longest:.0f} m)") from None
