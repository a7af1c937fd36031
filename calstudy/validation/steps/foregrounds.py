"""Step 1.0: foregrounds and EoR with perfect gains: outside the wedge there is only the EoR.

Outside means |tau| > |b|/c + buffer, and beyond the taper's main lobe if that is wider. With foregrounds of power P^F
there, P^{F+S} - P^S = P^F + 2 Re <F* S>: a floor, and a cross term of zero mean that scatters by sqrt(2 P^F P^S / N).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np

from calstudy.claims.bins import clustered_mean
from calstudy.experiment.model import Component, Variant
from calstudy.power.delay import horizon_delay
from calstudy.power.spectra import DelaySpectra
from calstudy.power.transfer import BANDS
from calstudy.products import spectra
from calstudy.products.graph import Graph
from calstudy.run.task import Task
from calstudy.simulate.floor import MAIN_LOBES
from calstudy.validation.step import MINREDUNDANT, Findings, Limit, Step, StepInput, only
from calstudy.verdicts.criterion import AtMost, Finding

MAIN_LOBE = MAIN_LOBES["blackman-harris"]
"""Half width of the main lobe of the estimator's widest taper, in units of 1 / bandwidth."""


class Foregrounds(Step):
    """P^{F+S} / P^S - 1 over all modes outside the wedge, the floor P^F / P^S, and the excess over it."""

    number = "1.0"
    proves = "outside the wedge, the power of foregrounds and EoR equals that of the EoR alone"
    experiments: ClassVar = {"minredundant": MINREDUNDANT}
    sections: ClassVar = ("power",)
    limits: ClassVar = {
        "beyond_floor": Limit(
            "|P^{F+S} - P^S - P^F| / P^S over all modes beyond horizon, buffer and main lobe of the taper: excess over "
            "the floor P^F of the foregrounds",
            AtMost(0.01),
            "1 %",
        ),
        "excess": Limit(
            "|P^{F+S} - P^S| / P^S over the same modes, including the floor",
            AtMost(0.01),
            "stricter, without allowance for sidelobes of the taper; the short band of the small scale cannot meet it",
            small="full scale only",
        ),
    }

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the spectra of EoR and foregrounds, each alone and both together, without gains."""
        components: dict[str, tuple[Component, ...]] = {
            "eor": ("eor",),
            "foregrounds": ("foregrounds",),
            "both": ("foregrounds", "eor"),
        }
        return {
            name: spectra.variant_power(graph, "+".join(parts), Variant(components=parts))
            for name, parts in components.items()
        }

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        """Compare the three spectra outside the wedge, for all modes together and in bands."""
        run = only(runs)
        signal, floor, both = (run.delay_spectra(product) for product in ("eor", "foregrounds", "both"))
        outside = beyond_wedge(signal, run.experiment.power.wedge_buffer)
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
        values = {
            "excess": Finding(abs(excess.value), excess.uncertainty),
            "beyond_floor": Finding(abs(accounted.value), accounted.uncertainty),
            "floor": _over_signal(floor.power.real, signal, outside),
        }
        return Findings(values, tuple(remarks))


def beyond_wedge(signal: DelaySpectra, buffer: float) -> np.ndarray:
    """Return which modes, (Nu, Nd), are beyond horizon and buffer (s), or the taper's main lobe if it is wider."""
    lobe = MAIN_LOBE * (signal.delay[1] - signal.delay[0])
    horizon = horizon_delay(signal.length)
    return np.abs(signal.delay) > horizon[:, None] + max(buffer, lobe)


def _over_signal(power: np.ndarray, signal: DelaySpectra, used: np.ndarray) -> Finding:
    """Return the mean of `power` over that of the signal, over the modes used."""
    level = float(signal.power.real[used].mean())
    found = clustered_mean(np.where(used, power, np.nan))
    return Finding(found.value / level, found.uncertainty / level)
