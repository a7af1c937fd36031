"""The spectrum of a calibrated signal without its loss, by the linear response of the fit to each bin of k."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.resources import Cost
from calstudy.experiment.model import Experiment
from calstudy.instrument.layouts import redundant_groups
from calstudy.power.binned import make_bin_edges
from calstudy.power.settings import PowerSettings
from calstudy.power.tables import save_spectrum
from calstudy.power.windows import UnbiasedSpectrum, deconvolved, draw_in_bins, window_matrix
from calstudy.products import corruption, signal_loss
from calstudy.products.expected_loss import (
    NOT_OF_THE_FIT,
    OfResponses,
    Responses,
    Solution,
    cost_of_responses,
    solved_inputs,
    why_no_response,
)
from calstudy.products.files import read_json
from calstudy.products.graph import Graph, memoize, required
from calstudy.products.signal_loss import SCALE
from calstudy.products.spectra import read_recovered, spectra
from calstudy.run.task import Input, Task

if TYPE_CHECKING:
    from calstudy.calibrate.expected_loss import DelayModes

UNBIASED = "unbiased.h5"
FURTHEST = 0.6
"""Last k, h/Mpc, with a window function: from there on T does not change."""
DRAWS, SEED = 4, 20_211_021
"""Random signals of each bin, and their seed."""
REDUNDANT = 1.0
"""Baselines whose vectors agree to this, m, see the same signal."""


def why_not(experiment: Experiment) -> str | None:
    """Name what an experiment lacks for a spectrum without its loss, to follow "needs"; None if nothing."""
    pairs = None if experiment.power.pairs == "same-baseline" else "power.pairs: same-baseline"
    return why_no_response(experiment) or pairs


@memoize
def unbiased(graph: Graph) -> Task:
    """Return the task of the spectrum without its loss; raises InputError if an experiment cannot have one."""
    if lacking := why_not(graph.experiment):
        raise InputError(f"figure 'unbiased': needs {lacking}")
    power = graph.experiment.power.with_defaults(*NOT_OF_THE_FIT)
    even, odd = (
        BinResponse(f"response to each bin of k, {parity}", power=power, temporary=True, **solved_inputs(graph, parity))
        for parity in corruption.PARITIES
    )
    scale = required(signal_loss.transfer(graph)).scale
    return Unbiased("spectrum without loss", power=power, even=even, odd=odd, spectra=spectra(graph), scale=scale)


class BinResponse(Responses, stage="bin-response", version=2):
    """The linear response of one calibrated integration to random signals of each bin of k."""

    def amplitudes(self, solution: Solution, modes: DelayModes) -> dict[str, np.ndarray]:
        """Return the amplitudes of what is left of the signals, and the power of these."""
        groups, rng = redundant_groups(solution.vectors, REDUNDANT), np.random.default_rng(SEED)
        where = solution.frequency, solution.lengths, (groups.index, groups.conjugated), window_edges(self.power)
        signals = (draw_in_bins(*where, self.power.cosmology, rng) for _ in range(DRAWS))
        drawn = [[solution.used * signal for signal in parts] for parts in signals]
        left = [[modes.amplitudes(solution.left_of(signal)) for signal in parts] for parts in drawn]
        powers = [np.abs(modes.amplitudes(signal)) ** 2 for parts in drawn for signal in parts]
        return {"left": np.array(left, np.complex64), "put_in": np.sum(powers, axis=0) / DRAWS}

    def _cost(self) -> Cost:
        return cost_of_responses(self, DRAWS * len(window_edges(self.power)), 2.5e9)


class Unbiased(OfResponses, stage="unbiased", version=1, cost=Cost(1, disk=1e5)):
    """The spectrum of the residual without its loss, by the window functions of one integration.

    They are those of a run that is so short that the loss of one integration is that of the average. Errors are those
    of the whole EoR and noise, upper bounds for what is left of them, in bins that are taken as independent.
    """

    spectra: Input
    scale: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the spectrum with its window functions; raises InputError if the integration has no gains."""
        edges = window_edges(self.power)
        if (found := self.read()) is None:
            raise InputError("unbiased: the middle integration has antennas or channels without gains")
        even, odd, modes = found
        both = even["left"], odd["left"]
        window = window_matrix(modes, both, even["put_in"], edges, self.power.wedge_buffer)
        residual, signal = read_recovered(self.spectra)
        known = read_json(self.scale / SCALE)["flux_scale"]
        bins = slice(edges.size - 1)
        measured, error = (1 if known is None else known**2) * residual.power.real[bins], residual.error[bins]
        power, its_error = deconvolved(window, measured, error)
        k = (edges[1:] + edges[:-1]) / 2
        spectrum = UnbiasedSpectrum(k, edges, window, measured, error, power, its_error, signal.power.real[bins])
        save_spectrum(output / UNBIASED, spectrum)
        return {}


def window_edges(power: PowerSettings) -> np.ndarray:
    """Return the edges of the bins of k that have window functions, h/Mpc."""
    edges = make_bin_edges(power.bins)
    return edges[: max(int(edges.searchsorted(FURTHEST, side="right")), 2)]
