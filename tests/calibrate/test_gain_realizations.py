"""Errors of gains by realizations of the noise: those of the matrix of the same fit, and they cover."""

from __future__ import annotations

import numpy as np
import pytest
from toy import FREQUENCIES, LARGE_HEX, make_toy, scattered
from toy_data import errors, make_uvdata, sky_of

import calstudy
from calstudy.base.errors import InputError
from calstudy.base.visibilities import flag_cube
from calstudy.calibrate.calibrators.least_squares import SkyBased
from calstudy.calibrate.calibrators.other_packages import Skycal
from calstudy.calibrate.calibrators.redcal import Redcal
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.gain_errors import gain_errors
from calstudy.calibrate.gain_realizations import GainRealizations
from calstudy.calibrate.problem import gain_products
from calstudy.calibrate.settings import FlagWeights

REALIZATIONS = 16
NOISE = 0.03


@pytest.fixture(scope="module")
def noisy():
    return make_toy(scattered(8), noise=NOISE)


def by_realizations(calibrator, uvd, sky, count=REALIZATIONS):
    result = run_calibrator(calibrator, uvd, sky)
    return result, GainRealizations(calibrator, uvd, sky, None, result, count).errors()


def test_they_are_those_of_the_matrix(noisy):
    uvd = make_uvdata(noisy, n_times=1)
    uvd.flag_array[5, :7] = True
    flags = flag_cube(uvd)[0, :, :, 0]
    sky = sky_of(uvd, noisy.foregrounds)
    result, found = by_realizations(SkyBased(weights=FlagWeights()), uvd, sky)
    gains = result.gains.gain_array[result.gains.ant_array.argsort(), :, 0, 0]
    problem = noisy.problem(weights=(~flags).astype(float), sky_model=noisy.foregrounds, frozen=True)
    exact = gain_errors(problem, gains, noisy.foregrounds, FREQUENCIES)
    ratio = found[..., 0, 0] / np.stack([exact.amplitude, exact.phase])
    # The rms over 500 gains of deviations of 16 numbers scatters by 1 %, and neighbours have noise in common.
    assert np.sqrt(np.mean(ratio**2, axis=(1, 2))) == pytest.approx([1, 1], abs=0.05)


def test_errors_go_with_the_number_of_measurements(noisy):
    """Noise of samples that are averages of a hundred measurements, solved beside single ones."""
    uvd = make_uvdata(noisy, n_times=2)
    sky = sky_of(uvd, noisy.foregrounds)
    products = gain_products(noisy.gains, noisy.antennas) * noisy.foregrounds
    rows = slice(uvd.Nbls, None)
    uvd.data_array[rows, :, 0] = products + (uvd.data_array[rows, :, 0] - products) / 10
    uvd.nsample_array[rows] = 100
    _, found = by_realizations(Skycal(weights=FlagWeights()), uvd, sky, count=4)
    single, many = np.nanmedian(found, axis=(1, 2))[..., 0].T
    # Medians over 500 gains of deviations of four numbers.
    assert single / many == pytest.approx([10, 10], rel=0.15)


@pytest.mark.parametrize(
    ("calibrator", "positions"),
    [
        (Skycal(weights=FlagWeights()), scattered(8)),
        # As long as all others together.
        pytest.param(Redcal(weights=FlagWeights()), LARGE_HEX, marks=pytest.mark.slow),
    ],
    ids=["skycal", "redcal"],
)
def test_errors_of_calibrators_of_other_packages_cover(calibrator, positions):
    toy = make_toy(positions, noise=NOISE)
    uvd = make_uvdata(toy, n_times=1)
    result, found = by_realizations(calibrator, uvd, sky_of(uvd, toy.foregrounds))
    deviation = errors(result, toy) / result.gains.gain_array[..., 0, 0]
    amplitude = np.abs(deviation.real) * np.abs(result.gains.gain_array[..., 0, 0]) / found[0, ..., 0, 0]
    phase = np.abs(deviation.imag) / found[1, ..., 0, 0]
    # Deviations over errors from 16 realizations have Student's distribution with 15 degrees of freedom.
    for pulls in (amplitude, phase):
        assert np.mean(pulls < 1) == pytest.approx(0.667, abs=0.05)
        assert np.mean(pulls < 1.96) == pytest.approx(0.931, abs=0.03)


@pytest.fixture
def calibrated(noisy, tmp_path):
    """Calibrate two integrations by skycal, of which some may be flagged, to a folder of a name."""

    def calibrate(name, gain_errors, flagged=slice(0), **settings):
        uvd = make_uvdata(noisy, n_times=2)
        sky_of(uvd, noisy.foregrounds).write_uvh5(tmp_path / "sky.uvh5", clobber=True)
        times = np.unique(uvd.time_array)[flagged]
        uvd.flag_array[np.isin(uvd.time_array, times)] = True
        uvd.write_uvh5(tmp_path / "data.uvh5", clobber=True)
        settings = settings or {"calibrator": "skycal", "weights": "flags"}
        observed = {"sky_model": str(tmp_path / "sky.uvh5")}
        return calstudy.calibrate_data(
            tmp_path / "data.uvh5", tmp_path / name, observed, quiet=True, gain_errors=gain_errors, **settings
        )

    return calibrate


@pytest.mark.filterwarnings("ignore")
def test_integrations_without_data_and_gains_that_are_given_have_none_and_say_so(calibrated, tmp_path):
    found = calibrated("flagged", 2, flagged=slice(1, 2))
    first, second = (record["gain_errors"] for record in found.solution["records"])
    assert first["realizations"] == 2
    assert second == {"reason": "all gains are flagged"}
    gains = str(tmp_path / "flagged" / "gains.calh5")
    given = calibrated("given", np.int64(2), calibrator="by-file", gains=gains)
    assert {record["gain_errors"]["reason"] for record in given.solution["records"]} >= {
        "gains do not change with the noise of the data"
    }
    with pytest.raises(InputError, match="has no errors of gains"):
        _ = given.gain_errors


@pytest.mark.chain
@pytest.mark.filterwarnings("ignore")
def test_gains_of_measured_data_have_them_if_asked_for(calibrated):
    found = calibrated("with", 3)
    assert np.array_equal(np.isfinite(found.gain_errors.amplitude), ~found.gains.flag_array)
    for record in found.solution["records"]:
        assert record["gain_errors"]["realizations"] == 3
        # Noise of 3 % on seven baselines of each antenna.
        assert record["gain_errors"]["median_phase"] == pytest.approx(NOISE / np.sqrt(2 * 7), rel=0.5)
    assert (found.draw_gains(1).gain_array != found.gains.gain_array).any()
    reason = calibrated("without", True).solution["records"][0]["gain_errors"]["reason"]
    assert "is no fit by least squares" in reason


@pytest.mark.chain
@pytest.mark.filterwarnings("ignore")
def test_fits_with_a_taper_have_them_by_realizations_alone(calibrated):
    settings = {"calibrator": "sky-based", "weights": "flags", "baselines": {"taper": "20 m"}}
    without = calibrated("matrix", True, **settings).solution["records"][0]["gain_errors"]
    assert without == {"reason": "weights with a taper are no inverse variances of the noise"}
    assert calibrated("realizations", 2, **settings).solution["records"][0]["gain_errors"]["realizations"] == 2


@pytest.mark.chain
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("realizations", [True, pytest.param(8, marks=pytest.mark.chain)])
def test_an_integration_without_data_changes_no_errors_of_gains_that_it_shares(calibrated, realizations):
    """Gains are flagged there, and have no errors; those of the integration with data are as if it were alone."""
    taper = {} if realizations is True else {"baselines": {"taper": "1 km"}}
    settings = {"calibrator": "sky-based", "weights": "flags", "flagged": slice(0, 1), **taper}
    shared = calibrated("shared", realizations, integrations_per_solve=2, **settings)
    alone = calibrated("alone", realizations, **settings)
    for part in ("amplitude", "phase"):
        found, expected = (getattr(one.gain_errors, part).values for one in (shared, alone))
        assert np.isnan(found[:, :, 0]).all()
        np.testing.assert_allclose(found[:, :, 1], expected[:, :, 1], rtol=0.01)
    (record,) = shared.solution["records"]
    assert record["gain_errors"].get("median_phase") == pytest.approx(NOISE / np.sqrt(2 * 7), rel=0.5)


SMOOTH = [
    ("smooth_gains", {"calibrator": "skycal", "smooth_gains": {"kind": "dpss", "frequency_scale": "2 MHz"}}),
    ("gain_delay", {"calibrator": "sky-based", "gain_delay": "400 ns"}),
]


@pytest.mark.chain
@pytest.mark.parametrize(("field", "settings"), SMOOTH)
@pytest.mark.filterwarnings("ignore")
def test_errors_of_smooth_gains_are_not_drawn_for_each_channel_by_itself(calibrated, field, settings):
    found = calibrated("smooth", 2, weights="flags", **settings)
    with pytest.raises(InputError, match=rf"calibration\.{field} = .*: gains are smooth, .* with {field}: null"):
        found.draw_gains(1)
