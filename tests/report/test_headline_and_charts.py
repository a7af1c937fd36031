"""The numbers on top of a report, and the arrays that its charts are drawn from."""

import base64
import csv
import json

import numpy as np
import pytest

from calstudy.report.charts import read_charts
from calstudy.report.headline import read_excess, read_headline

K = np.arange(0.05, 1, 0.1)
SCALE = 1.1


def spectrum_csv(path, power, modes, noise_error):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["k [h/Mpc]", "power real [mK2 h-3 Mpc3]", "noise error [mK2 h-3 Mpc3]", "modes"])
        writer.writerows(zip(K, power, noise_error, modes, strict=True))


@pytest.fixture
def tables(tmp_path):
    """An EoR of 100, of which 0.5 and 0.8 are left, and a bias of 7 % of it at 0.2 to 0.5 h/Mpc."""
    folder = tmp_path / "tables"
    folder.mkdir()
    modes = np.where(K < 0.3, 10, 30)
    signal = np.where(K < 0.1, np.nan, 100.0)
    spectrum_csv(folder / "eor.outside-wedge.csv", signal, modes, np.zeros(K.size))
    residual = np.where((K > 0.2) & (K < 0.5), 7 / SCALE**2, 1e6)
    spectrum_csv(folder / "residual_without_eor.outside-wedge.csv", residual, modes, np.full(K.size, 2 / SCALE**2))
    with (folder / "transfer-bands.outside-wedge.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        names = ("transfer without flux scale", "transfer without flux scale error", "flux scale")
        writer.writerow(["k from [h/Mpc]", "k to [h/Mpc]", *names])
        for low, high, value in ((0.1, 0.2, 0.0), (0.2, 0.3, 0.5), (0.3, 0.5, 0.8), (0.5, 1.0, 9.0)):
            writer.writerow([low, high, value, 0.07, SCALE])
    return folder


def test_the_headline_pools_modes_of_its_band_and_is_free_of_the_flux_scale(tables):
    numbers = {number.name: number.text for number in read_headline(tables.parent)}
    # 10 modes of the first band, 60 of the second.
    mean, error = (10 * 0.5 + 60 * 0.8) / 70, 0.07 * np.hypot(10, 60) / 70
    assert numbers["T"] == f"{mean:.3f} ± {error:.3f}"
    # 10, 30 and 30 modes, each with an error of 0.02 of the EoR.
    assert numbers["bias"] == f"0.070 ± {0.02 * np.sqrt(10**2 + 2 * 30**2) / 70:.3f}"
    assert numbers["flux scale"] == "1.1000"
    assert "claims" not in numbers


@pytest.mark.parametrize(
    ("power", "told"),
    # The noise of the band is 0.014 of the EoR; a bias as large as the EoR, of either sign, is told.
    [(7, None), (90, None), (3400, "34 times"), (-1e6, "10,000 times"), (1.2345e9, "12,000,000 times")],
)
def test_a_residual_with_more_power_than_the_eor_is_told(power, told, tables):
    residual = np.where((K > 0.2) & (K < 0.5), power / SCALE**2, 0)
    modes = np.where(K < 0.3, 10, 30)
    spectrum_csv(tables / "residual_without_eor.outside-wedge.csv", residual, modes, np.full(K.size, 2 / SCALE**2))
    warnings = read_excess(tables.parent)
    assert len(warnings) == (told is not None)
    assert all(f"0.5 h/Mpc, the residual without EoR has {told} the power of the EoR" in text for text in warnings)


def test_noise_above_the_eor_is_no_excess(tables):
    noisy, modes = np.full(K.size, 400 / SCALE**2), np.where(K < 0.3, 10, 30)
    spectrum_csv(tables / "residual_without_eor.outside-wedge.csv", noisy, modes, np.full(K.size, 300 / SCALE**2))
    assert read_excess(tables.parent) == []


def test_the_headline_counts_verdicts(tmp_path):
    texts = dict.fromkeys(("section", "sentence", "quantity", "threshold", "why", "reason"), "")
    words = ("supported", "contradicted", "supported", "not evaluated", "undecided")
    claims = [
        {**texts, "name": f"{place}", "measured": 1.0, "uncertainty": 0.1, "verdict": verdict, "runs": []}
        for place, verdict in enumerate(words)
    ]
    (tmp_path / "claims.json").write_text(json.dumps(claims))
    found = [(number.name, number.text) for number in read_headline(tmp_path)]
    assert found == [("claims", "2 supported, 1 contradicted, 1 undecided")]


def test_curves_are_the_arrays_of_the_figure(tmp_path):
    power = np.array([np.nan, -3.0 + 1j, 123456.0])
    fields = {"k": [0.1, 0.2, 0.3], "power": power, "noise_error": [0, 3, 5.0], "sample_error": [0, 4, 12.0]}
    path = tmp_path / "spherical.npz"
    np.savez(path, **{f"excised.residual.{name}": value for name, value in fields.items()}, **{"excised.title": "far"})
    (chart,) = read_charts(path)
    assert chart.title == "Power spectra, far"
    (series,) = json.loads(json.dumps(chart.data))["series"]
    assert (series["x"], series["y"], series["error"]) == ([0.2, 0.3], [-3.0, 123460.0], [5.0, 13.0])


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
