"""Claims on run time and memory, and on limits (paper §Computational Runtime, §Caveats and Limitations)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calstudy.claims.bins import difference_of_losses
from calstudy.papers.calamity2022.method import HUNDREDTH, K_WINDOW
from calstudy.products.run_times import PowerLaw, RunTimeTable, fit_power_law
from calstudy.results.reader import Results
from calstudy.verdicts.criterion import AtLeast, AtMost, Finding, Within
from calstudy.verdicts.statement import Sentence, Source, Unevaluated

COMPUTATION = Source("Computational Runtime", ("run_time",))
QUARTER = 0.25
QUADRATIC, LINEAR, CONSTANT = (
    (Within(power - QUARTER, power + QUARTER), "the exponent, to a quarter") for power in (2, 1, 0)
)
HUNDREDS = 300
MINUTES = AtMost(600)
THOUSANDS_OF_ANTENNAS = 3000
AROUND_HUNDRED = 100
FASTER = 30
"""The paper's factor between CPU and GPU."""
CORES = 4
"""Cores of the paper's CPU, two with two each."""
HALF_ORDER = 10**0.5


def _paper_solve(run: RunTimeTable, antennas: int) -> Finding:
    """Return the seconds of the paper's solver on the GPU for so many antennas; a bound if its steps are."""
    law, steps = run.scaling("rows", "paper-step", device="gpu"), run.steps_to("0.01")
    return steps._replace(value=steps.value * float(law.at(antennas)))


def _exponent(law: PowerLaw) -> Finding:
    return Finding(law.exponent, law.error)


QUADRATIC_SENTENCE = Sentence(
    "quadratic-in-antennas", "the computational time for a gradient update follows quadratic scaling with N_ant"
)


@COMPUTATION.states(
    QUADRATIC_SENTENCE,
    "exponent of the median time of the paper's step against the number of antennas, one core",
    *QUADRATIC,
)
def paper_step_quadratic_in_antennas(run: RunTimeTable) -> Finding:
    return _exponent(run.scaling("rows", "paper-step"))


@COMPUTATION.states(QUADRATIC_SENTENCE, "the same of this project's own Adamax step, without padding", *QUADRATIC)
def own_step_quadratic_in_antennas(run: RunTimeTable) -> Finding:
    return _exponent(run.scaling("rows", "adamax-step"))


LINEAR_SENTENCE = Sentence(
    "linear-in-longest-baseline",
    "the linear scaling of the gradient update computations with maximum baseline length ∝ N_vec^max",
)


@COMPUTATION.states(
    LINEAR_SENTENCE,
    "exponent of the median time of the paper's step against the longest baseline, 10 antennas, one core",
    *LINEAR,
)
def paper_step_linear_in_longest_baseline(run: RunTimeTable) -> Finding:
    return _exponent(run.scaling("line", "paper-step"))


@COMPUTATION.states(
    LINEAR_SENTENCE,
    "the same against the number of foreground vectors of the longest baseline, which the buffer keeps above zero",
    *LINEAR,
)
def paper_step_linear_in_vectors(run: RunTimeTable) -> Finding:
    return _exponent(run.scaling("line", "paper-step", "vectors"))


@COMPUTATION.states(
    "the computational cost of each gradient update step is dominated by the sum over u A",
    "time of that sum and its gradient alone over that of the paper's step, largest array, one core",
    AtLeast(0.5),
    "more than all the rest",
)
def sum_dominates_step(run: RunTimeTable) -> Finding:
    return Finding(float(run.medians("rows", "paper-sum")[-1] / run.medians("rows", "paper-step")[-1]), 0.0)


MEMORY_SENTENCE = Sentence("memory", "memory use is dominated by the N_vec N_freq N_bl element A matrix")


@COMPUTATION.states(
    MEMORY_SENTENCE,
    "bytes of A over the memory that the paper's step takes in all, temporaries of its size included; largest array",
    AtLeast(0.5),
    "more than all the rest",
)
def basis_dominates_memory(run: RunTimeTable) -> Finding:
    return Finding(float(run.column("rows", "basis_bytes")[-1] / run.column("rows", "paper_memory")[-1]), 0.0)


@COMPUTATION.states(
    MEMORY_SENTENCE,
    "exponent of the memory that the paper's step takes against the bytes of A, over the arrays in rows",
    *LINEAR,
)
def memory_grows_like_basis(run: RunTimeTable) -> Finding:
    return _exponent(fit_power_law(run.column("rows", "basis_bytes"), run.column("rows", "paper_memory")))


THOUSANDS_SENTENCE = Sentence(
    "thousands-of-steps",
    "given a learning rate of 0.01, CALAMITY requires thousands of gradient descent steps to converge",
)
THOUSANDS = (Within(1e3, 1e4), "thousands, not hundreds or tens of thousands")


@COMPUTATION.states(THOUSANDS_SENTENCE, "steps until the loss is within 5 % of its minimum, one array", *THOUSANDS)
def thousands_of_steps_to_five_percent(run: RunTimeTable) -> Finding:
    return run.steps_to("0.05")


@COMPUTATION.states(THOUSANDS_SENTENCE, "steps until the loss is within 1 % of its minimum, one array", *THOUSANDS)
def thousands_of_steps_to_one_percent(run: RunTimeTable) -> Finding:
    return run.steps_to("0.01")


@COMPUTATION.states(
    "CALAMITY performs ≳ 30 times faster on a GPU than on a CPU on arrays with hundreds of antennas",
    "median time of the paper's step on the paper's CPU of four cores over that on the GPU, largest array; by that on "
    "one core, which is one to four times as long",
    AtLeast(FASTER),
    "the paper's factor",
)
def gpu_thirty_times_faster(run: RunTimeTable) -> Finding:
    on_one = float(run.medians("rows", "paper-step")[-1] / run.medians("rows", "paper-step", "gpu")[-1])
    return Finding(on_one, 0.0, "at most") if on_one < FASTER else Finding(on_one / CORES, 0.0, "at least")


@COMPUTATION.states(
    "gradient update steps on the GPU run on the order of 20-30 ms for arrays with ∼ 100 antennas",
    "median time of the paper's step on the GPU, the array closest to 100 antennas, s",
    Within(0.02 / HALF_ORDER, 0.03 * HALF_ORDER),
    "20 to 30 ms, to half an order of magnitude either way",
)
def gpu_step_at_hundred_antennas(run: RunTimeTable) -> Finding:
    closest = int(np.argmin(np.abs(run.column("rows", "antennas", "gpu") - AROUND_HUNDRED)))
    return Finding(float(run.medians("rows", "paper-step", "gpu")[closest]), 0.0)


@COMPUTATION.states(
    "the run time on the GPU appears constant",
    "exponent of the median time of the paper's step against the longest baseline, 10 antennas, GPU",
    *CONSTANT,
)
def gpu_step_constant_in_longest_baseline(run: RunTimeTable) -> Finding:
    return _exponent(run.scaling("line", "paper-step", device="gpu"))


@COMPUTATION.states(
    "solutions for arrays with hundreds of antennas within minutes on a single computer node with a GPU",
    f"paper's steps on the GPU to 1 % above the minimum, extrapolated to {HUNDREDS} antennas, s",
    MINUTES,
    "ten minutes are still minutes",
)
def paper_solve_in_minutes(run: RunTimeTable) -> Finding:
    return _paper_solve(run, HUNDREDS)


@COMPUTATION.states(
    "and for thousands of element arrays on timescales of hours",
    f"paper's steps on the GPU to 1 % above the minimum, extrapolated to {THOUSANDS_OF_ANTENNAS} antennas, s",
    AtMost(86_400),
    "less than a day",
)
def paper_solve_of_thousands_in_hours(run: RunTimeTable) -> Finding:
    return _paper_solve(run, THOUSANDS_OF_ANTENNAS)


@COMPUTATION.states(
    "GPU acceleration is critical for our technique for an interferometer with ≳ 10 antennas in a reasonable amount of "
    "time (Abstract)",
    "paper's steps on one core to 1 % above the minimum, the array that is closest to that whose steps were counted, s",
    AtLeast(MINUTES.high),
    "without it ten minutes at least, which would still be minutes",
)
def gpu_critical_for_paper_solver(run: RunTimeTable) -> Finding:
    closest = int(np.argmin(np.abs(run.column("rows", "antennas") - run.table["descent"]["antennas"])))
    steps = run.steps_to("0.01")
    return steps._replace(value=steps.value * float(run.medians("rows", "paper-step")[closest]))


CAVEATS = Source("Caveats and Limitations", ("minimally_redundant",))


@replace(CAVEATS, roles=("minimally_redundant", "other_channels")).states(
    "the degree and extent of this signal loss will also depend on the bandwidth and channelization resolution",
    "T free of the flux scale with channels of another width in the same band minus that with the paper's, outside the "
    "wedge, k >= 0.2; absolute value",
    AtLeast(HUNDREDTH),
    "depends is more than a hundredth of the EoR",
)
def loss_depends_on_channels(run: Results, other: Results) -> Finding:
    first, second = (item.experiment.instrument.channels for item in (run, other))
    if first.width == second.width or not np.isclose(first.width * first.count, second.width * second.count):
        raise Unevaluated("the runs have the same channels, or not the same band")
    found = difference_of_losses(other, run, K_WINDOW)
    return found._replace(value=abs(found.value))


@CAVEATS.states(
    "we do not expect CALAMITY to be able to correct high-delay systematics that are direction dependent: high RM "
    "polarization leakage",
    "mean P^R without EoR over mean P^S outside the wedge, with polarized foregrounds that leak into xx",
    AtLeast(1, 2),
    "what is not corrected stays above the EoR",
)
def leakage_is_not_corrected(run: Results) -> Finding:
    raise Unevaluated("the sky of the paper's studies is not polarized, and that of others is not looked at")


@CAVEATS.states(
    "main-lobe filtering prior to bandpass calibration could still allow for CALAMITY to remove fine-frequency "
    "bandpass features",
    "mean P^R without EoR over mean P^S outside the wedge, with coupled antennas and data filtered in fringe rate",
    AtMost(1, 2),
    "what is removed is below the EoR",
)
def filter_rescues_coupling(run: Results) -> Finding:
    raise Unevaluated("there is no filter in fringe rate before calibration")
