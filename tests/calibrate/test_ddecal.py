"""DP3's DDECal behind the interface: exact where it must be, the same minimum as skycal, and honest about its end."""

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from toy import make_toy, scattered, turned
from toy_data import errors, make_uvdata, sky_of, statuses

from calstudy.base.errors import InputError
from calstudy.base.visibilities import to_cube
from calstudy.calibrate.calibrators import ddecal
from calstudy.calibrate.calibrators.ddecal import Ddecal
from calstudy.calibrate.calibrators.other_packages import Skycal
from calstudy.calibrate.execution import run_calibrator

SINGLE = 1e-5
"""Of gains near one: some hundred times the rounding of single precision, in which DDECal works."""


def installed():
    return ddecal._program() is not None and find_spec("casacore") is not None


needs_dp3 = pytest.mark.skipif(not installed(), reason="needs the extra [dp3]")


@needs_dp3
def test_noiseless_gains_are_exact():
    """Three integrations, two of which share a solve; every second baseline is reversed."""
    toy = turned(make_toy(scattered(8), noise=0.0))
    uvd = make_uvdata(toy, n_times=3, polarizations=(-5, -6))
    result = run_calibrator(Ddecal(integrations_per_solve=2), uvd, sky_of(uvd, toy.foregrounds))
    assert statuses(result) == ["converged"] * 4
    for polarization in (0, 1):
        for integration in range(3):
            # Data of the toys' polarizations and integrations differ by 1e-4 in amplitude, and gains by half of that.
            shared = slice(0, 2) if integration < 2 else slice(2, 3)
            ratios = abs(to_cube(uvd)[shared, ..., polarization] / toy.visibilities)
            scaled = replace(toy, gains=ratios.mean() ** 0.5 * toy.gains)
            assert np.abs(errors(result, scaled, integration, polarization)).max() < SINGLE


@needs_dp3
def test_the_minimum_and_the_flagged_gains_are_those_of_skycal():
    toy = make_toy(scattered(9), noise=0.05)
    uvd = make_uvdata(toy, n_times=2)
    rng = np.random.default_rng(5)
    uvd.flag_array |= rng.random(uvd.flag_array.shape) < 0.1
    uvd.flag_array[:, 7] = True
    uvd.flag_array[(uvd.ant_1_array == 14) | (uvd.ant_2_array == 14)] = True
    sky = sky_of(uvd, toy.foregrounds)
    results = [run_calibrator(calibrator, uvd, sky).gains for calibrator in (Ddecal(), Skycal())]
    flags, other = (result.flag_array for result in results)
    assert np.array_equal(flags, other)
    assert flags[:, 7].all()
    assert not flags.all(axis=(1, 2, 3)).all()
    difference = np.where(flags, 0, results[0].gain_array - results[1].gain_array)
    assert np.abs(difference).max() < SINGLE


@needs_dp3
def test_an_integration_without_data_is_skipped():
    toy = make_toy(scattered(8), noise=0.0)
    uvd = make_uvdata(toy, n_times=3)
    uvd.flag_array[uvd.Nbls : 2 * uvd.Nbls] = True
    result = run_calibrator(Ddecal(), uvd, sky_of(uvd, toy.foregrounds))
    assert statuses(result) == ["converged", "skipped", "converged"]
    assert result.gains.flag_array[:, :, 1].all()


@needs_dp3
def test_too_few_steps_are_no_convergence():
    toy = make_toy(scattered(8), noise=0.0)
    uvd = make_uvdata(toy, n_times=1)
    result = run_calibrator(Ddecal(max_steps=3), uvd, sky_of(uvd, toy.foregrounds))
    assert statuses(result) == ["max-steps"]


@pytest.mark.chain
@needs_dp3
def test_smoothing_averages_noise_down():
    """Gains are smooth here, so that smoothing them over many channels lowers their errors."""
    toy = make_toy(scattered(8), noise=0.3)
    toy = replace(toy, gains=np.broadcast_to(toy.gains.mean(axis=1, keepdims=True), toy.gains.shape).copy())
    uvd = make_uvdata(toy, n_times=1)
    width = uvd.freq_array[-1] - uvd.freq_array[0]
    plain, smooth = (
        errors(run_calibrator(calibrator, uvd, sky_of(uvd, toy.foregrounds)), toy)
        for calibrator in (Ddecal(tolerance=1e-5), Ddecal(tolerance=1e-5, smoothness=f"{width} Hz"))
    )
    assert np.sqrt(np.mean(np.abs(smooth) ** 2)) < 0.6 * np.sqrt(np.mean(np.abs(plain) ** 2))


def test_what_is_not_installed_is_named(monkeypatch):
    toy = make_toy(scattered(8), noise=0.0)
    uvd = make_uvdata(toy, n_times=1)
    monkeypatch.setattr(ddecal, "COMMANDS", ("DP3-of-nobody",))
    with pytest.raises(
        InputError, match=r"needs the program DP3, which is not installed: pip install 'calstudy\[dp3\]'"
    ):
        run_calibrator(Ddecal(), uvd, sky_of(uvd, toy.foregrounds))


@needs_dp3
def test_a_program_that_fails_is_a_solve_that_failed(monkeypatch, tmp_path):
    command = tmp_path / "DP3-broken"
    command.write_text("#!/bin/sh\necho no such step\nexit 3\n")
    command.chmod(0o755)
    monkeypatch.setattr(ddecal, "_program", lambda: str(command))
    toy = make_toy(scattered(8), noise=0.0)
    uvd = make_uvdata(toy, n_times=1)
    result = run_calibrator(Ddecal(), uvd, sky_of(uvd, toy.foregrounds))
    assert statuses(result) == ["failed"]
    assert "exit code 3: no such step" in result.solutions[0].message
