"""Numbers that are not finite, in one part of a measurement: a step never passes by its other parts."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from observations import small_instrument

from calstudy.base.files import json_number
from calstudy.base.visibilities import flag_cube, from_cube, to_cube
from calstudy.claims import bins
from calstudy.instrument.telescope import make_template
from calstudy.power.spectra import SphericalSpectrum
from calstudy.validation.step import STEPS, Findings, Step, largest, mean_over
from calstudy.validation.steps import chain, estimator, noisy_calibration, simulation, single_fit
from calstudy.verdicts.criterion import Finding

NAN = float("nan")


def verdicts(step: Step, found: Findings) -> dict[str, str]:
    """Return the verdicts on what a step measured, by the name of the limit."""
    numbers = {
        name: {"value": json_number(finding.value), "uncertainty": json_number(finding.uncertainty)}
        for name, finding in found.values.items()
    }
    return {verdict.name.partition(" ")[2]: verdict.verdict for verdict in step.judge(numbers)}


@pytest.mark.parametrize("values", [[NAN, 1.0, 2.0], [1.0, NAN, 2.0], [1.0, 2.0, NAN]])
def test_no_number_is_larger_than_one_that_is_not_known(values):
    assert np.isnan(largest(values))
    assert largest([1.0, 2.0]) == 2.0


def test_a_mean_over_modes_does_not_leave_out_one_that_is_not_known():
    values, used = np.array([[1.0, NAN], [3.0, 2.0]]), np.array([[True, False], [True, True]])
    assert mean_over(values, used).value == pytest.approx(2.0)
    assert np.isnan(mean_over(values, np.ones((2, 2), bool)).value)


@pytest.mark.parametrize("pattern", ["single channels", "bands", "30 % at random"])
@pytest.mark.parametrize(
    ("spoiled", "influence", "bias"),
    [("nothing", "PASS", "PASS"), ("gains", "not evaluated", "PASS"), ("residual", "not evaluated", "not evaluated")],
)
def test_a_calibrator_that_returns_no_numbers_does_not_pass(monkeypatch, pattern, spoiled, influence, bias):
    """Gains, or the residual of one baseline, are NaN in data with one of the patterns of flags."""
    template, rng = make_template(small_instrument()), np.random.default_rng(1)
    shape = (template.Ntimes, template.Nbls, template.Nfreqs, template.Npols)
    noise = {parity: from_cube(template, rng.standard_normal((*shape, 2)) @ (1, 1j)) for parity in ("even", "odd")}
    model = from_cube(template, np.ones(shape, complex))
    chosen = noisy_calibration.patterns(noise["even"])[pattern]

    def calibrated(_settings, data, _sky):
        residual, gains = data.copy(), np.ones(5, complex)
        to_cube(residual)[flag_cube(data)] = 0
        if np.array_equal(flag_cube(data)[..., 0], chosen):
            if spoiled == "gains":
                gains[2] = NAN
            elif spoiled == "residual":
                to_cube(residual)[:, 3] = NAN
        record = SimpleNamespace(status="converged")
        return SimpleNamespace(
            gains=SimpleNamespace(gain_array=gains), model=model, residual=residual, solutions=[record]
        )

    monkeypatch.setattr(noisy_calibration, "run_calibrator", calibrated)
    monkeypatch.setattr(noisy_calibration, "read_visibilities", lambda path: noise.get(path.parent.name, model))
    products = {name: Path(name) for name in (*noise, "foregrounds")}
    run = SimpleNamespace(experiment=SimpleNamespace(calibration=None), products=products)
    step = STEPS.make({"kind": "flags", "integrations": 3})
    assert verdicts(step, step.measure({"one": run}, Path())) == {"influence": influence, "bias": bias}


@pytest.mark.parametrize("place", range(len(simulation.OFFSETS)))
def test_an_engine_that_returns_no_number_for_one_source_does_not_pass(monkeypatch, place):
    exact = [
        np.ones((1, 6, 8, 1)) if at != place else np.full((1, 6, 8, 1), NAN) for at in range(len(simulation.OFFSETS))
    ]
    monkeypatch.setattr(simulation, "_make", lambda *_: Mock(simulate=Mock(side_effect=exact)))
    monkeypatch.setattr(simulation, "_closed_form", lambda *_: np.ones((6, 8)))
    assert np.isnan(simulation.closed_form_error("dense", "double"))


@pytest.mark.parametrize("engine", ["dense", "matvis", "fftvis"])
def test_an_engine_that_returns_no_number_does_not_pass_by_others(monkeypatch, engine):
    def found(compared):
        return {item: NAN if item == (engine, "double") else 1e-9 for item in compared}

    monkeypatch.setattr(simulation.Engines, "errors", lambda _self, compared: found(compared))
    monkeypatch.setattr(simulation, "closed_form_error", lambda *_: 1e-9)
    settings = {"sources": 1, "antennas": 2, "channels": 1, "times": 1}
    step = STEPS.make({"kind": "engines", "engines": ["dense", "matvis", "fftvis"], **settings})
    expected = {"double_pyuvsim": "not evaluated", "double_closed_form": "PASS"}
    assert verdicts(step, step.measure({}, Path())) == expected


@pytest.mark.parametrize("spoiled", range(8))
def test_an_exchange_without_a_number_does_not_pass_by_others(monkeypatch, spoiled):
    """Two draws of each of four kinds, of which one is NaN."""
    ones = np.ones((2, 3), complex)
    calls = iter([ones, *(ones if place != spoiled else NAN * ones for place in range(8))])
    integration = Mock(
        true_gains=ones, noise_std=0.1, modelled=ones, products=lambda gains: gains, settings=Mock(), misfit=Mock()
    )
    integration.calibrate.return_value.solutions = [SimpleNamespace(status="converged", steps=1)]
    monkeypatch.setattr(single_fit.Degeneracies, "integration", lambda *_: integration)
    monkeypatch.setattr(single_fit, "best_misfit", lambda *_: next(calls))
    monkeypatch.setattr(single_fit, "narrow_model", lambda _: ones)
    monkeypatch.setattr(single_fit, "residual", lambda *_: ones)
    monkeypatch.setattr(single_fit, "EXCHANGES", dict.fromkeys(single_fit.EXCHANGES, lambda *_: ones))
    step = STEPS.make({"kind": "degeneracies", "draws": 2})
    assert verdicts(step, step.measure({}, Path())) == {"exact": "not evaluated", "fitted": "PASS"}


@pytest.mark.parametrize("pulls", [(NAN, 1.0), (1.0, NAN)])
def test_a_band_without_a_number_does_not_pass_by_others(monkeypatch, tmp_path, pulls):
    losses = (0.0,) * len(chain.STAGES)
    bands = {pull: chain.Band(0.1, 0.2, losses, 0.0, Finding(pull, 1.0)) for pull in pulls}
    monkeypatch.setattr(chain, "budget", lambda run: [bands[pull] for pull in run])
    step = STEPS.make({"kind": "signal-loss-budget"})
    found = step.measure({"minredundant": pulls, "redundant": (1.0,)}, tmp_path)
    assert verdicts(step, found) == {"minredundant_worst_pull": "not evaluated", "redundant_worst_pull": "PASS"}


def spectrum(power: np.ndarray) -> SphericalSpectrum:
    """Return a spectrum in bins of 1 h/Mpc, with an error of 0.2."""
    ones = np.ones(power.size)
    edges = np.arange(power.size + 1.0)
    return SphericalSpectrum(edges[:-1] + 0.5, edges, power + 0j, *[ones] * 4, 0.1 * ones, 0.1 * ones, True)


def test_bins_without_a_number_in_the_residual_are_misses():
    residual = np.ones(10)
    residual[:2] = NAN
    spectra = {"residual": spectrum(residual), "eor": spectrum(np.ones(10))}
    run = SimpleNamespace(spherical=lambda variant, _modes: spectra[variant], flux_scale=None)
    step = STEPS.make({"kind": "end-to-end"})
    found = step.measure({"minredundant": run}, Path())
    assert found.values["minredundant_bars"].value == pytest.approx(0.8)
    assert verdicts(step, found)["minredundant_difference"] == "FAIL"


def test_an_artefact_without_a_number_is_not_removed(monkeypatch):
    spectra = {"residual": spectrum(np.array([0.0, NAN, 0.0])), "uncalibrated": spectrum(np.ones(3))}
    run = SimpleNamespace(spherical=lambda variant, _modes: spectra[variant], experiment=None)
    monkeypatch.setattr(bins, "reflection_bins", lambda *items: np.isfinite(items[-1].power.real))
    step = STEPS.make({"kind": "low-snr"})
    assert verdicts(step, step.measure({"lowsnr": run}, Path())) == {"left": "not evaluated", "artefact_sigmas": "PASS"}


def test_powers_without_a_number_have_no_distribution():
    sample = np.random.default_rng(1).exponential(size=200)
    assert estimator._exponential(sample) > 0.01
    assert np.isnan(estimator._exponential(np.append(sample, NAN)))
