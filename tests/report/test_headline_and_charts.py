"""The numbers on top of a report, and the arrays that its charts are drawn from."""

import base64
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calstudy.base.errors import InputError
from calstudy.power.score import Score
from calstudy.power.tables import save_spectrum
from calstudy.products.files import SCORE, SCORE_BANDS
from calstudy.report.headline import read_headline, read_signal
from calstudy.report.page import read_charts
from calstudy.results.reader import RunFolder

EDGES = np.array([0.1, 0.2, 0.5, 1.0])
SCALE = 1.1


def scores(bias: float = 0.07, bias_error: float = 0.014) -> Score:
    """Scores with these numbers between 0.2 and 0.5 h/Mpc, and others elsewhere."""

    def bands(value: float, elsewhere: float) -> np.ndarray:
        return np.array([elsewhere, value, elsewhere])

    return Score(
        k=(EDGES[1:] + EDGES[:-1]) / 2,
        bin_edges=EDGES,
        transfer=bands(0.757, 0.1),
        transfer_error=bands(0.012, 0.5),
        bias=bands(bias, 1e6),
        bias_error=bands(bias_error, 1e-3),
        recovered=bands(1.0, 2.0),
        recovered_error=bands(0.1, 0.2),
        flux_scale=SCALE,
    )


def run_of(folder: Path, **manifest) -> RunFolder:
    (folder / "manifest.json").write_text(json.dumps({"name": "study", **manifest}))
    return RunFolder(folder)


def finished_run(folder: Path, score: Score) -> RunFolder:
    (folder / "tables").mkdir(exist_ok=True)
    save_spectrum(folder / "tables" / SCORE_BANDS, score)
    return run_of(folder)


def test_the_headline_is_the_score_of_its_band(tmp_path):
    numbers = {number.name: number.text for number in read_headline(finished_run(tmp_path, scores()))}
    assert numbers == {"T": "0.757 ± 0.012", "bias": "0.070 ± 0.014", "flux scale": "1.1000"}


@pytest.mark.parametrize(
    ("bias", "expected"),
    # A bias as large as the EoR, of either sign, is an excess.
    [(0.07, None), (0.9, None), (34, "34 times"), (-1e4, "10,000 times"), (1.2345e7, "12,000,000 times")],
)
def test_a_residual_with_more_power_than_the_eor_is_an_excess(bias, expected, tmp_path):
    signal = read_signal(finished_run(tmp_path, scores(bias)))
    if expected is None:
        assert signal.excess is None
    else:
        assert f"0.5 h/Mpc, the residual without EoR has {expected} the power of the EoR" in signal.excess


def test_noise_above_the_eor_is_no_excess(tmp_path):
    assert read_signal(finished_run(tmp_path, scores(4, bias_error=1.6))).excess is None
    # Leaving out antennas gives what is left of foregrounds an error of a quarter or more of it.
    assert read_signal(finished_run(tmp_path, scores(3.9e6, bias_error=1.1e6))).excess is not None
    # An error that is not known explains nothing.
    assert read_signal(finished_run(tmp_path, scores(5000, bias_error=np.nan))).excess is not None


def test_damaged_scores_are_no_missing_ones(tmp_path):
    run = finished_run(tmp_path, scores())
    (tmp_path / "tables" / SCORE_BANDS).write_bytes(b"junk")
    with pytest.raises(InputError, match="is damaged; run the experiment again"):
        read_headline(run)


def test_a_run_without_scores_has_no_headline(tmp_path):
    assert read_signal(run_of(tmp_path)) is None
    assert read_signal(finished_run(tmp_path, scores(np.nan))) is None


def test_the_yardstick_for_the_transfer_is_beside_it(tmp_path):
    run = finished_run(tmp_path, scores())
    bands = [{"k": [low, 2 * low], "linear_transfer": value} for low, value in ((0.1, 0.3), (0.2, 0.7489))]
    (tmp_path / "tables" / SCORE).write_text(json.dumps({"bands": bands}))
    assert read_headline(run)[0].text == "0.757 ± 0.012 (linear response of the fit 0.749)"


def test_a_transfer_that_is_not_measured_is_no_result(tmp_path):
    (number, *_) = read_headline(finished_run(tmp_path, replace(scores(), transfer=np.array([0.1, 6178.0, 0.1]))))
    assert number.text == "not measured (6178.000 ± 0.012)"


def test_the_transfer_of_an_earlier_version_that_was_not_given_is_not_measured(tmp_path):
    band = {"k": [0.3, 0.5], "transfer": None, "error": 3.4}
    products = [{"stage": "observed-transfer", "notes": {"transfer": {"outside-wedge": [band]}}}]
    assert read_headline(run_of(tmp_path, products=products))[0].text == "not measured (error 3.4)"


@pytest.mark.parametrize(("not_measured", "text"), [(None, "0.874 ± 0.040"), ("error 5.4", "not measured (error 5.4)")])
def test_measured_data_have_their_fit_and_their_transfer(not_measured, text, tmp_path):
    band = {"k": [0.3, 0.5], "transfer": 0.874, "error": 0.04, "not_measured": not_measured}
    fit = {"even": {"per_degree_of_freedom": 1.014}, "odd": {"per_degree_of_freedom": None}}
    products = [
        {"stage": "observed-quality", "notes": {"chi_squared": fit}},
        {"stage": "observed-transfer", "notes": {"transfer": {"outside-wedge": [band]}}},
    ]
    found = {number.name: number.text for number in read_headline(run_of(tmp_path, products=products))}
    assert found == {"χ² per degree of freedom": "even 1.014", "T at k of 0.3 to 0.5 h/Mpc": text}


def test_the_headline_counts_verdicts(tmp_path):
    texts = dict.fromkeys(("section", "sentence", "quantity", "threshold", "why", "reason"), "")
    words = ("supported", "contradicted", "supported", "not evaluated", "undecided")
    claims = [
        {**texts, "name": f"{place}", "measured": 1.0, "uncertainty": 0.1, "verdict": verdict, "runs": []}
        for place, verdict in enumerate(words)
    ]
    (tmp_path / "claims.json").write_text(json.dumps(claims))
    found = [(number.name, number.text) for number in read_headline(run_of(tmp_path))]
    assert found == [("claims", "2 supported, 1 contradicted, 1 undecided")]


def test_curves_are_the_arrays_of_the_figure(tmp_path):
    power = np.array([np.nan, -3.0 + 1j, 123456.0])
    fields = {"k": [0.1, 0.2, 0.3], "power": power, "noise_error": [0, 3, 5.0], "sample_error": [0, 4, 12.0]}
    path = tmp_path / "spherical.npz"
    np.savez(path, **{f"excised.residual.{name}": value for name, value in fields.items()}, **{"excised.title": "far"})
    (chart,) = read_charts(path)
    assert chart.title == "Power spectra, far"
    (series,) = json.loads(json.dumps(chart.data))["series"]
    assert (series["x"], series["y"], series["error"]) == ([0.2, 0.3], [-3.0, 123460.0], [7.0, 17.0])


def test_maps_are_the_arrays_of_the_figure(tmp_path):
    values = np.random.default_rng(1).standard_normal((3, 5)) * 1e12
    values[1, 2] = np.nan
    fields = {"k_perp": np.arange(3.0), "k_parallel": np.arange(5.0), "baseline_length": np.arange(3.0)}
    fields |= {"delay": 1e-7 * np.arange(5), "horizon_delay": 1e-7 * np.array([0, 1, 2]), "power": values + 1j}
    np.savez(tmp_path / "wedge.npz", **{f"noise.{name}": value for name, value in fields.items()})
    (chart,) = read_charts(tmp_path / "wedge.npz")
    (series,) = json.loads(json.dumps(chart.data))["series"]
    found = np.frombuffer(base64.b64decode(series["values"]), "<f4").reshape(3, 5)
    np.testing.assert_array_equal(found, values.astype("f4"))
    assert series["horizon"] == [0.0, 0.25, 0.5]


def test_arrays_of_another_kind_have_no_charts(tmp_path):
    np.savez(tmp_path / "gains.npz", frequencies=np.arange(4.0), gains=np.ones((2, 4)))
    assert read_charts(tmp_path / "gains.npz") == []


def test_charts_of_one_title_have_the_names_of_their_groups(tmp_path):
    """Two solvers for one array, and another array."""
    titles = {"paper_solver": "Redundant", "other_solver": "Redundant", "alone": "Minimally redundant"}
    fields = dict.fromkeys(("k", "power", "noise_error", "sample_error"), np.ones(2))
    arrays = {f"{group}.residual.{name}": value for group in titles for name, value in fields.items()}
    np.savez(tmp_path / "solvers.npz", **arrays, **{f"{group}.title": title for group, title in titles.items()})
    assert [chart.title for chart in read_charts(tmp_path / "solvers.npz")] == [
        "Power spectra, Redundant, paper solver",
        "Power spectra, Redundant, other solver",
        "Power spectra, Minimally redundant",
    ]


def test_series_without_names_are_not_drawn(tmp_path):
    """The points of a sweep are items of a list; beside one that has a name."""
    fields = dict.fromkeys(("k", "scale_free_transfer", "scale_free_transfer_error"), np.ones(2))
    sweep = {f"panels.0.transfers.{place}.{name}": value for place in range(3) for name, value in fields.items()}
    np.savez(tmp_path / "sweep.npz", **sweep)
    assert read_charts(tmp_path / "sweep.npz") == []
    np.savez(tmp_path / "sweep.npz", **sweep, **{f"outside.{name}": value for name, value in fields.items()})
    (chart,) = read_charts(tmp_path / "sweep.npz")
    assert [one["label"] for one in chart.data["series"]] == ["outside the wedge"]
