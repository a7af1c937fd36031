r"""Step 1.0: foregrounds and EoR with perfect gains: outside the wedge there is the EoR alone.

Outside means |tau| > |b|/c + buffer, and beyond the taper's main lobe if that is wider. With foregrounds of power P^F
there, P^{F+S} - P^S = P^F + 2 Re <F* S>: a floor, and a cross term without mean that scatters by sqrt(2 P^F P^S / N).
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy.constants import speed_of_light

from calstudy.claims.statement import Finding
from calstudy.claims.window import MAIN_LOBE
from calstudy.power.spectra import DelaySpectra
from calstudy.power.transfer import BANDS
from calstudy.validation.evidence import Evidence, Measurement
from calstudy.validation.signal import clustered_mean


def measure(evidence: Evidence) -> Measurement:
    """Return P^{F+S} / P^S - 1 over all modes outside the wedge, the floor P^F / P^S, and what is beyond it."""
    name = evidence.only
    signal, floor, both = (evidence.spectra(name, product) for product in ("eor", "foregrounds", "both"))
    outside = beyond_wedge(signal, evidence.power(name).wedge_buffer)
    k = np.hypot(signal.k_perp[:, None], signal.k_parallel)
    excess = _over_signal(both.power.real - signal.power.real, signal, outside)
    beyond = both.power.real - signal.power.real - floor.power.real
    accounted, remarks = _over_signal(beyond, signal, outside), []
    for low, high in itertools.pairwise(BANDS):
        band = outside & (k > low) & (k <= high)
        if band.any():
            found, leak = _over_signal(beyond, signal, band), _over_signal(floor.power.real, signal, band)
            remarks.append(
                f"k from {low:g} to {high:g} h/Mpc: floor P^F / P^S = {leak.value:.2e}, excess beyond it "
                f"{found.value:.1e} ± {found.uncertainty:.1e}"
            )
    return Measurement(
        {
            "excess": Finding(abs(excess.value), excess.uncertainty),
            "beyond_floor": Finding(abs(accounted.value), accounted.uncertainty),
            "floor": _over_signal(floor.power.real, signal, outside),
        },
        tuple(remarks),
    )


def beyond_wedge(spectra: DelaySpectra, buffer: float) -> np.ndarray:
    """Return which modes, (Nu, Nd), are beyond horizon and buffer (s), or the taper's main lobe if that is wider."""
    lobe = MAIN_LOBE * (spectra.delay[1] - spectra.delay[0])
    horizon = spectra.length / speed_of_light
    return np.abs(spectra.delay) > horizon[:, None] + max(buffer, lobe)


def _over_signal(power: np.ndarray, signal: DelaySpectra, used: np.ndarray) -> Finding:
    """Return the mean of `power` over the mean of the signal's over the modes used."""
    level = float(signal.power.real[used].mean())
    found = clustered_mean(np.where(used, power, np.nan))
    return Finding(found.value / level, found.uncertainty / level)
