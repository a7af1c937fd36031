"""Errors of gains cover the scatter of fits to realizations of the noise, and fail where their assumptions do.

Each test fits 40 realizations and counts pulls, deviations from the truth over their errors, below 1 and 1.96. There
are 25,000 of them or more; deviations of an antenna without its smooth part have 27 independent numbers in 64 channels,
so that a count of 68 % has a standard deviation of less than 0.5 %. Errors of smooth gains from a prior have 10 of
these, and 0.7 %. Limits of 3 % and 2 % are four of them, and exceeded by errors that are 7 % too small or too large.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from toy import BASIS, FREQUENCIES, HEX, complex_normal, make_toy, scattered
from toy_structures import prior_structure, redundant_structure, turned

from calstudy.calibrate.basis import gain_vectors, make_basis
from calstudy.calibrate.degeneracy import fix_degeneracies
from calstudy.calibrate.deviation import estimate
from calstudy.calibrate.gain_errors import ErrorsInTime, gain_errors
from calstudy.calibrate.problem import CalibrationProblem, FitStructure, flag_weights, gain_products
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve
from calstudy.calibrate.synthetic import Case, Simulation
from calstudy.products.gain_errors import lost_in_noise

REALIZATIONS = 40
SEVEN, FIVE, TEN = (make_toy(positions, noise=0.0) for positions in (HEX, scattered(5), scattered(10, seed=7)))
# Amplitudes of antennas that differ by 30 %.
UNEQUAL = replace(TEN, gains=TEN.gains * np.random.default_rng(8).lognormal(0, 0.3, (10, 1)))
DEVIATION = 0.02
FINITE = ("prior", "both", "estimated")
"""Of each baseline by itself, that and shared by groups, and of each baseline with the deviation from the data."""
RIGHT = (0.6827, 0.95)
WRONG_GUESS = 5.0
"""First deviation over the true one, where the data tell it."""


def draw_in_basis(structure, rng):
    """Foregrounds of variance one per channel in a prior's basis, of each baseline, or of that and of its group."""
    vectors = {index: bucket.vectors for bucket in structure.basis.buckets for index in bucket.members}

    def drawn(index):
        return vectors[index] @ complex_normal(rng, (vectors[index].shape[1],))

    found = np.array([drawn(group) for group in structure.groups])
    if structure.prior == "both":
        shared = {group: drawn(group) for group in sorted(set(structure.groups.tolist()))}
        found += np.array([shared[group] for group in structure.groups.tolist()])
    return turned(structure, found)


def within_basis(structure, foregrounds):
    """The part of foregrounds that a fit can follow, so that it has no error but noise."""
    found = turned(structure, foregrounds)
    for bucket in structure.basis.buckets:
        for index in bucket.members:
            for p in np.flatnonzero(structure.groups == index):
                found[p] = bucket.vectors @ (bucket.vectors.T @ found[p])
    return turned(structure, found)


def flags_of(shape, structure):
    flags = np.zeros(shape, bool)
    flags[2, 10:14] = flags[:, 40] = flags[4] = True
    flags[(structure.antennas == 1).any(axis=1), 20:26] = True
    return flags


def structure_of(kind, toy):
    if kind == "redundant":
        return redundant_structure(toy)
    if kind == "both":
        return prior_structure(toy, "both")
    if kind not in FINITE:
        return toy.structure
    basis = make_basis(np.linalg.norm(toy.vectors, axis=1), FREQUENCIES, BASIS, prior=True)
    return replace(FitStructure.per_baseline(toy.antennas, len(toy.positions), basis), prior="own")


def parts_of(toy, kind, noise, flagged):
    """Return the structure of a fit, the foregrounds and their rms, and weights and what else is known."""
    structure = structure_of(kind, toy)
    sky = np.where((structure.antennas != toy.antennas).any(axis=1)[:, None], toy.foregrounds.conj(), toy.foregrounds)
    if kind in ("calamity", "redundant"):
        sky = within_basis(structure, sky)
    rms = np.sqrt(np.mean(np.abs(sky) ** 2))
    weights = flag_weights(flags_of(sky.shape, structure) if flagged else np.zeros(sky.shape, bool))
    known = {"sky_model": sky, "frozen": True} if kind == "sky" else {}
    if kind in FINITE:
        weights = np.where(weights > 0, (noise * rms) ** -2, 0)
        own, shared = WRONG_GUESS if kind == "estimated" else 1.0, 1.0 if kind == "both" else np.inf
        known = {"sky_model": sky, "deviations": (own * DEVIATION * rms, shared * DEVIATION * rms), "prior": "none"}
    return structure, sky, rms, {"weights": weights, **known}


def most_likely(problem):
    """The problem with the deviation that its data tell, after passes as those of a calibration."""
    for _ in range(10):
        solution = solve(problem, GaussNewton())
        found = estimate(problem, solution.gains, solution.model, (3, 4))
        problem = problem.with_fractions(found.deviations)
        if found.settled:
            break
    assert found.settled
    assert found.deviations[0] == pytest.approx(DEVIATION, rel=0.2)
    return problem


def pulls(toy=SEVEN, kind="sky", noise=0.01, flagged=False, received=False, wrong=1.0):
    """Return deviations over errors, (Nrealizations, 2, Nants, Nfreqs), of amplitudes and phases.

    Noise is relative to the rms of the foregrounds, and multiplied by the gains if it is `received` with them.
    Foregrounds deviate from the prior's mean by `wrong` times the prior's deviation.
    """
    structure, sky, rms, known = parts_of(toy, kind, noise, flagged)
    products, found = gain_products(toy.gains, structure.antennas), []
    for number in range(REALIZATIONS):
        rng = np.random.default_rng([5, number])
        drawn = noise * rms * complex_normal(rng, sky.shape)
        truth = sky + (wrong * DEVIATION * rms * draw_in_basis(structure, rng) if kind in FINITE else 0)
        data = products * (truth + drawn) if received else products * truth + drawn
        problem = toy.problem(structure, visibilities=data, **known)
        if received:
            # The weights of the first fit's gains, as of a second pass.
            problem = problem.weighted_by(solve(problem, GaussNewton()).gains)
        if kind == "estimated":
            problem = most_likely(problem)
        solution = solve(problem, GaussNewton())
        # Those of a prior do not follow the residual: one set is good for several realizations.
        if kind not in ("prior", "both") or number % 10 == 0:
            errors = gain_errors(problem, solution.gains, solution.model, FREQUENCIES)
        aligned = fix_degeneracies(solution.gains, solution.model, replace(problem, initial_gains=toy.gains))[0]
        change = errors.determined(np.log(aligned / toy.gains))
        found.append([change.real * np.abs(solution.gains) / errors.amplitude, change.imag / errors.phase])
    return np.array(found)


def covered(values):
    """Return the fractions below 1 and 1.96."""
    known = np.abs(values[np.isfinite(values)])
    assert known.size > 500
    return np.mean(known < 1), np.mean(known < 1.96)


def is_covered(values, limits=(0.03, 0.02)):
    return all(abs(found - right) < limit for found, right, limit in zip(covered(values), RIGHT, limits, strict=True))


@pytest.mark.parametrize(
    ("toy", "settings"),
    [
        (SEVEN, {}),
        (SEVEN, {"noise": 0.5}),
        (SEVEN, {"flagged": True, "received": True}),
        (SEVEN, {"kind": "calamity", "flagged": True}),
        # As long as all others together.
        pytest.param(SEVEN, {"kind": "redundant"}, marks=pytest.mark.slow),
        (FIVE, {"kind": "prior"}),
        (SEVEN, {"kind": "both"}),
        pytest.param(FIVE, {"kind": "estimated"}, marks=pytest.mark.slow),
        pytest.param(UNEQUAL, {}, marks=pytest.mark.slow),
        pytest.param(UNEQUAL, {"kind": "calamity"}, marks=pytest.mark.slow),
    ],
)
@pytest.mark.chain
def test_errors_cover_the_scatter_of_noise(toy, settings):
    found = pulls(toy, **settings)
    assert is_covered(found)
    assert is_covered(found[:, 0])
    assert is_covered(found[:, 1])
    # Fewer numbers: four channels, and one antenna of five to ten.
    assert is_covered(found[..., [0, 1, -2, -1]], (0.06, 0.04))
    assert all(is_covered(found[:, :, antenna], (0.06, 0.04)) for antenna in range(found.shape[2]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("toy", "settings", "part"),
    [
        (FIVE, {"kind": "calamity", "flagged": True}, np.s_[:]),
        (SEVEN, {"kind": "calamity", "noise": 0.1}, np.s_[..., [0, 1, -2, -1]]),
        (UNEQUAL, {"kind": "calamity", "received": True}, np.s_[:]),
        (SEVEN, {"noise": 1.0}, np.s_[:]),
    ],
)
def test_errors_are_too_small_where_the_page_says_so(toy, settings, part):
    """Few antennas with flags, the edges of the band, noise that the weights do not follow, and second orders."""
    assert covered(pulls(toy, **settings)[part])[0] < RIGHT[0] - 0.05


@pytest.mark.chain
@pytest.mark.parametrize(
    ("toy", "kind", "flagged"),
    [
        (SEVEN, "calamity", False),
        (SEVEN, "redundant", False),
        (UNEQUAL, "calamity", False),
        (TEN, "prior", True),
        (TEN, "calamity", True),
    ],
)
def test_errors_by_antenna_are_those_of_the_whole_matrix(toy, kind, flagged, monkeypatch):
    structure, sky, rms, known = parts_of(toy, kind, 0.01, flagged)
    drawn = 0.01 * rms * complex_normal(np.random.default_rng(6), sky.shape)
    problem = toy.problem(structure, visibilities=gain_products(toy.gains, structure.antennas) * sky + drawn, **known)
    solution = solve(problem, GaussNewton())
    whole = gain_errors(problem, solution.gains, solution.model, FREQUENCIES)
    monkeypatch.setattr("calstudy.calibrate.gain_errors.MOST_UNKNOWNS", 0)
    found = gain_errors(problem, solution.gains, solution.model, FREQUENCIES)
    for name in ("amplitude", "phase"):
        ratio = getattr(found, name) / getattr(whole, name)
        known = np.isfinite(ratio)
        assert np.array_equal(known, np.isfinite(whole.phase))
        if flagged and kind == "calamity":
            # Phases beside the gap that antenna 1 alone has: what other antennas have there, it lacks.
            ratio[1] = 1
        assert abs(np.mean(ratio[known]) - 1) < 0.01
        assert np.std(ratio[known]) < 0.03
        assert np.abs(ratio[known] - 1).max() < 0.15


@pytest.mark.parametrize("prior", [False, True])
def test_what_foregrounds_absorb_is_kept_for_a_fringe(prior):
    # Of the longest baseline, of 56 m: 393 s at 187 MHz.
    simulation = Simulation(Case(antennas=8, channels=48, extent=56.0, band=20e6, integration=180.0))
    free, days = simulation.structure(), 180 / 86400
    structure = free
    if prior:
        lengths = np.linalg.norm(np.diff(simulation.positions[simulation.antennas], axis=1)[:, 0], axis=1)
        basis = make_basis(lengths, simulation.case.frequencies, BASIS, prior=True)
        structure = replace(FitStructure.per_baseline(simulation.antennas, 8, basis), prior="own")
    errors = ErrorsInTime(simulation.case.frequencies, 56.0)

    def pair_of(integration, deviation):
        sky = simulation.foregrounds(integration)
        known = {"structure": structure, "sky_model": sky, "deviations": (deviation, math.inf)} if prior else {}
        problem = replace(simulation.problem(integration, free), **known)
        found = errors.of(problem, simulation.gains, sky, integration * days)
        return found, gain_errors(problem, simulation.gains, sky, simulation.case.frequencies)

    pair_of(0, 1.0)
    later, alone = pair_of(2, 1.02)
    assert later.degrees == alone.degrees
    for name in ("amplitude", "phase"):
        ratio = getattr(later, name) / getattr(alone, name)
        # As near as inverting antenna by antenna comes. More antennas change less: 0.2 % with 24.
        assert 0 < np.std(ratio) < 0.02
        assert np.mean(ratio) == pytest.approx(1, abs=0.005)
    for integration, deviation in ((3, 1.0), (4, 2.0) if prior else (9, 1.0)):
        found, alone = pair_of(integration, deviation)
        assert np.array_equal(found.amplitude, alone.amplitude)


def test_errors_between_flagged_edges_are_as_if_there_were_no_such_channels():
    """Sequences of all channels, cut at the edges, are more: without these, errors are 11 % too small on average."""
    toy, band = make_toy(HEX), slice(8, 56)
    flags = np.ones(toy.foregrounds.shape, bool)
    flags[:, band] = False

    def errors_in(channels, modelled):
        basis = make_basis(np.linalg.norm(toy.vectors, axis=1), FREQUENCIES[channels], BASIS, band=modelled)
        structure = FitStructure.per_baseline(toy.antennas, len(toy.positions), basis)
        gains, start = toy.gains[:, channels], np.ones(toy.gains.shape, complex)[:, channels]
        weights = flag_weights(flags[:, channels])
        problem = CalibrationProblem(structure, toy.visibilities[:, channels], weights, start)
        return gain_errors(problem, gains, toy.foregrounds[:, channels], FREQUENCIES[channels])

    flagged, inside = errors_in(slice(None), band), errors_in(band, slice(None))
    assert flagged.smooth_fraction == inside.smooth_fraction
    for name in ("amplitude", "phase"):
        np.testing.assert_allclose(getattr(flagged, name)[:, band], getattr(inside, name), rtol=1e-9)


def test_errors_of_a_prior_that_is_too_narrow_are_too_small():
    within, within_two = covered(pulls(FIVE, kind="prior", wrong=3.0))
    # The prior makes nearly all of the error: as if it were a third.
    assert 0.26 < within < 0.4
    assert within_two < 0.7


def test_what_has_no_errors_says_why():
    toy = make_toy(scattered(5))
    smooth = toy.problem(replace(toy.structure, gain_vectors=gain_vectors(FREQUENCIES, 200e-9)))
    assert "smooth" in gain_errors(smooth, toy.gains, toy.foregrounds, FREQUENCIES)
    three = make_toy(scattered(3))
    assert "as many unknowns" in gain_errors(three.problem(), three.gains, three.foregrounds, FREQUENCIES)


def fitted_with_a_weak_antenna(kind, weighting, size):
    """Gains and their errors in a fit where antenna 2 receives the sky `size` times as well as others.

    The noise is a tenth of the visibilities of others, and the same in all.
    """
    structure, sky, rms, known = parts_of(TEN, kind, 0.1, flagged=False)
    drawn = 0.1 * rms * complex_normal(np.random.default_rng(3), sky.shape)
    gains = TEN.gains * np.where(np.arange(len(TEN.gains)) == 2, size, 1)[:, None]
    given = TEN.problem(structure, visibilities=gain_products(gains, structure.antennas) * sky + drawn, **known)
    problem, solution = given, solve(given, GaussNewton())
    for _ in range(6 if weighting == "gains" else 0):
        problem = given.weighted_by(solution.gains)
        solution = solve(replace(problem, initial_gains=solution.gains), GaussNewton())
    return gain_errors(problem, solution.gains, solution.model, FREQUENCIES)


@pytest.mark.parametrize(("kind", "weighting"), [("sky", "flags"), ("sky", "gains"), ("calamity", "flags")])
def test_an_antenna_whose_gains_are_noise_is_told_from_a_weak_one(kind, weighting):
    """A dead antenna takes most of the weights of its fit, and the noise of all others with it."""
    dead, weak = (fitted_with_a_weak_antenna(kind, weighting, size) for size in (0.0, 0.3))
    assert np.array_equal(np.flatnonzero(dead.lost), [2])
    assert not weak.lost.any()
    assert not dead.drowned
    # Others are determined as if it were not there: amplitudes by the sum over 8 baselines, twice the signal to noise
    # of a visibility.
    others = np.delete(dead.signal_to_noise, 2)
    assert np.median(others) == pytest.approx(np.sqrt(2 * 8) * 10, rel=0.35)
    if kind == "sky":
        # The Rayleigh distribution has the median sqrt(log 4), and 64 channels scatter by 10 % of it.
        assert dead.signal_to_noise[2] == pytest.approx(np.sqrt(np.log(4)), rel=0.3)
        assert dead.noise_alone[2] == pytest.approx(np.sqrt(2))
        # Its visibilities have a signal to noise of three.
        assert weak.signal_to_noise[2] == pytest.approx(np.sqrt(2 * 9) * 3, rel=0.3)


@pytest.mark.parametrize(("noise", "interference", "lost"), [(0.5, 0, False), (4.0, 0, True), (0.01, 100, False)])
def test_gains_that_are_lost_in_noise_are_told_from_others(noise, interference, lost):
    """Noise relative to the visibilities of a known sky; interference in a channel drives its gains as far as noise."""
    toy = make_toy(HEX, noise=0.0)
    sky, rng = toy.foregrounds, np.random.default_rng(1)
    rms = np.sqrt(np.mean(np.abs(sky) ** 2))
    data = gain_products(toy.gains, toy.antennas) * sky + noise * rms * complex_normal(rng, sky.shape)
    data[:, 30] += interference * rms
    weights = flag_weights(np.zeros(sky.shape, bool))
    problem = toy.problem(visibilities=data, weights=weights, sky_model=sky, frozen=True)
    solution = solve(problem, GaussNewton())
    size = np.abs(solution.gains)
    assert (size.max() > 5 * np.median(size)) == (lost or interference > 0)
    errors = gain_errors(problem, solution.gains, solution.model, FREQUENCIES)
    warnings = lost_in_noise(solution.gains[..., None, None], errors.amplitude[..., None, None], errors.unevenness)
    assert len(warnings) == lost
    assert not errors.lost.any()
    # With noise of four times the visibilities no antenna is at fault.
    assert errors.drowned == lost
    assert all("integrations_per_solve" in text for text in warnings)


def test_errors_of_gains_add_to_the_noise_of_baselines_that_were_not_fitted_alone():
    """A fit takes as much noise out of the baselines that it fits as it has unknowns: 13 of 28 numbers per channel."""
    sky, noise = SEVEN.foregrounds, 0.05
    rms = np.sqrt(np.mean(np.abs(sky) ** 2))
    fitted = np.arange(len(sky)) % 3 > 0
    basis = make_basis(np.linalg.norm(SEVEN.vectors[fitted], axis=1), FREQUENCIES, BASIS)
    structure = FitStructure.per_baseline(SEVEN.antennas[fitted], 7, basis)
    products, powers, added = gain_products(SEVEN.gains, SEVEN.antennas), [], []
    for number in range(REALIZATIONS):
        drawn = noise * rms * complex_normal(np.random.default_rng([6, number]), sky.shape)
        data = products * sky + drawn
        known = {"sky_model": sky[fitted], "frozen": True, "weights": flag_weights(np.zeros(sky[fitted].shape, bool))}
        problem = SEVEN.problem(structure, visibilities=data[fitted], **known)
        found = solve(problem, GaussNewton()).gains
        errors = gain_errors(problem, found, sky[fitted], FREQUENCIES)
        variance = (errors.amplitude / np.abs(found)) ** 2 + errors.phase**2
        added.append(np.abs(sky * products) ** 2 * variance[SEVEN.antennas].sum(axis=1))
        misfit = (data / gain_products(found, SEVEN.antennas) - sky) * products
        powers.append(np.abs(misfit) ** 2 / (noise * rms) ** 2)
    power, added = np.mean(powers, axis=0), np.mean(added, axis=0) / (noise * rms) ** 2
    # 36,000 samples of the noise, and gains of second order: 0.05^2 times a few.
    assert power[fitted].mean() == pytest.approx(15 / 28, rel=0.03)
    assert (1 + added[fitted]).mean() > 1.3
    # Correlations of antennas, which errors do not have, make 8 % of it, by the inverse of the matrix of a channel.
    assert power[~fitted].mean() == pytest.approx((1 + added[~fitted]).mean(), rel=0.15)
    assert power[~fitted].mean() > 1.3
