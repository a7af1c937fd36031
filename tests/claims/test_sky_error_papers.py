"""The papers on wrong sky models and beams: who may play their roles, and numbers on both sides of their thresholds."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calstudy.claims.bins import bias
from calstudy.experiment.files import load, override, parse_override, validate
from calstudy.experiment.model import PAPERS
from calstudy.power.spectra import SphericalSpectrum
from calstudy.studies.load import load_study

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
NAMES = ("barry2016", "byrne2019", "byrne2023", "joseph2020", "chokshi2024")
SIGNAL, SCALE = 200.0, 0.8


@pytest.fixture(scope="module")
def members():
    return load_study(EXPERIMENTS / "sky-errors.yaml").members


def paper(name):
    return PAPERS.make(name)


def spectrum(power, error=0.0):
    edges = np.linspace(0, 1.2, 31)
    k = (edges[1:] + edges[:-1]) / 2
    modes = np.arange(1.0, 31)
    values = np.broadcast_to(np.asarray(power, float), k.shape) + 0j
    errors = np.full(k.shape, error)
    return SphericalSpectrum(k, edges, values, modes, modes, modes, modes, errors, np.zeros(k.shape), True)


@cache
def hexagon():
    return load(EXPERIMENTS / "hexagon.yaml")


def run(fraction=0.0, error=0.0, leftover=0.0, product=1e-3, name="run", experiment=None, sky_model_error=0.1):
    """A run whose residual has parts of the power of the EoR: itself, its noise, and the error of what is left."""
    spectra = {
        "eor": spectrum(SIGNAL),
        "residual_without_eor": spectrum(fraction * SIGNAL / SCALE**2, error * SIGNAL / SCALE**2),
    }
    return SimpleNamespace(
        name=name,
        experiment=experiment or hexagon(),
        sky_model_error=sky_model_error,
        spherical=lambda variant, modes: spectra[variant],
        score=SimpleNamespace(
            flux_scale=SCALE,
            bin_edges=spectra["eor"].bin_edges,
            bias_error=np.full(spectra["eor"].k.size, np.hypot(error, leftover)),
        ),
        measured=lambda quantity: SimpleNamespace(value=product, scatter=0.1 * product),
    )


def with_fault(experiment, fault):
    """Return one member with a field that --set changes in all of them: reading all of them takes a second."""
    return validate(override(experiment.model_dump(mode="json"), *parse_override(fault)), EXPERIMENTS)


def verdicts(name, **runs):
    thing = paper(name)
    return [statement.evaluate(runs, thing.roles).verdict for statement in thing.statements()]


def test_the_bias_is_free_of_the_flux_scale_and_has_the_error_of_the_noise():
    found = bias(run(0.3, 0.1), 0.2, 0.5)
    used = spectrum(0).k
    modes = spectrum(0).n_modes[(used >= 0.2) & (used <= 0.5)]
    assert found.value == pytest.approx(0.3)
    assert found.uncertainty == pytest.approx(0.1 * np.sqrt(np.sum(modes**2)) / np.sum(modes))


def test_the_error_of_what_foregrounds_leave_does_not_average_down_over_bins():
    # All bins share the gains.
    assert bias(run(50, leftover=5), 0.2, 0.5).uncertainty == pytest.approx(5)


def test_a_bin_of_one_baseline_is_known_to_its_own_power():
    single = run(50, leftover=5)
    single.score.bias_error[:] = np.nan
    assert bias(single, 0.2, 0.5).uncertainty == pytest.approx(50)


def test_every_statement_has_the_runs_that_it_needs(members):
    for name in NAMES:
        thing = paper(name)
        played = {role: member for role, member in thing.usual_members.items() if member in members}
        assert set(played) == set(thing.roles)
        for role, member in played.items():
            assert thing.refusal(role, members[member]) is None, (name, role)
            assert name in [item.reference for item in members[member].papers]


@pytest.mark.parametrize(
    ("name", "role", "member", "reason"),
    [
        ("barry2016", "incomplete_sky_model", "sky-based", "no sources are missing"),
        ("barry2016", "complete_sky_model", "sky-based-incomplete", "sky.foregrounds.count"),
        ("barry2016", "incomplete_sky_model", "redcal-incomplete", "'redcal', not 'sky-based'"),
        ("barry2016", "complete_sky_model", "dead-dipoles", "as_built"),
        ("byrne2019", "redundant_incomplete", "redcal", "no sources are missing"),
        ("byrne2019", "redundant_complete", "sky-based", "'sky-based', not 'redcal'"),
        ("byrne2023", "delay_weighted", "sky-based-incomplete", "not 'delay-weighted'"),
        ("joseph2020", "dead_dipoles", "sky-based", "dead_tiles is 0"),
        ("chokshi2024", "one_beam", "deformed-beams-known", "calibration.assumed has instrument.as_built"),
        ("chokshi2024", "all_beams", "deformed-beams", "does not have the true instrument"),
        ("chokshi2024", "one_beam", "dead-dipoles", "amplitude_scatter is 0"),
    ],
)
def test_another_run_is_refused(members, name, role, member, reason):
    assert reason in paper(name).refusal(role, members[member])


@pytest.mark.parametrize(
    ("name", "role", "member", "fault", "reason"),
    [
        ("barry2016", "complete_sky_model", "sky-based", "corruption.effects=[{kind: mutual-coupling}]", "coupling"),
        (
            "byrne2019",
            "redundant_complete",
            "redcal",
            "instrument.as_built.positions.scatter=2 cm",
            "positions.scatter",
        ),
        ("byrne2023", "sky_based", "sky-based-incomplete", "instrument.as_built.dipoles.dead_tiles=0.3", "dead_tiles"),
        (
            "joseph2020",
            "dead_dipoles",
            "dead-dipoles",
            "instrument.as_built.positions.scatter=2 cm",
            "positions.scatter",
        ),
        ("chokshi2024", "one_beam", "deformed-beams", "instrument.as_built.dipoles.dead_tiles=0.3", "dead_tiles"),
        ("chokshi2024", "one_beam", "deformed-beams", "instrument.as_built.dipoles.amplitude_scatter=1 %", "0.01, not"),
        ("chokshi2024", "all_beams", "deformed-beams-known", "corruption.effects=[{kind: rfi}]", "rfi"),
    ],
)
def test_a_run_with_another_fault_is_refused(members, name, role, member, fault, reason):
    thing = paper(name)
    assert thing.refusal(role, members[member]) is None
    assert reason in thing.refusal(role, with_fault(members[member], fault))


def test_redundant_calibration_without_omnical_is_refused():
    calibration = "calibration={calibrator: redcal, steps: [firstcal, logcal, abscal]}"
    biased = load(EXPERIMENTS / "hexagon.yaml", overrides=[calibration])
    assert "no omnical" in paper("byrne2019").refusal("redundant_complete", biased)


@pytest.mark.parametrize(
    ("assumed", "accepted"),
    [
        ("amplitude_scatter: 10 %, seed: 3", True),
        ("amplitude_scatter: 10 %", False),
        ("dead_tiles: 0.1, seed: 3", False),
    ],
)
def test_known_beams_are_the_true_ones(assumed, accepted):
    dipoles = "instrument.as_built.dipoles={amplitude_scatter: 10 %, seed: 3}"
    known = f"calibration={{calibrator: sky-based, assumed: {{instrument.as_built.dipoles: {{{assumed}}}}}}}"
    run = load(EXPERIMENTS / "hexagon.yaml", overrides=[dipoles, known])
    assert (paper("chokshi2024").refusal("all_beams", run) is None) is accepted


def test_gains_of_any_kind_are_no_other_fault(members):
    changed = with_fault(members["sky-based"], "corruption.effects=[{kind: bandpass}]")
    assert paper("barry2016").refusal("complete_sky_model", changed) is None


def test_an_unrealistic_catalogue_decides_nothing():
    poor = run(50, sky_model_error=0.39)
    assert verdicts("barry2016", incomplete_sky_model=poor, complete_sky_model=run(0.01)) == [
        "not evaluated",
        "supported",
    ]


def test_delay_weighting_is_compared_with_the_same_sky_model(members):
    first, second = members["sky-based-incomplete"], members["delay-weighted-incomplete"]
    runs = {"sky_based": run(90, product=1e-3, experiment=first), "delay_weighted": run(1, 0.1, 1e-4)}
    assert verdicts("byrne2023", **runs | {"delay_weighted": run(1, product=1e-4, experiment=second)})[0] == "supported"
    assert verdicts("byrne2023", **runs) == ["not evaluated", "not evaluated"]


def test_verdicts_follow_the_numbers():
    assert verdicts("barry2016", incomplete_sky_model=run(50), complete_sky_model=run(0.01)) == [
        "supported",
        "supported",
    ]
    assert verdicts("barry2016", incomplete_sky_model=run(0.5), complete_sky_model=run(2)) == [
        "contradicted",
        "contradicted",
    ]
    # Above the EoR, but within the noise.
    assert verdicts("barry2016", incomplete_sky_model=run(1.5, 3), complete_sky_model=run(0.0, 3)) == [
        "undecided",
        "undecided",
    ]
    assert verdicts("byrne2019", redundant_incomplete=run(20), redundant_complete=run(0.1)) == [
        "supported",
        "supported",
    ]
    assert verdicts("byrne2019", redundant_incomplete=run(0.1), redundant_complete=run(20)) == [
        "contradicted",
        "contradicted",
    ]
    good, bad = run(1, product=1e-4), run(90, product=1e-3)
    assert verdicts("byrne2023", sky_based=bad, delay_weighted=good) == ["supported", "supported"]
    assert verdicts("byrne2023", sky_based=good, delay_weighted=bad) == ["contradicted", "contradicted"]
    assert verdicts("byrne2023", sky_based=run(0, 1), delay_weighted=good)[1] == "not evaluated"
    assert verdicts("joseph2020", dead_dipoles=run(1000 / SIGNAL * SCALE**2)) == ["supported", "supported"]
    assert verdicts("joseph2020", dead_dipoles=run(1e-3)) == ["contradicted", "contradicted"]
    assert verdicts("chokshi2024", one_beam=run(2000), all_beams=run(0.5)) == ["supported", "supported"]
    assert verdicts("chokshi2024", one_beam=run(20), all_beams=run(2)) == ["contradicted", "contradicted"]
    assert verdicts("chokshi2024", one_beam=run(20))[1] == "not evaluated"
