"""From components and gains to a measurement, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pyuvdata.utils import uvcalibrate

if TYPE_CHECKING:
    from pyuvdata import UVCal, UVData


def corrupt_by_gains(sky: UVData, gains: UVCal) -> UVData:
    """Return g_a(nu) g_b*(nu) m_ab(nu, t) for intrinsic visibilities m (paper Eq. GENERALMODEL).

    Gains for a single time hold for the whole run. The unit stays Jy, for the study's gains scatter about unity.
    """
    data = uvcalibrate(sky, gains, inplace=False, undo=True, time_check=False)
    data.vis_units, data.pol_convention = sky.vis_units, sky.pol_convention
    return data
