"""Fraction of the EoR that the fit of one integration leaves, to first order, from its own tangent space."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from calstudy.base.errors import InputError
from calstudy.base.resources import LIBRARIES_MEMORY, Cost
from calstudy.calibrate.cost import PAPER_SAMPLES
from calstudy.calibrate.settings import GainFit
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS, Variant
from calstudy.products import calibration, corruption
from calstudy.products.files import DATA, MODEL, integration_times, json_number, read_visibilities, write_json
from calstudy.products.graph import Graph, once, size_of
from calstudy.run.task import Job, Stage, Task

if TYPE_CHECKING:
    import numpy as np

    from calstudy.calibrate.expected_loss import ExpectedTransfer
    from calstudy.calibrate.problem import CalibrationProblem
    from calstudy.power.expected import ExpectedBins
    from calstudy.power.settings import PowerSettings
    from calstudy.power.spectra import BaselineModes

EXPECTED, RESPONSE = "expected-loss.h5", "linear-response.json"
# Random vectors for the stochastic diagonal: its scatter, 6 % of the mode's power over their root, is averaged down
# further within a bin.
PROBES = 16
LARGEST = 4.0
"""Visibilities of an integration, over those of the paper's, up to which scores have the linear response: the tangent
space takes 1.5 GB for the paper's."""


@once
def expected_loss(graph: Graph) -> Task:
    """Return the task that predicts T for the middle integration of the variant `residual`."""
    return Task(EXPECTED_LOSS, "expected signal loss", _settings(graph) | {"probes": PROBES}, _inputs(graph))


@once
def linear_response(graph: Graph) -> Task | None:
    """Return the task of the linear response to the EoR itself, or None if it cannot be compared with T.

    Calibrators must fit each integration by least squares and use the gains without smoothing. Spectra must be of each
    baseline with itself, because a fit responds differently on different baselines of a group. Large arrays have none.
    """
    fit = graph.experiment.calibration
    fits = isinstance(fit, GainFit) and fit.integrations_per_solve == 1 and fit.smooth_gains is None
    size = graph.size
    large = size.baselines * size.channels.count > LARGEST * PAPER_SAMPLES
    if not fits or large or graph.experiment.power.pairs == "redundant-group":
        return None
    inputs = _inputs(graph) | {"signal": corruption.data(graph, Variant(components=("eor",)), "even")}
    settings = _settings(graph)
    settings["power"] = settings["power"].with_defaults("bins", "length_bin")
    return Task(LINEAR_RESPONSE, "linear response to the EoR", settings, inputs)


def _inputs(graph: Graph) -> dict[str, Task]:
    residual = graph.experiment.variants[SIGNAL_LOSS_VARIANTS[0]]
    inputs = calibration.calibration_inputs(graph, residual, "even")
    return inputs | {"calibration": calibration.calibration(graph, residual, "even")}


def _settings(graph: Graph) -> dict[str, Any]:
    return {
        "calibration": graph.experiment.calibration.with_defaults("assumed"),
        "power": graph.experiment.power.with_defaults("pairs", "redundancy_tolerance", "coherent_time"),
        "integration": graph.experiment.instrument.times.count // 2,
    }


@dataclass(frozen=True)
class _Solution:
    """The problem of one integration and its solution: gains (Nants, Nfreqs), model (Nbls, Nfreqs)."""

    problem: CalibrationProblem
    gains: np.ndarray
    model: np.ndarray
    pairs: list[tuple[int, int]]
    lengths: np.ndarray
    frequency: np.ndarray


def _solution(job: Job) -> _Solution | None:
    """Return the solution, or None if an antenna or a channel has no gains or the integration was not solved."""
    import numpy as np

    from calstudy.base.observation import Observation
    from calstudy.base.visibilities import antenna_pairs, to_cube
    from calstudy.calibrate.interface import Assumed
    from calstudy.calibrate.preparation import prepare, problem_at
    from calstudy.products.selection import read_gains

    settings, index = job.settings["calibration"], job.settings["integration"]
    times = integration_times(job.inputs["data"] / DATA)[[index]]
    data, sky, noise = calibration.read_calibrated(job.inputs, times)
    prepared = prepare(Observation(data), settings, Assumed(None if sky is None else Observation(sky), noise=noise))
    fitted = read_gains(job.inputs["calibration"])
    gains = fitted.at(index, prepared.data.numbers)
    problem = problem_at(prepared, settings, slice(0, 1), 0, gains)
    if isinstance(problem, str) or fitted.flags[index].any():
        return None
    model = read_visibilities(job.inputs["calibration"] / MODEL, times)
    return _Solution(
        problem,
        gains,
        to_cube(model)[0, ..., 0],
        [(int(first), int(second)) for first, second in antenna_pairs(model)],
        prepared.data.lengths,
        np.asarray(data.freq_array, float),
    )


def expect(job: Job) -> Mapping[str, Any]:
    """Write the expected T of one calibrated integration, in bins of k and of baseline length and delay."""
    from calstudy.calibrate.expected_loss import DelayModes, expected_transfer
    from calstudy.power.tables import save_spectrum

    power, index = job.settings["power"], job.settings["integration"]
    solution = _solution(job)
    if solution is None:
        raise InputError(
            f"expected-loss: integration {index} was not calibrated in all antennas and channels, and flagged data are "
            "not supported"
        )
    modes = DelayModes(solution.frequency, power.taper)
    expected = expected_transfer(solution.problem, solution.gains, solution.model, modes, job.settings["probes"])
    found = binned(expected, solution.lengths, float(solution.frequency.mean()), power)
    save_spectrum(job.output / EXPECTED, found)
    return {"integration": index, "probes": job.settings["probes"]}


def respond(job: Job) -> Mapping[str, Any]:
    """Write T and C of the linear response of one integration to the EoR in the bands of scores; null if flagged."""
    from calstudy.base.visibilities import antenna_pairs, to_cube
    from calstudy.calibrate.expected_loss import DelayModes
    from calstudy.calibrate.expected_loss import linear_response as response_to
    from calstudy.power.expected import bin_response
    from calstudy.power.score import BANDS

    power, solution = job.settings["power"], _solution(job)
    if solution is None:
        write_json(job.output / RESPONSE, {"bands": None})
        return {}
    times = integration_times(job.inputs["data"] / DATA)[[job.settings["integration"]]]
    eor = read_visibilities(job.inputs["signal"] / DATA, times)
    places = {tuple(pair): row for row, pair in enumerate(antenna_pairs(eor).tolist())}
    signal = to_cube(eor)[0, [places[pair] for pair in solution.pairs], :, 0]
    left = response_to(solution.problem, solution.gains, solution.model, signal)
    modes = DelayModes(solution.frequency, power.taper)
    where = _modes(modes.delay, solution.lengths, float(solution.frequency.mean()), power)
    put_in, answered = modes.amplitudes(signal), modes.amplitudes(left)
    transfer, cross = bin_response(where, put_in, answered, BANDS, power.wedge_buffer)
    bands = [
        {"k": list(edges), "transfer": json_number(t), "cross_transfer": json_number(c)}
        for edges, t, c in zip(pairwise(BANDS), transfer, cross, strict=True)
    ]
    write_json(job.output / RESPONSE, {"bands": bands})
    return {}


def _modes(delay: np.ndarray, lengths: np.ndarray, centre: float, power: PowerSettings) -> BaselineModes:
    from calstudy.power.cosmology import k_parallel, k_perpendicular, make_cosmology
    from calstudy.power.spectra import BaselineModes

    cosmology = make_cosmology(power.cosmology)
    return BaselineModes(
        length=lengths,
        k_perp=k_perpendicular(cosmology, lengths, centre),
        delay=delay,
        k_parallel=k_parallel(cosmology, delay, centre),
    )


def binned(expected: ExpectedTransfer, lengths: np.ndarray, centre: float, power: PowerSettings) -> ExpectedBins:
    """Return an expected T of baselines (lengths in m, band centre in Hz) in bins of k and of length and delay."""
    from calstudy.power.binned import make_bin_edges
    from calstudy.power.expected import bin_expected

    modes = _modes(expected.delay, lengths, centre, power)
    edges = make_bin_edges(power.bins)
    return bin_expected(modes, expected.transfer, expected.error, edges, power.wedge_buffer, power.length_bin)


def _cost(task: Task) -> Cost:
    size = size_of(task)
    work = size.baselines * size.channels.count / PAPER_SAMPLES
    return Cost(6 + 0.8 * task.settings.get("probes", 1) * work, LIBRARIES_MEMORY + 1.5e9 * work, 1e6)


EXPECTED_LOSS = Stage(name="expected-loss", version=4, make=expect, cost=_cost)
LINEAR_RESPONSE = Stage(name="linear-response", version=1, make=respond, cost=_cost)
