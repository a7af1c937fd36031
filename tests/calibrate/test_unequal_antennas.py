"""Antennas that are dead or far too loud, and data with hardly any channels: told, and not converged in silence."""

import numpy as np
import pytest
from observations import with_autos
from toy import make_toy, scattered
from toy_data import make_uvdata

from calstudy.base.observation import Observation
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.interface import CALIBRATORS
from calstudy.calibrate.weights import conspicuous, dead_samples

LOUD = 14


def data(factor=1.0, n_times=1):
    """Return visibilities of six antennas, of which number 14 has its amplitudes multiplied."""
    uvd = make_uvdata(make_toy(scattered(6)), n_times)
    uvd.data_array[(uvd.ant_1_array == LOUD) | (uvd.ant_2_array == LOUD)] *= factor
    return uvd


def calibrated(uvd, **settings):
    basis = {"min_delay": "50 ns", "buffer": "50 ns"}
    calibrator = CALIBRATORS.make({"calibrator": "calamity", "basis": basis, "weights": "flags", **settings})
    return run_calibrator(calibrator, uvd)


@pytest.mark.parametrize("factor", [1e4, 1e6, 1e8])
def test_an_antenna_that_hides_the_others_is_named_and_no_solve_converges(factor):
    uvd = data(factor)
    [told] = conspicuous(Observation(uvd))
    assert told.startswith(f"Antenna {LOUD}: amplitudes of its visibilities are {factor:.2g} times the median")
    [record] = calibrated(uvd).solutions
    assert record.status == "stalled"


@pytest.mark.parametrize("factor", [1 / 20, 1, 20])
def test_amplitudes_that_arrays_have_are_no_matter(factor):
    assert conspicuous(Observation(data(factor))) == []


def test_a_dead_antenna_is_flagged_and_named_and_leaves_the_others_alone():
    uvd = data(0)
    assert conspicuous(Observation(uvd)) == [
        "320 samples are exactly zero, as all of an antenna then, and count as flagged, all that there are of "
        f"antenna(s) {LOUD}."
    ]
    found = calibrated(uvd)
    dead = found.gains.ant_array == LOUD
    assert found.gains.flag_array[dead].all()
    assert not found.gains.flag_array[~dead].any()
    touching = (found.residual.ant_1_array == LOUD) | (found.residual.ant_2_array == LOUD)
    assert found.residual.flag_array[touching].all()
    assert not found.residual.flag_array[~touching].any()


def with_flags(antenna, autos, polarizations=(-5,)):
    """Return data with autocorrelations, of which those or the other visibilities of an antenna are flagged."""
    uvd = with_autos(make_uvdata(make_toy(scattered(6)), 1, polarizations), power=10.0)
    first, second = uvd.ant_1_array == antenna, uvd.ant_2_array == antenna
    uvd.flag_array[first & second if autos else first ^ second] = True
    return uvd


def test_an_antenna_that_is_lost_by_its_flagged_autocorrelations_is_named():
    """Weights from autocorrelations take its gains as its flags would; other weights solve for them."""
    uvd, flagged = with_flags(LOUD, autos=True), with_flags(LOUD, autos=False)
    by_autos, by_flags = ({"calibrator": "calamity", "weights": kind} for kind in ("autos", "flags"))
    # Five of the fifteen baselines.
    assert conspicuous(Observation(uvd), CALIBRATORS.make(by_autos)) == [
        "33.3 % of the unflagged samples have no weight by weights: autos, and count as flagged, all of antenna(s) "
        f"{LOUD} among them: autocorrelations are flagged or not positive; repair or unflag them, or use weights: "
        "gains or flags."
    ]
    assert conspicuous(Observation(uvd), CALIBRATORS.make(by_flags)) == []
    lost, told, solved = calibrated(uvd, weights="autos"), calibrated(flagged, weights="autos"), calibrated(uvd)
    antenna = lost.gains.ant_array == LOUD
    assert lost.gains.flag_array[antenna].all()
    assert not lost.gains.flag_array[~antenna].any()
    np.testing.assert_array_equal(lost.gains.gain_array, told.gains.gain_array)
    assert not solved.gains.flag_array[antenna].any()


def test_autocorrelations_that_are_flagged_in_part_take_samples_in_silence_only_if_they_are_few():
    uvd, calibrator = with_flags(LOUD, autos=False), CALIBRATORS.make({"calibrator": "calamity", "weights": "autos"})
    uvd.flag_array[:] = False
    autos = uvd.ant_1_array == uvd.ant_2_array
    uvd.flag_array[autos, :2] = True
    assert conspicuous(Observation(uvd), calibrator) == []
    uvd.flag_array[autos, :16] = True
    [told] = conspicuous(Observation(uvd), calibrator)
    assert told.startswith("25 % of the unflagged samples have no weight by weights: autos, and count as flagged: auto")


def test_a_flagged_antenna_is_named_with_its_polarization():
    uvd = with_flags(LOUD, autos=False, polarizations=(-5, -6))
    [told] = conspicuous(Observation(uvd))
    assert told == f"All visibilities of antenna(s) {LOUD} are flagged, in 1 integration(s)."
    uvd.flag_array[..., 0] = False
    [told] = conspicuous(Observation(uvd))
    assert told == f"All visibilities of antenna(s) {LOUD} (yy) are flagged, in 1 integration(s)."
    # Where all antennas are, none stands out.
    uvd.flag_array[..., 1] = True
    assert conspicuous(Observation(uvd)) == []


def test_zeros_of_one_baseline_are_data():
    uvd = data()
    uvd.data_array[(uvd.ant_1_array == LOUD) & (uvd.ant_2_array == 16)] = 0
    observation = Observation(uvd)
    assert not dead_samples(observation, np.ones(observation.n_baselines, bool)).any()


def test_a_solve_with_one_channel_is_told():
    uvd = data()
    uvd.flag_array[:] = True
    uvd.flag_array[:, 20] = False
    [told] = conspicuous(Observation(uvd))
    assert told.startswith("1 integration(s) have data in at most 1 of 64 channels")


def test_where_solves_converge_chunks_change_what_the_tolerance_leaves():
    """The rms that each solve says it has left bounds, to first order, how far two solves are from each other."""
    uvd = data(n_times=4)
    times = np.unique(uvd.time_array)
    parts = [uvd.select(times=times[part], inplace=False) for part in (slice(0, 2), slice(2, 4))]
    whole, pieces = calibrated(uvd), [calibrated(part) for part in parts]
    records = [*whole.solutions, *(record for piece in pieces for record in piece.solutions)]
    assert {record.status for record in records} == {"converged"}
    residual = np.concatenate([piece.residual.data_array for piece in pieces])
    difference = np.sqrt(np.mean(np.abs(whole.residual.data_array - residual) ** 2))
    assert 0 < difference < 2 * max(record.decrement_rms for record in records)
