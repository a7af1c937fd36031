"""Corruption: levels, noise and gains are what the paper says."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from observations import small_instrument
from pydantic import ValidationError
from pyuvdata.utils import uvcalibrate
from tiny import tiny

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.gains import gains_for, make_uvcal
from calstudy.base.observation import Observation
from calstudy.base.visibilities import antenna_indices, from_cube, to_cube
from calstudy.corrupt.effects.gains import FileGains, PerChannelGains, ReflectionGains, reflection_gain
from calstudy.corrupt.interface import GainEffect, apply_effect, draw_truth
from calstudy.corrupt.levels import rms, set_levels
from calstudy.corrupt.noise import thermal_noise
from calstudy.corrupt.settings import EFFECTS, CorruptionSettings
from calstudy.experiment.files import override, validate
from calstudy.instrument.as_built import AsBuilt
from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.telescope import make_template


def complex_normal(rng, shape):
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def observation(antennas: int, channels: int, polarizations: tuple[str, ...] = ("xx",)):
    """Return a line of antennas without data."""
    settings = {
        "layout": {"kind": "linear", "count": antennas},
        "channels": {"first": "167.075 MHz", "count": channels},
        "times": {"count": 1},
        "polarizations": polarizations,
    }
    return Observation(make_template(InstrumentSettings.model_validate(settings)))


class Given(GainEffect):
    """Gains from a test."""

    def gains(self, observation, random):
        return self._gains

    def __init__(self, gains: np.ndarray) -> None:
        super().__init__()
        object.__setattr__(self, "_gains", gains)


def corrupted(effect, uvd):
    """Return visibilities after an effect."""
    observed = Observation(uvd)
    return apply_effect(effect, to_cube(uvd).copy(), observed, draw_truth(effect, observed))


def test_noise_has_the_asked_variance_in_both_parts_and_is_white():
    noise = thermal_noise((200, 500), std=3.0, seed=1)
    # 1e5 samples: relative error of a variance is sqrt(2 / 1e5) = 0.45 %.
    assert np.var(noise.real) == pytest.approx(4.5, rel=0.02)
    assert np.var(noise.imag) == pytest.approx(4.5, rel=0.02)
    assert abs(np.mean(noise[:, 1:] * noise[:, :-1].conj())) < 4 * 9 / np.sqrt(noise.size)
    assert abs(np.mean(noise.real * noise.imag)) < 4 * 4.5 / np.sqrt(noise.size)


def test_noise_depends_on_its_seed_only():
    assert np.array_equal(thermal_noise((4, 5), 1.0, 7), thermal_noise((4, 5), 1.0, 7))
    assert abs(np.vdot(thermal_noise((100, 100), 1.0, 7), thermal_noise((100, 100), 1.0, 8))) / 1e4 < 0.05


def test_per_channel_gains_scatter_about_unity_by_sigma_in_each_part():
    gains = draw_truth(PerChannelGains(sigma=0.1, seed=5), observation(100, 1000))["gains"][:, :, 0, 0]
    assert np.mean(gains) == pytest.approx(1, abs=2e-3)
    assert np.std(gains.real) == pytest.approx(0.1, rel=0.01)
    assert np.std(gains.imag) == pytest.approx(0.1, rel=0.01)
    assert abs(np.mean((gains[:, 1:] - 1) * (gains[:, :-1] - 1).conj())) < 4 * 0.02 / np.sqrt(1e5)


def test_draws_are_those_of_the_published_experiments_to_the_bit():
    """One stream for all polarizations: antennas, then channels, of one after the other."""
    observed = observation(4, 8, ("xx", "yy"))
    real, imaginary = np.random.default_rng(5).standard_normal((2, 8, 8))
    expected = (1 + 0.1 * (real + 1j * imaginary)).reshape(2, 4, 8)
    assert np.array_equal(draw_truth(PerChannelGains(), observed)["gains"][:, :, 0].transpose(2, 0, 1), expected)
    random = np.random.default_rng(5)
    drawn = random.exponential(0.01, 8), random.normal(1200e-9, 100e-9, 8), random.uniform(0, 2 * np.pi, 8)
    expected = reflection_gain(observed.frequencies, *(values[:, None] for values in drawn)).reshape(2, 4, 8)
    assert np.array_equal(draw_truth(ReflectionGains(), observed)["gains"][:, :, 0].transpose(2, 0, 1), expected)


@given(r=st.floats(0, 0.3), tau=st.floats(-2e-6, 2e-6), phi=st.floats(-3, 3))
def test_a_reflection_gain_is_the_sum_of_its_echoes(r, tau, phi):
    nu = 167e6 + 80e3 * np.arange(20)
    echo = -r * np.exp(-1j * (2 * np.pi * nu * tau + phi))
    assert reflection_gain(nu, r, tau, phi) == pytest.approx(sum(echo**n for n in range(40)), abs=1e-12)


def test_reflections_peak_at_their_delay_with_their_amplitude():
    observed = observation(300, 384)
    nu = observed.frequencies
    draws = [draw_truth(ReflectionGains(seed=seed), observed)["gains"][:, :, 0, 0] for seed in range(7)]
    gains = np.concatenate(draws)
    spectrum = np.abs(np.fft.fft(gains - gains.mean(axis=1, keepdims=True), axis=1)) / nu.size
    delay = np.abs(np.fft.fftfreq(nu.size, 80e3))[spectrum.argmax(axis=1)]
    assert np.mean(delay) == pytest.approx(1200e-9, abs=20e-9)
    # The mean of r over 2100 antennas is known to 0.01 / sqrt(2100); scalloping loses up to 36 % of a peak.
    assert 0.007 < spectrum.max(axis=1).mean() < 0.0105


def test_a_reflection_that_does_not_decay_is_refused():
    with pytest.raises(InputError, match=r"corruption\.effects: amplitude = 0\.9: drew a reflection of"):
        draw_truth(ReflectionGains(amplitude=0.9), observation(100, 8))


def test_levels_put_the_eor_40_db_below_in_amplitude_and_the_noise_10_times_above():
    levels = set_levels(foreground_rms=50.0, eor_rms=2.0, settings=CorruptionSettings())
    assert levels.eor_factor * 2.0 == pytest.approx(50.0 * 1e-4)
    assert levels.noise_std == pytest.approx(10 * 50.0 * 1e-4)


def test_noise_may_follow_the_foregrounds_and_the_eor_keep_absolute_units():
    settings = CorruptionSettings.model_validate({"eor_level": None, "noise": "times-foregrounds"})
    levels = set_levels(50.0, 2.0, settings)
    assert (levels.eor_factor, levels.noise_std) == (1.0, 5.0)


def test_a_level_relative_to_nothing_is_refused():
    with pytest.raises(InputError, match="eor_level"):
        set_levels(0.0, 2.0, CorruptionSettings())
    with pytest.raises(InputError, match="all zero"):
        set_levels(1.0, 0.0, CorruptionSettings())


def test_rms_is_over_complex_samples():
    assert rms(np.array([3.0, 4.0j])) == pytest.approx(np.sqrt(12.5))


def test_gains_multiply_by_g_a_and_conjugate_g_b(template, rng):
    cube = complex_normal(rng, (template.Ntimes, template.Nbls, template.Nfreqs, template.Npols))
    gains = complex_normal(rng, (template.Nants_telescope, template.Nfreqs, 1, template.Npols))
    a, b = antenna_indices(template).T
    expected = gains[a, :, 0] * gains[b, :, 0].conj() * cube
    assert corrupted(Given(gains), from_cube(template, cube)) == pytest.approx(expected, rel=1e-13)


def test_gains_read_from_a_file_are_those_written(template, rng, tmp_path):
    gains = complex_normal(rng, (template.Nants_telescope, template.Nfreqs, 1, template.Npols))
    make_uvcal(template, gains).write_calh5(tmp_path / "g.calh5")
    assert np.array_equal(draw_truth(FileGains(path=tmp_path / "g.calh5"), Observation(template))["gains"], gains)


def test_gains_of_a_file_are_those_of_their_times_in_any_order(template, rng, tmp_path):
    gains = complex_normal(rng, (template.Nants_telescope, template.Nfreqs, template.Ntimes, template.Npols))
    cal = make_uvcal(template, gains)
    cal.reorder_times("-time")
    cal.write_calh5(tmp_path / "g.calh5")
    assert np.array_equal(draw_truth(FileGains(path=tmp_path / "g.calh5"), Observation(template))["gains"], gains)


def test_gains_of_other_channels_or_antennas_are_refused(template, tmp_path):
    unity = make_uvcal(template, np.ones((template.Nants_telescope, template.Nfreqs, 1, template.Npols), complex))
    shifted = unity.copy()
    shifted.freq_array = shifted.freq_array + 5e6
    with pytest.raises(InputError, match="no channel at 167"):
        gains_for(shifted, template)
    with pytest.raises(InputError, match=r"no solution for antenna\(s\) 6"):
        gains_for(unity.select(antenna_nums=list(range(6)), inplace=False), template)
    (tmp_path / "noise.calh5").write_bytes(b"no gains")
    with pytest.raises(InputError, match=r"corruption\.effects: path = '.*noise.calh5': not a readable file of CalH5"):
        draw_truth(FileGains(path=tmp_path / "noise.calh5"), Observation(template))


@pytest.mark.parametrize("convention", ["divide", "multiply"])
def test_a_gain_file_corrupts_as_pyuvdata_understands_it(template, rng, tmp_path, convention):
    gains = complex_normal(rng, (template.Nants_telescope, template.Nfreqs, 1, template.Npols))
    cal = make_uvcal(template, gains)
    cal.gain_convention = convention
    cal.write_calh5(tmp_path / "g.calh5")
    sky = from_cube(template, np.ones((template.Ntimes, template.Nbls, template.Nfreqs, template.Npols), complex))
    raw = from_cube(template, corrupted(FileGains(path=tmp_path / "g.calh5"), sky))
    raw.vis_units, raw.pol_convention = "uncalib", None
    calibrated = uvcalibrate(raw, cal, inplace=False, time_check=False)
    assert to_cube(calibrated) == pytest.approx(1, rel=1e-12)


def test_flagged_gains_of_a_file_count_as_unity(template, tmp_path):
    cal = make_uvcal(template, np.full((template.Nants_telescope, template.Nfreqs, 1, template.Npols), 5 + 0j))
    cal.flag_array[2, 3] = True
    cal.write_calh5(tmp_path / "g.calh5")
    gains = draw_truth(FileGains(path=tmp_path / "g.calh5"), Observation(template))["gains"]
    assert gains[2, 3] == 1
    assert np.count_nonzero(gains != 5) == 1


def test_gains_of_another_number_of_times_or_delays_are_refused(template, tmp_path):
    shape = (template.Nants_telescope, template.Nfreqs, template.Ntimes, template.Npols)
    make_uvcal(template, np.ones(shape, complex)).write_calh5(tmp_path / "g.calh5")
    other = Observation(make_template(small_instrument(times={"count": 5})))
    with pytest.raises(InputError, match="holds gains for 3 times; it must hold them for one, or for each of the 5"):
        draw_truth(FileGains(path=tmp_path / "g.calh5"), other)
    delays = make_uvcal(template, np.ones((*shape[:2], 1, shape[3]), complex))
    delays.cal_type = "delay"
    with pytest.raises(InputError, match="holds delay solutions"):
        gains_for(delays, template)


@pytest.mark.parametrize(
    ("gains", "told"),
    [
        (np.ones((3, 2, 1, 1), complex), r"of shape \(3, 2, 1, 1\), expected complex of shape"),
        (0.0, "zero or not finite"),
        (np.nan, "zero or not finite"),
    ],
)
def test_gains_that_are_none_are_refused(template, gains, told):
    shape = (template.Nants_telescope, template.Nfreqs, 1, template.Npols)
    with pytest.raises(InputError, match=told):
        draw_truth(Given(np.full(shape, gains, complex) if np.isscalar(gains) else gains), Observation(template))


def test_positions_and_effects_with_one_seed_are_refused(tmp_path):
    data = tiny(tmp_path)
    data["instrument"] = {**data["instrument"], "as_built": {"positions": {"scatter": "1 cm", "seed": 5}}}
    with pytest.raises(ExperimentError, match="is 5, as that of instrument"):
        validate(data, tmp_path)
    # Nothing is drawn from it.
    data["instrument"]["as_built"]["positions"]["scatter"] = "0 cm"
    assert validate(data, tmp_path).instrument.as_built.drawn_seeds == {}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"corruption.effects": [{"kind": "per-channel-gains", "seed": 3}]}, "is 3, as that of corruption.noise"),
        ({"instrument.as_built": {"positions": {"scatter": "1 cm", "seed": 4}}}, "as that of instrument.as_built"),
        (
            {
                "instrument.as_built": {
                    "positions": {"scatter": "1 cm", "seed": 9},
                    "beams": {"pointing_scatter": "1 deg", "seed": 9},
                }
            },
            "is 9, as that of instrument.as_built.positions",
        ),
        # A drift of an effect that draws nothing, or has a seed of zero, has the stream of its own seed.
        (
            {"corruption.effects": [{"kind": "bandpass", "seed": 0, "drift": {"kind": "jumps", "seed": 4}}]},
            r"effects\.0\.drift\.seed: is 4, as that of corruption.noise",
        ),
        (
            {
                "corruption.effects": [
                    {"kind": "per-channel-gains", "seed": 8},
                    {"kind": "bandpass", "seed": 0, "drift": {"kind": "jumps", "seed": 8}},
                ]
            },
            r"effects\.1\.drift\.seed: is 8, as that of item 0",
        ),
        ({"corruption.noise.seeds_without_eor": [4, 3]}, "has the seed of even data where seeds has that of odd"),
    ],
)
def test_what_draws_the_same_numbers_is_refused(changes, told, tmp_path):
    data = tiny(tmp_path)
    for path, value in changes.items():
        data = override(data, path, value)
    data = override(data, "corruption.noise.seeds", [3, 4])
    with pytest.raises(ExperimentError, match=told):
        validate(data, tmp_path)


def test_default_seeds_are_all_different():
    names = [name for name in EFFECTS.built_in() if "seed" in EFFECTS.find(name).model_fields]
    seeds = [EFFECTS.find(name).model_fields["seed"].default for name in names if name != "reflection-gains"]
    seeds += [AsBuilt().positions.seed, AsBuilt().beams.seed]
    assert len(set(seeds)) == len(seeds)


def test_two_effects_with_one_seed_are_refused():
    with pytest.raises(ValidationError, match="would not be independent"):
        CorruptionSettings.model_validate({"effects": ["per-channel-gains", "reflection-gains"]})
    both = {"effects": ["per-channel-gains", {"kind": "reflection-gains", "seed": 6}]}
    settings = CorruptionSettings.model_validate(both)
    assert settings.gains == PerChannelGains()
    assert CorruptionSettings(effects=()).gains is None
    dead = [{"kind": "dead-antennas", "antennas": [antenna]} for antenna in (0, 5)]
    assert len(CorruptionSettings.model_validate({"effects": dead}).effects) == 2
    with pytest.raises(ValidationError, match="would not be independent"):
        CorruptionSettings.model_validate({"effects": ["dead-antennas", {"kind": "dead-antennas", "count": 2}]})
