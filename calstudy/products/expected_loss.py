"""Fraction of the EoR that a fit leaves, to first order, from its own tangent space."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.files import json_number
from calstudy.base.kept_arrays import read_arrays
from calstudy.base.resources import LIBRARIES_MEMORY, Cost
from calstudy.base.visibilities import antenna_pairs, rows_of, to_cube
from calstudy.calibrate.cost import PAPER_SAMPLES
from calstudy.calibrate.records import Solve
from calstudy.calibrate.settings import GainFit
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS, Experiment, Variant
from calstudy.instrument.layouts import size_of_instrument
from calstudy.power.binned import make_bin_edges
from calstudy.power.score import BANDS
from calstudy.power.settings import PowerSettings
from calstudy.power.spectra import BaselineModes, modes_of
from calstudy.power.tables import save_spectrum
from calstudy.power.transfer import ExpectedBins, bin_expected, bin_response
from calstudy.products import corruption
from calstudy.products.calibration import Calibrated, prepared_fit, solved
from calstudy.products.files import (
    DATA,
    EXPECTED,
    MODEL,
    SOLUTION,
    integration_times,
    read_json,
    read_visibilities,
    write_json,
)
from calstudy.products.graph import Graph, memoize, size_of
from calstudy.run.task import Input, Task, called

if TYPE_CHECKING:
    from calstudy.calibrate.expected_loss import DelayModes, ExpectedTransfer
    from calstudy.calibrate.problem import CalibrationProblem

RESPONSE, AMPLITUDES = "linear-response.json", "amplitudes.npz"
# Random vectors for the stochastic diagonal: its scatter, 6 % of the mode's power over their root, is averaged down
# further within a bin.
PROBES = 16
LARGEST = 4.0
"""Visibilities of an integration, over those of the paper's, up to which scores have the linear response: the tangent
space takes 1.5 GB for the paper's."""
LABEL = "expected signal loss"
NOT_OF_THE_FIT = ("pairs", "redundancy_tolerance", "coherent_time")
"""Fields of the power section that have no effect on one integration."""


@memoize
def expected_loss(graph: Graph) -> Task:
    """Return the task that predicts T for the middle integration; InputError for smoothed gains or a baseline range."""
    fit = graph.experiment.calibration
    if isinstance(fit, GainFit) and (field := fit.not_in_expected_loss):
        raise InputError(
            f"figure 'expected-loss': needs a fit without calibration.{field}, whose effect on the residual the "
            "expected loss lacks; leave out one of the two"
        )
    power = graph.experiment.power.with_defaults(*NOT_OF_THE_FIT)
    return ExpectedLoss(LABEL, probes=PROBES, power=power, **solved_inputs(graph))


def why_no_response(experiment: Experiment) -> str | None:
    """Return why the linear response of a fit cannot be compared with its spectra, to follow "needs", or None."""
    fit, size = experiment.calibration, size_of_instrument(experiment.instrument)
    if not isinstance(fit, GainFit) or fit.integrations_per_solve > 1 or fit.smooth_gains is not None:
        return "a fit of each integration by least squares, without smooth_gains"
    if size.baselines * size.channels.count > LARGEST * PAPER_SAMPLES:
        return f"at most {LARGEST:g} times the visibilities of the paper's array"
    return "power.pairs: same-baseline" if experiment.power.pairs == "redundant-group" else None


@memoize
def linear_response(graph: Graph) -> Task | None:
    """Return the task of the linear response to the EoR itself, or None if it cannot be compared with T.

    Calibrators must fit each integration by least squares and use the gains without smoothing. Spectra must be of each
    baseline with itself, because a fit responds differently on different baselines of a group. Large arrays have none.
    """
    if why_no_response(graph.experiment):
        return None
    power = graph.experiment.power.with_defaults(*NOT_OF_THE_FIT, "bins", "length_bin")
    even, odd = (
        Response(
            f"response to the EoR to first order, {parity}",
            power=power.with_defaults("wedge_buffer"),
            signal=corruption.data(graph, Variant(components=("eor",)), "even"),
            temporary=True,
            **solved_inputs(graph, parity),
        )
        for parity in corruption.PARITIES
    )
    return LinearResponse("linear response to the EoR", power=power, even=even, odd=odd)


def solved_inputs(graph: Graph, parity: str = "even") -> dict[str, Any]:
    """Return the fields of a `Solved` for the middle integration of one realization of the residual."""
    residual, times = graph.experiment.variants[SIGNAL_LOSS_VARIANTS[0]], graph.experiment.instrument.times
    return {**solved(graph, residual, parity), "integration": times.count // 2}


@dataclass(frozen=True)
class Solution:
    """The problem of one solve and its solution: gains (Nants, Nfreqs), model (Ntimes Nbls, Nfreqs), pairs (Nbls, 2).

    `used` are the samples that are not flagged, like the model, and `vectors` those of the baselines, m, (Nbls, 3). A
    solve has one integration, or several together.
    """

    problem: CalibrationProblem
    gains: np.ndarray
    model: np.ndarray
    used: np.ndarray
    pairs: np.ndarray
    vectors: np.ndarray
    frequency: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """Lengths of the baselines of each integration, m, (Ntimes Nbls,)."""
        return np.resize(np.linalg.norm(self.vectors, axis=1), len(self.model))

    def left_of(self, signal: np.ndarray) -> np.ndarray:
        """Return what is left of a signal, (Ntimes Nbls, Nfreqs), by the linear response of the fit."""
        from calstudy.calibrate.expected_loss import linear_response as response_to

        return response_to(self.problem, self.gains, self.model, signal) * self.used


class Solved(Calibrated):
    """A calibrated integration of simulated data, with those that were solved together with it."""

    calibration: Input
    calibrator: GainFit = called("calibration")
    power: PowerSettings
    integration: int

    def solution(self) -> Solution | None:
        """Return the solution, or None if an antenna or a channel has no gains or the integrations were not solved."""
        from calstudy.calibrate.preparation import problem_at
        from calstudy.products.selection import read_gains

        records = [
            found
            for found in map(Solve.from_json, read_json(self.calibration / SOLUTION)["records"])
            if found.integration <= self.integration < found.integration + found.n_integrations
        ]
        first, count = records[0].integration, records[0].n_integrations
        times = integration_times(self.data / DATA)[first : first + count]
        data, sky, noise = self.read(times)
        record = next(found for found in records if found.polarization == data.polarization_array[0])
        prepared = prepared_fit(self.calibrator, data, sky, noise)
        fitted = read_gains(self.calibration)
        gains = fitted.at(self.integration, prepared.data.numbers)
        problem = problem_at(prepared, self.calibrator, slice(0, count), 0, gains, record)
        if isinstance(problem, str) or fitted.flags[self.integration].any():
            return None
        model = read_visibilities(self.calibration / MODEL, times)
        return Solution(
            problem,
            gains,
            to_cube(model)[..., 0].reshape(problem.visibilities.shape),
            prepared.used[..., 0].reshape(problem.visibilities.shape),
            antenna_pairs(model),
            prepared.data.vectors,
            np.asarray(data.freq_array, float),
        )


class ExpectedLoss(Solved, stage="expected-loss", version=5):
    """The expected T of one calibrated integration, with those that were solved together with it."""

    probes: int

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the expected T in bins of k and of baseline length and delay."""
        from calstudy.calibrate.expected_loss import DelayModes
        from calstudy.calibrate.expected_loss import expected_transfer as expected_of

        solution = self.solution()
        if solution is None:
            raise InputError(
                f"expected-loss: integration {self.integration} was not calibrated in all antennas and channels, and "
                "flagged data are not supported"
            )
        modes = DelayModes(solution.frequency, self.power.taper)
        expected = expected_of(solution.problem, solution.gains, solution.model, modes, self.probes)
        found = binned(expected, solution.lengths, float(solution.frequency.mean()), self.power)
        save_spectrum(output / EXPECTED, found)
        return {"integration": self.integration, "probes": self.probes}

    def _cost(self) -> Cost:
        return cost_of_responses(self, self.probes, 1.5e9)


class Responses(Solved):
    """What one calibrated integration leaves of signals."""

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the amplitudes of the signals and of what is left of them; none if there are no gains."""
        from calstudy.calibrate.expected_loss import DelayModes

        solution, arrays = self.solution(), {}
        if solution is not None:
            modes = DelayModes(solution.frequency, self.power.taper)
            arrays = {"delay": modes.delay, "lengths": solution.lengths, "centre": solution.frequency.mean()}
            arrays |= self.amplitudes(solution, modes)
        np.savez(output / AMPLITUDES, allow_pickle=False, **arrays)
        return {}

    @abstractmethod
    def amplitudes(self, solution: Solution, modes: DelayModes) -> dict[str, np.ndarray]:
        """Return the amplitudes at the delays, by name."""


class Response(Responses, stage="response", version=2):
    """The linear response of one calibrated integration to a signal, without that of flagged samples."""

    signal: Input

    def amplitudes(self, solution: Solution, modes: DelayModes) -> dict[str, np.ndarray]:
        """Return the amplitudes of the signal and of what is left of it."""
        times = integration_times(self.data / DATA)[[self.integration]]
        eor = read_visibilities(self.signal / DATA, times)
        signal = solution.used * to_cube(eor)[0, rows_of(eor, solution.pairs), :, 0]
        return {"signal": modes.amplitudes(signal), "left": modes.amplitudes(solution.left_of(signal))}

    def _cost(self) -> Cost:
        return cost_of_responses(self, 1, 2.5e9)


def cost_of_responses(task: Solved, responses: int, memory: float) -> Cost:
    """Return the cost of some linear responses, with the bytes of memory for the paper's array."""
    size = size_of(task)
    samples = size.baselines * size.channels.count * task.calibrator.integrations_per_solve
    work = samples / PAPER_SAMPLES
    return Cost(1 + 0.8 * responses * work, LIBRARIES_MEMORY + memory * work, 1e6)


class OfResponses(Task):
    """What is made of the responses of one integration in two realizations of the noise."""

    power: PowerSettings
    even: Input
    odd: Input

    def read(self) -> tuple[Mapping[str, np.ndarray], Mapping[str, np.ndarray], BaselineModes] | None:
        """Return the amplitudes in both realizations and their modes, or None if one has no gains."""
        even, odd = (read_arrays(folder / AMPLITUDES) for folder in (self.even, self.odd))
        if not even or not odd:
            return None
        return even, odd, modes_of(even["delay"], even["lengths"], float(even["centre"]), self.power)


class LinearResponse(OfResponses, stage="linear-response", version=2, cost=Cost(0.1, disk=1e4)):
    """T and C of the linear response of one integration to the EoR."""

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write T and C in bands, crossed between the realizations as T by injection is, or null if not known."""
        bands = None
        if (found := self.read()) is not None:
            even, odd, modes = found
            answers = even["left"], odd["left"]
            transfer, cross = bin_response(modes, even["signal"], answers, BANDS, self.power.wedge_buffer)
            bands = [
                {"transfer": json_number(left), "cross_transfer": json_number(crossed)}
                for left, crossed in zip(transfer, cross, strict=True)
            ]
        write_json(output / RESPONSE, {"bands": bands})
        return {}


def binned(expected: ExpectedTransfer, lengths: np.ndarray, centre: float, power: PowerSettings) -> ExpectedBins:
    """Return an expected T of baselines (lengths in m, band centre in Hz) in bins of k and of length and delay."""
    modes = modes_of(expected.delay, lengths, centre, power)
    edges = make_bin_edges(power.bins)
    return bin_expected(modes, expected.transfer, expected.error, edges, power.wedge_buffer, power.length_bin)
