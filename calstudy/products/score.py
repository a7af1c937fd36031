"""The scores of one experiment's calibrator, by which calibrators are compared."""

from __future__ import annotations

import itertools
import math
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.files import json_number
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.visibilities import antenna_pairs, flag_cube, rows_of, to_cube
from calstudy.calibrate.agreement import aligned_gains, gain_errors
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS
from calstudy.power.binned import make_bin_edges
from calstudy.power.score import BANDS, SPECTRA, CalibratedSpectra, Score
from calstudy.power.score import score as measure
from calstudy.power.tables import save_spectrum
from calstudy.products import calibration, corruption, expected_loss, signal_loss, sky_model, spectra
from calstudy.products.corruption import PARITIES
from calstudy.products.files import (
    DATA,
    MODEL,
    SCORE,
    SCORE_BANDS,
    SCORE_BINS,
    SKY_MODEL_ERROR,
    SOLUTION,
    read_in_parts,
    read_json,
    write_json,
)
from calstudy.products.graph import Graph, memoize, size_of
from calstudy.products.table import StudyTable
from calstudy.run.task import Input, Task

if TYPE_CHECKING:
    from calstudy.power.settings import PowerSettings

MEASURED = 2
"""Version of T and the bias; scores of different versions are not ranked together."""
SAMPLES_AT_A_TIME = 14 * 630 * 384
"""Number of visibilities of each data set that are in memory together."""


@memoize
def score(graph: Graph) -> MeasureScore | None:
    """Return the task of the scores, or None if the experiment does not calibrate data with the EoR and without."""
    if (loss := signal_loss.transfer(graph)) is None:
        return None
    residual, without, _ = SIGNAL_LOSS_VARIANTS
    variant, other = (graph.experiment.variants[name] for name in (residual, without))
    return MeasureScore(
        "score",
        power=graph.experiment.power,
        polarizations=len(graph.experiment.instrument.polarizations),
        signal=loss.signal,
        response=loss.response,
        cross=loss.cross,
        scale=loss.scale,
        residual=spectra.power(graph, residual),
        residual_without_eor=spectra.power(graph, without),
        calibration={parity: calibration.calibration(graph, variant, parity) for parity in PARITIES},
        data={parity: corruption.data(graph, variant, parity) for parity in PARITIES},
        calibration_without_eor={parity: calibration.calibration(graph, other, parity) for parity in PARITIES},
        gains=corruption.gains(graph) if variant.effects else None,
        sky_model_error=sky_model.error(graph),
        linear_response=expected_loss.linear_response(graph),
    )


class ScoreTable(StudyTable):
    """The row of the calibrator in a comparison."""

    of = "experiment"
    place = 4

    def products(self, graph: Graph) -> Sequence[Task | None]:
        """Return the product."""
        return [score(graph)]


class MeasureScore(Task, stage="score", version=7):
    """The scores in bins and in bands of k, and other numbers by which calibrators are compared."""

    power: PowerSettings
    polarizations: int
    signal: Input
    response: Input
    cross: Input
    scale: Input
    residual: Input
    residual_without_eor: Input
    calibration: Mapping[str, Input]
    data: Mapping[str, Input]
    calibration_without_eor: Mapping[str, Input]
    gains: Input = None
    sky_model_error: Input = None
    linear_response: Input = None

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the scores, and all numbers to score.json."""
        measured = signal_loss.read_calibrated({name: getattr(self, name) for name in SPECTRA})
        known = read_json(self.scale / signal_loss.SCALE)["flux_scale"]
        scale, power = math.nan if known is None else known, self.power
        save_spectrum(output / SCORE_BINS, measure(measured, make_bin_edges(power.bins), power.wedge_buffer, scale))
        bands = measure(measured, BANDS, power.wedge_buffer, scale)
        linear = self._linear_transfer(measured)
        save_spectrum(output / SCORE_BANDS, bands)
        summary = {
            "bands": _in_bands(bands, linear),
            "flux_scale": known,
            "sky_model_error": self._sky_model_error(),
            **self._gain_errors(),
            "held_out_chi_squared": self._held_out_chi_squared(),
            **self._solves(),
        }
        write_json(output / SCORE, summary)
        return {}

    def _linear_transfer(self, measured: CalibratedSpectra) -> np.ndarray | None:
        """Return T of the linear response in bands, or None if it is not known or of other baselines."""
        if self.linear_response is None or np.any(measured.signal.n_pairs != 1):
            return None
        bands = read_json(self.linear_response / expected_loss.RESPONSE)["bands"]
        return None if bands is None else np.array([band["transfer"] for band in bands], float)

    def _sky_model_error(self) -> float | None:
        """Return the rms of the sky model's error over that of the true foregrounds; zero for a perfect sky model."""
        folder = self.sky_model_error
        return 0.0 if folder is None else read_json(folder / SKY_MODEL_ERROR)["relative_error"]

    def _gain_errors(self) -> dict[str, float | None]:
        """Return the median relative errors of the gains, as fitted and after alignment of the degenerate terms."""
        from calstudy.products.selection import read_gains, true_of

        aligned, as_fitted = [], []
        for place in range(self.polarizations):
            fitted = read_gains(self.calibration[PARITIES[0]], place)
            solved = ~fitted.flags.all(axis=(1, 2))
            if solved.any():
                both = (fitted.values, true_of(self.gains, fitted, place))
                found, true = (np.where(fitted.flags, 0, gains)[solved] for gains in both)
                aligned.append(np.ravel(gain_errors(aligned_gains(found, true), true)))
                as_fitted.append(np.ravel(gain_errors(found, true)))
        return {
            "gain_error_aligned": float(np.median(np.concatenate(aligned))) if aligned else None,
            "gain_error_as_fitted": float(np.median(np.concatenate(as_fitted))) if as_fitted else None,
        }

    def _held_out_chi_squared(self) -> float | None:
        """Return chi^2 per sample of the odd data under gains and model that were fitted to the even data.

        The variance of the noise is half the mean square of the difference of the two. Apart from the power of the EoR,
        chi^2 is 1 for the true gains and foregrounds.
        """
        from calstudy.products.selection import read_gains

        fitted = [read_gains(self.calibration[PARITIES[0]], place) for place in range(self.polarizations)]
        paths = [self.data[parity] / DATA for parity in PARITIES]
        paths.append(self.calibration[PARITIES[0]] / MODEL)
        misfit = noise = 0.0
        for part, (even, odd, model) in read_in_parts(paths, SAMPLES_AT_A_TIME):
            rows = rows_of(even, antenna_pairs(model))
            first, second = np.searchsorted(fitted[0].numbers, antenna_pairs(model)).T
            cubes = [to_cube(uvd) for uvd in (even, odd, model)]
            flags, unsolved = flag_cube(even) | flag_cube(odd), flag_cube(model)
            for (place, time), (pol, fit) in itertools.product(enumerate(part), enumerate(fitted)):
                at, gains = (place, ..., pol), fit.values[time]
                lacking = fit.flags[time][first] | fit.flags[time][second]
                used = ~(flags[at][rows] | unsolved[at] | lacking)
                predicted = gains[first] * gains[second].conj() * cubes[2][at]
                misfit += float(np.sum(np.abs(cubes[1][at][rows] - predicted)[used] ** 2))
                noise += float(np.sum(np.abs(cubes[1][at][rows] - cubes[0][at][rows])[used] ** 2)) / 2
        return misfit / noise if noise > 0 else None

    def _solves(self) -> dict[str, Any]:
        """Return the status and cost of all solves of data with the EoR and without; None where it is not known."""
        records = [
            record
            for calibrations in (self.calibration, self.calibration_without_eor)
            for parity in PARITIES
            for record in read_json(calibrations[parity] / SOLUTION)["records"]
        ]
        by_status = dict(sorted(Counter(record["status"] for record in records).items()))
        known = set(by_status) != {"by-file"}
        return {
            "by_status": by_status,
            "cpu_seconds_per_integration": cpu_seconds_per_integration(records) if known else None,
            "peak_memory": max(record["peak_memory"] for record in records) if known else None,
        }

    def _cost(self) -> Cost:
        size = size_of(self)
        part = min(size.samples, max(SAMPLES_AT_A_TIME, size.samples // size.times))
        return Cost(0.5 + size.samples * 1.5e-7, LIBRARIES_MEMORY + 8 * part * COMPLEX128, 1e6)


def _in_bands(bands: Score, linear: np.ndarray | None) -> list[dict[str, Any]]:
    names = [f"{name}{kind}" for name in ("transfer", "bias", "recovered") for kind in ("", "_error")]
    return [
        {
            "k": bands.bin_edges[band : band + 2].tolist(),
            **{name: json_number(getattr(bands, name)[band]) for name in (*names, "cross_transfer")},
            "linear_transfer": None if linear is None else json_number(linear[band]),
        }
        for band in range(bands.k.size)
    ]


def cpu_seconds_per_integration(records: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the processor seconds per integration, with all of its polarizations, from summaries of `Solve`.

    It is the median over solves, because the first in a process also compiles, without skipped solves. It is None if a
    record has no time, or if nothing was solved.
    """
    solved = [record for record in records if record["status"] != "skipped"]
    if not solved or any(record.get("cpu_seconds") is None for record in solved):
        return None
    polarizations = len({record["polarization"] for record in solved})
    return polarizations * statistics.median(record["cpu_seconds"] / record["n_integrations"] for record in solved)
