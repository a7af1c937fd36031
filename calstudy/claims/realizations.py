"""Realizations of an experiment for statements of papers: means over all draws, with errors from their scatter."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.experiment.model import Experiment
from calstudy.experiment.realizations import expand_realizations, members
from calstudy.instrument.layouts import make_array, redundant_groups
from calstudy.power.realizations import Design, mean_over_bins
from calstudy.results.reader import arrays_of_figure
from calstudy.verdicts.criterion import Finding
from calstudy.verdicts.statement import Unevaluated

ARRAYS = "realizations.npz"


def bias_extent(ratio: np.ndarray, error: np.ndarray, edges: np.ndarray) -> float:
    """Return the wavenumber in h/Mpc up to which P^R / P^S, (Nk,) in bins of k, is below 1 by more than its 95 % error.

    It is the upper edge of the last such bin before two successive bins without a bias. The lowest bin, which has
    few modes, may be unbiased if the next is biased. Without any bias it is the lower edge of the first bin with modes.
    Raises Unevaluated if no bin has any.
    """
    used = np.flatnonzero(np.isfinite(ratio) & np.isfinite(error))
    if not used.size:
        raise Unevaluated("no bins have modes in all realizations")
    biased = (1 - ratio[used]) / error[used] > SIGMAS_95
    without_two = np.flatnonzero(~(biased[:-1] | biased[1:]))
    found = np.flatnonzero(biased[: without_two[0]] if without_two.size else biased)
    return float(edges[used[found[-1]] + 1] if found.size else edges[used[0]])


@dataclass(frozen=True)
class PooledResults:
    """All realizations of one experiment.

    The arrays are those of the figure of the realizations, such as ``outside-wedge.values.bias`` (K, Nk) and
    ``outside-wedge.k`` (Nk,).
    """

    experiment: Experiment
    arrays: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, experiment: Experiment, folder: Path) -> PooledResults:
        """Read the arrays from the folder of the figure."""
        return cls(experiment, arrays_of_figure(folder / ARRAYS))

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return self.experiment.name

    @property
    def redundant_fraction(self) -> float:
        """Part of the baselines that have a redundant partner."""
        enu = make_array(self.experiment.instrument).enu
        first, second = np.triu_indices(len(enu), 1)
        return redundant_groups(enu[second] - enu[first], self.experiment.power.redundancy_tolerance).redundant_fraction

    def mean(self, quantity: str, modes: str, k_min: float = 0.0, k_max: float = np.inf) -> Finding:
        """Return the mean of a quantity over bins of k, h/Mpc, and realizations.

        It is one of `calstudy.power.realizations.QUANTITIES` or `TRANSFER_QUANTITIES`, or "eor" for P^S over the power
        that the sky was drawn from; modes are "outside-wedge", "inside-wedge" or "all-modes". Raises Unevaluated if
        there is no bin in which it is known in all realizations.
        """
        k, array = self.arrays[f"{modes}.k"], self.arrays.get(f"{modes}.values.{quantity}")
        if quantity == "eor":
            array = self.arrays[f"{modes}.eor"] / self.arrays[f"{modes}.input"]
        if array is None:
            raise Unevaluated(f"the realizations have no {quantity!r}")
        found = mean_over_bins(array[:, (k >= k_min) & (k <= k_max)], self._design)
        if not np.isfinite(found.value):
            raise Unevaluated(f"no modes between k = {k_min:g} and {k_max:g} h/Mpc in all realizations")
        return found

    def bias_extents(self, modes: str) -> np.ndarray:
        """Return the k up to which P^R of each realization is biased (`bias_extent`), h/Mpc, (K,)."""
        values, errors = (self.arrays[f"{modes}.{kind}.ratio"] for kind in ("values", "quoted"))
        edges = self.arrays[f"{modes}.bin_edges"]
        return np.array([bias_extent(*one, edges) for one in zip(values, errors, strict=True)])

    @property
    def _design(self) -> Design:
        experiment = self.experiment
        blocks = zip(experiment.realizations, members(experiment), strict=True)
        draws = [item.draws for item in expand_realizations(experiment)]
        return Design(draws, [(block.draw, places) for block, places in blocks])


def of_one_draw(values: np.ndarray) -> Finding:
    """Return the mean of realizations with the scatter of single ones: a paper's number is of one."""
    return Finding(float(np.mean(values)), float(np.std(values, ddof=1)))


def over_realizations(
    quantity: str, modes: str, k_min: float = 0.0, k_max: float = np.inf
) -> Callable[[PooledResults], Finding]:
    """Return the measure of a statement by a mean over realizations; parameters as for `PooledResults.mean`."""
    return lambda run: run.mean(quantity, modes, k_min, k_max)
