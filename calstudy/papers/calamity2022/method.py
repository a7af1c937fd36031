"""Claims on the method itself: its basis, its degeneracies, its loss function, and its test data."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import pdist

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.calibrate.basis import delay_half_widths, make_basis
from calstudy.calibrate.settings import ForegroundFit
from calstudy.claims.bins import mean_of_common_errors, median_and_scatter
from calstudy.claims.realizations import PooledResults
from calstudy.instrument.layouts import make_array
from calstudy.papers.calamity2022.calibration import TWOFOLD
from calstudy.results.reader import Results
from calstudy.verdicts.criterion import AtMost, Finding, Within
from calstudy.verdicts.statement import Sentence, Source, Unevaluated

METHOD = Source("CALAMITY", ("minimally_redundant",))
REDUCTION = Source("Reduction of Simulation Products and Power Spectra", ("minimally_redundant",), True)
FAR = 0.5
"""h/Mpc, far from the wedge of all baselines of the paper's arrays."""
K_WINDOW = 0.2
HUNDREDTH = 0.01
"""Fraction of the EoR below which a difference is not counted as loss."""

VECTORS = Sentence(
    "number-of-vectors",
    "the number of DPSS vectors required to describe band-limited signals with delay half-width of ≈ τ is N_vec ≈ W",
)


def _vectors_over_bandwidth(run: Results, buffered: bool) -> Finding:
    """Return the number of vectors over 2 N Δν τ, median and scatter over baselines."""
    instrument, calibration = run.experiment.instrument, run.experiment.calibration
    if not isinstance(calibration, ForegroundFit):
        raise Unevaluated(f"{calibration.label} fits no foregrounds")
    channels, lengths = instrument.channels, pdist(make_array(instrument).enu)
    frequencies = channels.frequencies
    vectors = np.empty(lengths.size)
    for bucket in make_basis(lengths, frequencies, calibration.basis).buckets:
        vectors[bucket.members] = bucket.vectors.shape[1]
    delay = delay_half_widths(lengths, calibration.basis) if buffered else lengths / SPEED_OF_LIGHT
    return median_and_scatter(vectors / (2 * channels.count * channels.width * delay))


@METHOD.states(
    VECTORS, "vectors of a baseline over its W with the light travel time between its antennas as τ; median", *TWOFOLD
)
def vectors_like_bandwidth_of_horizon(run: Results) -> Finding:
    return _vectors_over_bandwidth(run, buffered=False)


@METHOD.states(
    VECTORS,
    "vectors of a baseline over its W with the largest delay that is modelled as τ, buffer included; median",
    *TWOFOLD,
)
def vectors_like_bandwidth_of_basis(run: Results) -> Finding:
    return _vectors_over_bandwidth(run, buffered=True)


LIMITED = Sentence(
    "loss-limited-to-wedge",
    "doing this, instead of sky-based modeling, ignores correlations between the baselines and limits any increases in "
    "variance and signal loss, to the foreground wedge",
)


def _far_from_wedge(run: Results) -> Finding:
    """Return 1 - C^2 / T far from the wedge, the part of the EoR that is lost there."""
    found = run.transfer("outside-wedge")
    far = found.k >= FAR
    return _lost(mean_of_common_errors(found.squared_coherence[far], found.squared_coherence_error[far]))


def _far_from_wedge_of_all(run: PooledResults) -> Finding:
    return _lost(run.mean("squared_coherence", "outside-wedge", FAR))


def _beside_gains(lost: Finding, run: Results | PooledResults) -> Finding:
    """Subtract what gains of every antenna and channel take, by counting: their unknowns over the data."""
    if getattr(run.experiment.calibration, "gain_delay", None) is not None:
        raise Unevaluated("gains are restricted in delay, so that counting does not tell what they take")
    antennas = len(make_array(run.experiment.instrument).enu)
    # All antennas share a phase.
    return lost._replace(value=lost.value - (2 * antennas - 1) / (antennas * (antennas - 1)))


@METHOD.states(
    LIMITED,
    "1 - C²/T, the part of the EoR that is lost outside the wedge at k >= 0.5; reading in which gains lose "
    "nothing either",
    AtMost(HUNDREDTH),
    "none, to a hundredth",
    pooled=_far_from_wedge_of_all,
)
def loss_limited_to_wedge(run: Results) -> Finding:
    return _far_from_wedge(run)


@METHOD.states(
    LIMITED,
    "1 - C²/T outside the wedge at k >= 0.5, less (2N - 1) / (N (N - 1)), which the gains of N antennas take by "
    "counting; reading in which the sentence is on the foreground models",
    AtMost(HUNDREDTH),
    "none, to a hundredth",
    pooled=lambda run: _beside_gains(_far_from_wedge_of_all(run), run),
)
def loss_to_models_limited_to_wedge(run: Results) -> Finding:
    return _beside_gains(_far_from_wedge(run), run)


def _lost(left: Finding) -> Finding:
    return left._replace(value=1 - left.value)


@METHOD.states(
    "the cost function is completely degenerate with respect to a single complex gain multiplier",
    "number of directions of the gains in which the cost has no curvature",
    Within(2, 2),
    "the real and the imaginary part of one multiplier",
)
def one_complex_degeneracy(run: Results) -> Finding:
    raise Unevaluated(
        "a run does not write the curvature of its cost; step 2.1 of the validation ladder finds that a phase of every "
        "channel, one real scale, a tilt over the array and what is as smooth as the foregrounds are free"
    )


@REDUCTION.states(
    "our foreground simulation contains beam interpolation artifacts which set an intrinsic systematics floor at "
    "≈ -45 dB below the foreground brightness levels",
    "largest amplitude of foregrounds beyond the wedge over that inside, in dB",
    Within(-47.5, -42.5),
    "≈ -45 dB, to half an order of magnitude of power, of which these are the amplitudes",
)
def artefacts_at_minus_45_db(run: Results) -> Finding:
    raise Unevaluated(
        "all variants of a run have EoR or noise above that floor; the figure 'delay-floor' measures it for every "
        "interpolation of the beam"
    )


def _known_input(run: PooledResults) -> Finding:
    return run.mean("eor", "outside-wedge", K_WINDOW)


@REDUCTION.states(
    "we fringe-stop each residual and average coherently; this leads to negligible signal loss for the baseline "
    "lengths under consideration",
    "P^S after the average over the power that the sky was drawn from, outside the wedge, k >= 0.2",
    Within(0.95, 1.05),
    "negligible is less than a twentieth",
    pooled=_known_input,
)
def average_loses_nothing(run: Results) -> Finding:
    raise Unevaluated("of one sky, P^S has the sample variance; needs realizations, which know the power put in")
