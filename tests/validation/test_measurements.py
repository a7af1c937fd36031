"""The formulas of the measurements against closed forms and independent draws."""

from __future__ import annotations

import numpy as np
import pytest
from ladders import load_ladder

from calstudy.base.errors import InputError
from calstudy.claims.bins import clustered_mean, mean_of_common_errors, pooled
from calstudy.power.spectra import DelaySpectra
from calstudy.validation.ladder import SCALES, passed, tally
from calstudy.validation.steps.estimator import windowed
from calstudy.verdicts.criterion import Finding

DRAWN = True


def spectra(power: np.ndarray, taper: str = "blackman-harris") -> DelaySpectra:
    n_units, n_delays = power.shape
    return DelaySpectra(
        power=power.astype(complex),
        vectors=np.column_stack([10.0 * (1 + np.arange(n_units)), np.zeros(n_units), np.zeros(n_units)]),
        n_pairs=np.ones(n_units, int),
        n_polarizations=1,
        delay=(np.arange(n_delays) - n_delays // 2) * 32e-9,
        k_perp=np.full(n_units, 0.01),
        k_parallel=(np.arange(n_delays) - n_delays // 2) * 0.02,
        frequency=182e6,
        omega_pp=0.05,
        taper=taper,
    )


def test_a_window_does_nothing_to_a_flat_spectrum():
    frame = spectra(np.ones((2, 64)))
    np.testing.assert_allclose(windowed(lambda k: 3.0 * np.ones_like(k), frame), 3.0, rtol=1e-12)


@pytest.mark.parametrize("taper", ["blackman-harris", "none"])
def test_a_window_mixes_delays_as_monte_carlo_does(taper, rng):
    """Waves of random amplitude at all delays, through taper and transform, have the mean power of `windowed`."""
    from calstudy.power.delay import make_taper

    count, fine, draws = 32, 8, 4000

    def power(k):
        return 1 / (1 + (k / 0.05) ** 2)

    frame = spectra(np.ones((1, count)), taper)
    offsets = (np.arange(fine) - (fine - 1) / 2) / fine
    cells = ((np.arange(count) - count // 2)[:, None] + offsets).ravel()
    amplitude = np.sqrt(power(np.hypot(0.01, cells * 0.02)) / fine)
    waves = np.exp(2j * np.pi * np.outer(cells, np.arange(count)) / count)
    normal = (rng.standard_normal((2, draws, cells.size)) * np.sqrt(0.5)).astype(np.float64)
    data = ((normal[0] + 1j * normal[1]) * amplitude) @ waves
    window = make_taper(taper, count)
    transformed = np.fft.fftshift(np.fft.fft(data * window, axis=1), axes=1)
    found = np.mean(np.abs(transformed) ** 2, axis=0) / (count * np.sum(window**2))
    expected = windowed(power, frame)[0]
    np.testing.assert_allclose(found, expected, rtol=5 / np.sqrt(draws))


@pytest.mark.parametrize("n_units", [20, 60])
def test_clustered_errors_are_the_scatter_of_means_of_units(n_units):
    """Units whose modes share a common offset: the error must be that of the units, not of the modes."""
    generator = np.random.default_rng(n_units)
    offsets, own = (generator.standard_normal((200, n_units, modes)) for modes in (1, 50))
    found = [clustered_mean(5.0 + one) for one in offsets + 0.01 * own]
    values, errors = (np.array([getattr(one, name) for one in found]) for name in ("value", "uncertainty"))
    # A variance from 19 degrees of freedom or more scatters by a third: the rms error of 200 is known to 1.1 %.
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(n_units**-0.5, rel=0.05)
    # The scatter of 200 means is known to 5 %, their mean to 1 / sqrt(200).
    assert values.std() == pytest.approx(n_units**-0.5, rel=0.2)
    assert values.mean() == pytest.approx(5, abs=4 * (200 * n_units) ** -0.5)


def test_left_out_modes_do_not_count():
    values = np.array([[1.0, np.nan], [3.0, 5.0], [np.nan, np.nan]])
    assert clustered_mean(values).value == pytest.approx(3.0)


def test_pooling_weights_by_inverse_variance():
    found = pooled([Finding(1.0, 1.0), Finding(2.0, 0.5)])
    assert found.value == pytest.approx((1 + 8) / 5)
    assert found.uncertainty == pytest.approx(5**-0.5)


def test_errors_that_bins_have_in_common_do_not_average_down():
    """All bins are off by two of their errors, and so is their mean."""
    for errors in (np.full(9, 0.1), np.linspace(0.1, 0.3, 9)):
        found = mean_of_common_errors(1 + 2 * errors, errors)
        assert found.value == pytest.approx(1 + 2 * found.uncertainty)


@pytest.mark.parametrize("scale", SCALES)
def test_all_steps_load_and_have_what_the_table_needs(scale):
    steps = [step for step, _ in load_ladder(scale=scale).steps]
    assert len(steps) == 13
    for step in steps:
        assert step.criteria
        assert all(item.why and item.quantity and item.sentence for item in step.criteria.values())


def test_full_scale_thresholds_are_those_of_the_table():
    criteria = [criterion for step, _ in load_ladder().steps for criterion in step.criteria.values()]
    must = {criterion.name: str(criterion.threshold) for criterion in criteria}
    assert must["-1 double_pyuvsim"] == "<= 1e-06"
    assert must["0.0 scatter_over_theory"] == "1 within 3 sigma"
    assert must["0.1 normalization"] == "from 0.99 to 1.01"
    assert must["0.1 exponential"] == ">= 0.01"
    assert must["0.1 imaginary"] == "from -0.015 to 0.015"
    assert must["0.2 normalization"] == "from 0.98 to 1.02"
    assert must["1.0 excess"] == must["1.0 beyond_floor"] == "<= 0.01"
    assert must["2.0 single"] == "<= 1e-05"
    assert must["2.0 double"] == "<= 1e-09"
    assert must["2.1 exact"] == must["2.1 fitted"] == "<= 1e-06"
    assert must["2.2 false_convergence"] == must["2.3 influence"] == "<= 0"
    assert must["2.3 bias"] == "<= 2"
    assert must["2.4 amplitude_within_1"] == must["2.4 phase_within_1"] == "from 0.653 to 0.713"
    assert must["2.4 amplitude_within_2"] == must["2.4 phase_within_2"] == "from 0.93 to 0.97"
    assert must["3.0 left"] == "<= 1"
    assert must["4.0 minredundant_bars"] == must["4.0 redundant_bars"] == ">= 0.9"
    assert must["4.1 minredundant_worst_pull"] == must["4.1 redundant_worst_pull"] == "<= 3"


def test_small_scale_has_limits_of_its_own_only_where_a_step_says_so():
    full, small = (
        {
            item.name: str(item.threshold)
            for step, _ in load_ladder(scale=scale).steps
            for item in step.criteria.values()
        }
        for scale in SCALES
    )
    assert full.keys() - small.keys() == {"1.0 excess"}
    assert {name: limit for name, limit in small.items() if limit != full[name]} == {
        "0.1 normalization": "1 within 3 sigma",
        "0.1 imaginary": "0 within 3 sigma",
        "0.2 normalization": "1 within 3 sigma",
        "2.3 bias": "<= 3",
    }


def test_a_number_that_is_missing_or_not_finite_does_not_pass():
    ((step, _),) = load_ladder(["0.0"]).steps
    found = {"mean_real": {"value": 0.0, "uncertainty": 1.0}, "mean_imaginary": {"value": None, "uncertainty": 1.0}}
    verdicts = step.judge(found)
    assert [verdict.verdict for verdict in verdicts] == ["not evaluated", "PASS", "not evaluated"]
    assert not passed(verdicts)
    assert tally(verdicts) == "0 of 1 steps pass, 1 of 3 criteria"
    assert not passed([])


def test_a_chain_without_reflections_does_not_pass_because_nothing_is_left_of_them():
    ((step, _),) = load_ladder(["3.0"]).steps
    found = {name: {"value": value, "uncertainty": 0.5} for name, value in (("left", 0.1), ("artefact_sigmas", 0.2))}
    assert not passed(step.judge(found))


def test_fits_that_do_nothing_do_not_pass_because_all_are_alike():
    ((step, _),) = load_ladder(["2.2"]).steps
    values = {"false_convergence": 0, "floor": 1000.0, "paper_case": 1.0, "out_of_reach": 0}
    verdicts = step.judge({name: {"value": float(value), "uncertainty": 0.0} for name, value in values.items()})
    assert [verdict.name for verdict in verdicts if verdict.verdict == "FAIL"] == ["2.2 floor"]


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ('number = "9.9"', "limits"),
        ('number = "nine"; limits = {"x": LIMIT}', "must have a number"),
        ('number = "9.9"; limits = {"x": LIMIT}; parameters = {"banana": 1}', r"banana: unknown key"),
        ('number = "9.9"; limits = {"x": LIMIT}; parameters = {"reach": 0.3}', r"reach: 0\.3 has no unit"),
        ('number = "9.9"; limits = {"x": LIMIT}; experiments = {"x": Case("nowhere.yaml")}', "nowhere.yaml"),
    ],
)
def test_a_broken_step_is_refused_in_a_sentence(body, sentence, tmp_path):
    imports = (
        "from calstudy.base.units import Length\nfrom calstudy.validation.step import Case, Limit, Step\n"
        "from calstudy.verdicts.criterion import AtMost\n\nLIMIT = Limit('x', AtMost(1), 'x')\n"
    )
    path = tmp_path / "step.py"
    path.write_text(
        f"{imports}\nclass Own(Step):\n    reach: Length = 1.0\n    {body}\n\n"
        "    def measure(self, runs, output):\n        return None\n"
    )
    with pytest.raises(InputError, match=sentence):
        load_ladder([str(path)])


def test_a_step_says_what_its_experiment_lacks():
    without = ["sky.foregrounds=none", "corruption.eor_level=null", "variants={eor: {components: [eor]}}"]
    ladder = load_ladder(["2.3"], "small", [*without, "outputs.figures=[]"])
    with pytest.raises(InputError, match=r"step 2\.3: validation-small: the measurement needs foregrounds"):
        _ = ladder.measurements
