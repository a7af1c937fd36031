"""Two files of gains: what no calibration knows does not count, everything else does, where it is."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from command_line import run_command
from toy import FREQUENCIES, complex_normal, make_toy, scattered
from toy_data import make_uvdata

import calstudy
from calstudy.base.errors import InputError
from calstudy.base.gains import ErrorsOfFile, make_uvcal, write_gain_errors
from calstudy.calibrate.gain_comparison import GainPair, compare_gains, pair_gains

DRAWN = True

N_ANTENNAS = 9


@pytest.fixture(scope="module")
def template():
    return make_uvdata(make_toy(scattered(N_ANTENNAS)), n_times=2)


@pytest.fixture(scope="module")
def gains():
    rng = np.random.default_rng(1)
    return 1 + 0.1 * complex_normal(rng, (N_ANTENNAS, FREQUENCIES.size, 2, 1))


def differ(template, first, second, redundant=False, flags=None):
    pair = pair_gains(make_uvcal(template, first, flags), make_uvcal(template, second))
    return compare_gains(pair, redundant)


def test_a_phase_for_every_channel_and_a_scale_do_not_count(template, gains):
    rng = np.random.default_rng(2)
    phase = np.exp(2j * np.pi * rng.random((1, FREQUENCIES.size, 2, 1)))
    found = differ(template, 1.3 * phase * gains, gains)
    assert found.as_given > 1
    assert max(found.of_antenna.max(), found.of_channel.max(), found.of_delay.max()) < 1e-12


def test_feeds_of_the_same_direction_are_compared(gains):
    east = make_uvdata(make_toy(scattered(N_ANTENNAS)), 2, (-5, -6))
    north = east.copy()
    north.telescope.set_feeds_from_x_orientation("north", feeds=["x", "y"])
    both = np.concatenate([gains, gains.conj()], axis=3)
    pair = pair_gains(make_uvcal(east, both), make_uvcal(north, both[..., ::-1]))
    assert np.array_equal(pair.first, pair.second)


def test_amplitudes_and_gradients_count_unless_the_array_is_redundant(template, gains):
    rng = np.random.default_rng(3)
    positions = template.telescope.get_enu_antpos()[:, :2]
    slopes = 0.03 * rng.standard_normal((2, FREQUENCIES.size))
    changed = gains * np.exp(1j * positions @ slopes)[:, :, None, None]
    changed = changed * (1 + 0.1 * rng.random((1, FREQUENCIES.size, 1, 1)))
    assert np.median(differ(template, changed, gains).of_antenna) > 0.05
    found = differ(template, changed, gains, redundant=True)
    assert max(found.of_antenna.max(), found.of_channel.max()) < 1e-10


def test_gradients_may_be_several_turns_across_a_redundant_array():
    """On a lattice a whole turn per step changes nothing: any gradient is found, up to the errors of the gains."""
    rng = np.random.default_rng(6)
    lattice = np.array([(i + j / 2, j * np.sqrt(3) / 2) for i in range(4) for j in range(4)])
    angle = rng.uniform(-np.pi, np.pi, (2, 16))
    gradients = 5 * np.pi / 14.6 * np.stack([np.cos(angle), np.sin(angle)])
    second = 1 + 0.1 * complex_normal(rng, (2, len(lattice), 16))
    turned = second * np.exp(1j * np.einsum("ai,itf->taf", 14.6 * lattice, gradients))
    first = turned * (1 + 0.01 * complex_normal(rng, second.shape))
    frequency = np.linspace(100e6, 115e6, 16)
    pair = GainPair(np.arange(len(lattice)).astype(str), 14.6 * lattice, frequency, "x", first, second)
    found = compare_gains(pair, redundant=True)
    # Of 16 antennas, amplitude, phase and gradient of each channel take four of 32 real numbers.
    assert found.together == pytest.approx(0.01 * np.sqrt(28 / 32), rel=0.1)


@pytest.mark.filterwarnings("ignore")
def test_only_common_channels_are_compared(template, gains, tmp_path, capsys):
    changed = gains.copy()
    changed[:, :8] *= 2
    make_uvcal(template, gains).write_calh5(tmp_path / "all.calh5")
    part = make_uvcal(template, changed).select(freq_chans=np.arange(8, 40), inplace=False)
    part.write_calh5(tmp_path / "part.calh5")
    for files in (("all", "part"), ("part", "all")):
        paths = [tmp_path / f"{name}.calh5" for name in files]
        status, told = run_command(capsys, "compare-gains", *paths, "--output", tmp_path / files[0])
        assert status == 0, told
        numbers = json.loads((tmp_path / files[0] / "gain-comparison.json").read_text())
        assert numbers["channels"] == 32
        # Doubles agree to rounding.
        assert numbers["difference"] < 1e-12
    other = part.copy()
    other.freq_array += 1e9
    other.write_calh5(tmp_path / "other.calh5")
    status, told = run_command(capsys, "compare-gains", tmp_path / "all.calh5", tmp_path / "other.calh5")
    assert status == 2
    assert "the two files have no channel in common" in told


def test_gains_with_gaps_are_compared_by_delay(template, gains):
    changed = gains.copy()
    changed[4, :, :, 0] *= 1 + 0.01 * np.exp(2j * np.pi * 600e-9 * FREQUENCIES)[:, None]
    kept = np.delete(np.arange(FREQUENCIES.size), [11, 20, 21])
    one, other = (make_uvcal(template, values).select(freq_chans=kept, inplace=False) for values in (changed, gains))
    found = compare_gains(pair_gains(one, other))
    assert found.of_channel.size == kept.size
    assert found.delay.size == FREQUENCIES.size
    assert abs(found.delay[found.of_delay.argmax()]) == pytest.approx(600e-9, abs=100e-9)
    with pytest.raises(InputError, match="one channel in common"):
        compare_gains(pair_gains(*(cal.select(freq_chans=[3], inplace=False) for cal in (one, other))))
    for cal in (one, other):
        cal.freq_array[5] += 0.3 * np.diff(FREQUENCIES)[0]
    with pytest.raises(InputError, match="do not lie on an evenly spaced grid"):
        compare_gains(pair_gains(one, other))


@pytest.mark.filterwarnings("ignore")
def test_a_comparison_is_not_overwritten_unasked(template, gains, tmp_path, capsys):
    make_uvcal(template, gains).write_calh5(tmp_path / "a.calh5")
    command = ("compare-gains", tmp_path / "a.calh5", tmp_path / "a.calh5", "--output")
    assert run_command(capsys, *command, tmp_path / "out")[0] == 0
    status, told = run_command(capsys, *command, tmp_path / "out")
    assert status == 2
    assert "holds gain-comparison.json already; use --overwrite or another folder" in told
    assert run_command(capsys, *command, tmp_path / "out", "--overwrite")[0] == 0
    status, told = run_command(capsys, *command, tmp_path / "a.calh5")
    assert status == 2
    assert "cannot be written" in told


def test_an_error_is_found_where_it_is(template, gains):
    changed = gains.copy()
    # A reflection of 1 % at 600 ns in one antenna.
    changed[4, :, :, 0] *= 1 + 0.01 * np.exp(2j * np.pi * 600e-9 * FREQUENCIES)[:, None]
    found = differ(template, changed, gains)
    assert found.of_antenna.argmax() == 4
    # Its phase is shared by all antennas once each channel is aligned: a ninth is taken out.
    assert found.of_antenna[4] == pytest.approx(0.01, rel=0.15)
    assert abs(found.delay[found.of_delay.argmax()]) == pytest.approx(600e-9, abs=100e-9)
    changed = gains.copy()
    changed[:, 20] *= np.linspace(0.9, 1.1, N_ANTENNAS)[:, None, None]
    assert differ(template, changed, gains).of_channel.argmax() == 20


def test_flagged_gains_do_not_count_and_conventions_do_not_matter(template, gains):
    flags = np.zeros(gains.shape, bool)
    flags[2], flags[:, 7] = True, True
    found = differ(template, np.where(flags, 1e3, gains), gains, flags=flags)
    assert np.isnan(found.of_antenna[2])
    assert np.isnan(found.of_channel[7])
    assert np.nanmax(found.of_antenna) < 1e-12
    multiply = make_uvcal(template, 1 / gains)
    multiply.gain_convention = "multiply"
    assert compare_gains(pair_gains(multiply, make_uvcal(template, gains))).of_antenna.max() < 1e-12
    # One gain for the whole run is compared with every integration.
    constant = make_uvcal(template, gains[:, :, :1])
    assert pair_gains(make_uvcal(template, gains), constant).second.shape == (2, N_ANTENNAS, FREQUENCIES.size)


def test_files_that_have_nothing_in_common_are_refused(template, gains):
    cal = make_uvcal(template, gains)
    fewer = cal.select(freq_chans=np.arange(32), inplace=False)
    with pytest.raises(InputError, match="do not have the same channels"):
        pair_gains(cal, fewer)
    with pytest.raises(InputError, match="flagged in either"):
        differ(template, gains, gains, flags=np.ones(gains.shape, bool))
    left, right = (cal.select(antenna_nums=cal.ant_array[part], inplace=False) for part in (slice(4), slice(4, None)))
    with pytest.raises(InputError, match="no antenna in common"):
        pair_gains(left, right)
    other = cal.copy()
    other.jones_array = np.array([-6])
    with pytest.raises(InputError, match=r"0 feed.* in common.*: the first has gains of xx, the second of yy"):
        pair_gains(cal, other)


@pytest.mark.filterwarnings("ignore")
def test_the_command_writes_numbers_and_a_figure(template, gains, tmp_path, capsys):
    changed = gains * (1 + 0.01 * complex_normal(np.random.default_rng(4), gains.shape))
    # The last antenna has gains in one of the files only.
    flags = np.zeros(gains.shape, bool)
    flags[-1] = True
    make_uvcal(template, changed, flags).write_calh5(tmp_path / "a.calh5")
    make_uvcal(template, gains).write_calh5(tmp_path / "b.calh5")
    out = tmp_path / "out"
    status, told = run_command(capsys, "compare-gains", tmp_path / "a.calh5", tmp_path / "b.calh5", "--output", out)
    assert status == 0, told
    numbers = json.loads((out / "gain-comparison.json").read_text())
    assert numbers["antennas"] == N_ANTENNAS - 1
    # Of few antennas, the phase of each channel takes a part of the imaginary parts: an eighth of eight.
    assert numbers["difference"] == pytest.approx(0.01, rel=0.1)
    assert {path.suffix for path in out.iterdir()} == {".json", ".npz", ".pdf", ".png"}
    status, told = run_command(capsys, "compare-gains", tmp_path / "a.calh5", tmp_path / "c.calh5")
    assert status == 2
    assert "the second file" in told
    assert "no such file" in told


@pytest.mark.filterwarnings("ignore")
@pytest.mark.chain
def test_gains_of_two_noise_realizations_differ_by_their_errors_and_others_by_more(tmp_path, capsys):
    """Of calamity, whose errors leave smooth gains out: chi^2 is one for equal gains and above it for others."""
    toy = make_toy(scattered(10), noise=1e-2)
    size = np.sqrt(np.mean(np.abs(toy.noise) ** 2))
    rng = np.random.default_rng(8)
    # Real and imaginary parts move by twice their errors, which are about a third of the noise over the signal.
    moved = toy.gains * (1 + 1e-2 * complex_normal(rng, toy.gains.shape))
    settings = {"basis": {"min_delay": "50 ns", "buffer": "50 ns"}, "weights": "flags"}
    for name, gains in (("one", toy.gains), ("two", toy.gains), ("moved", moved)):
        measured = replace(toy, gains=gains, noise=size * complex_normal(rng, toy.noise.shape))
        make_uvdata(measured, n_times=1).write_uvh5(tmp_path / f"{name}.uvh5")
        calstudy.calibrate_data(tmp_path / f"{name}.uvh5", tmp_path / name, quiet=True, **settings)
    found = {}
    for name in ("two", "moved"):
        files = [tmp_path / part / "gains.calh5" for part in ("one", name)]
        status, told = run_command(capsys, "compare-gains", *files, "--output", tmp_path / name)
        assert status == 0, told
        numbers = json.loads((tmp_path / name / "gain-comparison.json").read_text())
        found[name] = [numbers[f"chi-squared per {part}"] for part in ("amplitude", "phase")]
        assert numbers["gains that are compared with their errors"].startswith("beyond")
    # About 300 numbers each, whose chi^2 scatters by 0.08.
    assert found["two"] == pytest.approx([1, 1], abs=0.25)
    assert min(found["moved"]) > 2


def with_errors(template, path, gains, size, smooth_delay=0.0, realizations=0):
    make_uvcal(template, gains).write_calh5(path)
    shape = make_uvcal(template, gains).gain_array.shape
    write_gain_errors(path, ErrorsOfFile(np.full(shape, size), np.full(shape, size), smooth_delay, realizations))
    return path


@pytest.mark.filterwarnings("ignore")
def test_errors_of_realizations_have_a_distribution_of_their_own_and_few_tell_nothing(template, tmp_path, capsys):
    rng, shape, size = np.random.default_rng(9), (N_ANTENNAS, FREQUENCIES.size, 2, 1), 0.01
    one, two = (np.exp(size * np.sqrt(2) * complex_normal(rng, shape)) for _ in range(2))
    first = with_errors(template, tmp_path / "one.calh5", one, size)
    for count, expected in ((0, "68.3 and 95.0"), (10, "67.6 and 94.2")):
        # One of two errors is exact, and four times nine degrees of freedom are left.
        second = with_errors(template, tmp_path / f"{count}.calh5", two, size, realizations=count)
        status, told = run_command(capsys, "compare-gains", first, second, "--output", tmp_path / "out", "--overwrite")
        assert status == 0, told
        numbers = json.loads((tmp_path / "out" / "gain-comparison.json").read_text())
        assert f"({expected} % if" in numbers["amplitudes within 1 and 1.96 errors"]
        # Of 1152 numbers; the phase of each channel takes a ninth of the imaginary parts.
        shrunk = 36 / 34 if count else 1
        assert numbers["chi-squared per amplitude"] == pytest.approx(1 / shrunk, abs=0.15)
    for name, changes, reason in (
        ("few", {"realizations": 5}, "of 5 realizations"),
        ("smooth", {"smooth_delay": 3e-7}, "up to 0 and 300 ns"),
    ):
        second = with_errors(template, tmp_path / f"{name}.calh5", two, size, **changes)
        status, told = run_command(capsys, "compare-gains", first, second, "--output", tmp_path / "out", "--overwrite")
        assert status == 0, told
        assert reason in told
        assert "chi-squared" not in (tmp_path / "out" / "gain-comparison.json").read_text()


def test_chi_squared_does_not_depend_on_the_level_of_the_gains(template, gains):
    """Errors are of amplitudes, in the unit of the gains, and of phases."""
    other = gains * (1 + 0.01 * complex_normal(np.random.default_rng(10), gains.shape))
    found = []
    for level in (1.0, 30.0):
        cals = [make_uvcal(template, level * values) for values in (gains, other)]
        size = np.full(gains.shape, 0.01)
        found.append(compare_gains(pair_gains(*cals, errors=(ErrorsOfFile(level * size, size, 0.0),) * 2)).chi_squared)
    assert found[1] == pytest.approx(found[0], rel=1e-9)


def test_without_common_errors_there_is_no_chi_squared(template, gains):
    cals = [make_uvcal(template, gains), make_uvcal(template, 1.01 * gains)]
    errors = [ErrorsOfFile(np.full(gains.shape, 0.01), np.full(gains.shape, 0.01), 0.0) for _ in cals]
    errors[0].amplitude[:4] = np.nan
    errors[1].amplitude[4:] = np.nan
    found = compare_gains(pair_gains(*cals, errors=tuple(errors)))
    assert found.pulls is None
    assert found.chi_squared == found.within == []
