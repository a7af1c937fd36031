"""Agreement of the calibration of variant `residual` with the truth of the simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.visibilities import antenna_pairs, baseline_vectors, flag_cube, to_cube
from calstudy.calibrate.agreement import Baselines, Fit, Truth, as_json, compare_with_truth
from calstudy.instrument.layouts import redundant_groups, size_of_instrument
from calstudy.instrument.settings import Size
from calstudy.products import calibration, corruption, simulation
from calstudy.products.files import AGREEMENT, DATA, MODEL, RESIDUAL, VISIBILITIES, read_visibilities, write_json
from calstudy.products.graph import Graph, memoize, size_of
from calstudy.products.table import StudyTable
from calstudy.run.task import Input, Task

MOST_SAMPLES = 112 * 630 * 384
"""Maximum number of visibilities compared, twice the paper's: it limits the memory."""


@memoize
def agreement(graph: Graph) -> Task | None:
    """Return the task that compares the calibration of variant `residual` with the truth, or None if there is none.

    It needs a calibrated variant `residual` of foregrounds and noise with effects, and a variant of noise alone.
    """
    variants, foregrounds = graph.experiment.variants, simulation.foregrounds(graph)
    residual, noise = variants.get("residual"), variants.get("noise")
    if foregrounds is None or residual is None or noise is None or noise.components != ("noise",):
        return None
    if not (residual.effects and residual.calibrate and {"foregrounds", "noise"} <= set(residual.components)):
        return None
    power, size = graph.experiment.power, size_of_instrument(graph.experiment.instrument)
    compared = integrations_compared(size)
    return Agreement(
        "calibration against truth",
        buffer=power.wedge_buffer,
        redundancy_tolerance=power.redundancy_tolerance,
        integrations=compared if compared < size.times else None,
        data=corruption.data(graph, residual, "even"),
        noise=corruption.data(graph, noise, "even"),
        foregrounds=foregrounds,
        gains=corruption.gains(graph),
        calibration=calibration.calibration(graph, residual, "even"),
    )


class AgreementTable(StudyTable):
    """How gains, model and residual agree with the truth."""

    of = "experiment"
    place = 2

    def products(self, graph: Graph) -> Sequence[Task | None]:
        """Return the product."""
        return [agreement(graph)]


class Agreement(Task, stage="agreement", version=4):
    """A calibration against the truth, at some or all integrations."""

    buffer: float
    redundancy_tolerance: float
    integrations: int | None = None
    data: Input
    noise: Input
    foregrounds: Input
    gains: Input
    calibration: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write measurements of the first polarization and the redundant fraction of the array to agreement.json."""
        from calstudy.products.selection import read_gains

        data = read_visibilities(self.data / DATA)
        true, fitted = read_gains(self.gains), read_gains(self.calibration)
        calibrated = read_visibilities(self.calibration / RESIDUAL)
        flags = flag_cube(calibrated)[..., 0]
        places = np.flatnonzero(~flags.all(axis=(1, 2)))
        chosen = spread(places, self.integrations or len(places))
        if not chosen.size:
            raise InputError("calibration against truth: no integration was calibrated")
        observed = ~flags[chosen].all(axis=(0, 2))
        vectors = baseline_vectors(data)
        pairs = antenna_pairs(data)[observed]
        numbers = np.unique(pairs)
        baselines = Baselines(
            antennas=np.searchsorted(numbers, pairs),
            lengths=np.linalg.norm(vectors[observed], axis=1),
            frequency=data.freq_array,
            buffer=self.buffer,
        )
        # Flagged samples are zero in all compared arrays.
        used, known = ~flags[chosen][:, observed], ~fitted.flags[chosen][:, np.searchsorted(fitted.numbers, numbers)]

        def visibilities(path: Path) -> np.ndarray:
            return used * to_cube(read_visibilities(path))[chosen, ..., 0][:, observed]

        truth = Truth(
            gains=known * true.over(len(fitted.values), numbers)[chosen],
            foregrounds=visibilities(self.foregrounds / VISIBILITIES),
            noise=visibilities(self.noise / DATA),
            data=visibilities(self.data / DATA),
        )
        gains = known * fitted.over(len(fitted.values), numbers)[chosen]
        fit = Fit(gains, *(visibilities(self.calibration / name) for name in (MODEL, RESIDUAL)))
        found = compare_with_truth(truth, fit, baselines)
        write_json(
            output / AGREEMENT,
            {
                "measurements": as_json(found),
                "redundant_fraction": redundant_groups(vectors, self.redundancy_tolerance).redundant_fraction,
                "integrations": chosen.size,
                "integrations_without_solution": flags.shape[0] - places.size,
            },
        )
        return {}

    def _cost(self) -> Cost:
        size = size_of(self)
        compared = integrations_compared(size) * size.baselines * size.channels.count
        memory = LIBRARIES_MEMORY + (3 * size.samples + 8 * compared) * COMPLEX128
        return Cost(1 + size.samples * 1e-7 + compared * 9e-7, memory, 1e4)


def integrations_compared(size: Size) -> int:
    """Return the number of integrations compared: all, or fewer if they have more than `MOST_SAMPLES` visibilities."""
    return min(size.times, max(1, MOST_SAMPLES // (size.baselines * size.channels.count)))


def spread(places: np.ndarray, most: int) -> np.ndarray:
    """Return places, (N,), or `most` of them at equal distances from the first to the last if there are more."""
    return places[np.unique(np.linspace(0, len(places) - 1, min(most, len(places))).round().astype(int))]
