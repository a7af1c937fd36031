"""Bring a fit to the member of its family of equals that is closest to a reference, so that the two can be compared.

The likelihood does not change under one phase per channel common to all gains, nor under one real scale between gains
and model (`calstudy.calibrate.degeneracy`). A comparison with the truth must not charge a fit with either. Everything
else, near degeneracies between gains and smooth foregrounds included, is left as fitted: that is the paper's point.
"""

from __future__ import annotations

import numpy as np

from calstudy.calibrate.degeneracy import fix_phase


def align(gains: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, float]:
    """Turn and scale fitted gains to come closest to a reference, in least squares over all antennas and channels.

    Parameters
    ----------
    gains, reference
        Complex, (Nants, Nfreqs). Not mutated.

    Returns
    -------
    aligned
        The gains, multiplied by one phase per channel and by `scale`, (Nants, Nfreqs).
    scale
        Real and positive. A model fitted with these gains must be divided by its square, so that the product of gains
        and model, which is what was fitted, stays the same.
    """
    turned = fix_phase(gains, reference)
    scale = float(np.vdot(turned, reference).real / np.vdot(turned, turned).real)
    return scale * turned, scale
