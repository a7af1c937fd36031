"""Checks that need the antennas' positions, made before anything heavy starts."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import pdist

from calstudy.calibrate.basis import delay_half_widths
from calstudy.errors import InputError
from calstudy.experiment.model import Experiment
from calstudy.instrument.layouts import make_layout


def require_basis_fits(experiment: Experiment) -> None:
    """Raise InputError if the foreground basis of the longest baseline reaches the delays that channels can resolve."""
    if not any(variant.calibrate for variant in experiment.variants.values()):
        return
    longest = float(pdist(make_layout(experiment.instrument.layout).enu).max())
    half_width = float(delay_half_widths(np.array([longest]), experiment.calibration.basis)[0])
    nyquist = 0.5 / experiment.instrument.channels.width
    if half_width >= nyquist:
        raise InputError(
            f"calibration.basis: the foregrounds of the longest baseline ({longest:.0f} m) are modelled to delays of "
            f"{1e9 * half_width:.0f} ns, but channels of {experiment.instrument.channels.width / 1e3:g} kHz resolve "
            f"only {1e9 * nyquist:.0f} ns: use narrower channels, a smaller buffer, or fewer antennas"
        )
