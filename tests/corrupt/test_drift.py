"""Gains that change during a run do so with the statistics that are asked for."""

from __future__ import annotations

import numpy as np
import pytest
from observations import small_instrument
from plugin_files import make
from pydantic import ValidationError
from tiny import tiny

from calstudy.base.errors import InputError
from calstudy.base.gains import make_uvcal
from calstudy.base.identity import identity
from calstudy.base.observation import Observation
from calstudy.base.visibilities import antenna_indices
from calstudy.corrupt.drift import RandomWalk
from calstudy.corrupt.effects.gains import FileGains, PerChannelGains
from calstudy.corrupt.interface import Effect, apply_effect, draw_truth, require_usable
from calstudy.corrupt.settings import CorruptionSettings
from calstudy.experiment.files import override, validate
from calstudy.instrument.layouts import size_of_instrument
from calstudy.instrument.telescope import make_template
from calstudy.power.delay import make_taper
from calstudy.products import agreement, calibration, corruption, signal_loss, spectra
from calstudy.products.files import AGREEMENT, RESIDUAL, read_json, read_visibilities
from calstudy.products.graph import Graph
from calstudy.products.selection import read_gains

SECONDS = 5.0
TIMES = 60


@pytest.fixture(scope="module")
def observed() -> Observation:
    """Thirty antennas, twenty channels and sixty integrations of 5 s, two polarizations, without data."""
    instrument = small_instrument(
        layout={"kind": "linear", "count": 30},
        channels={"count": 20},
        times={"count": TIMES, "integration": f"{SECONDS} s"},
        polarizations=["xx", "yy"],
    )
    return Observation(make_template(instrument))


def drifted(observed: Observation, effect: str = "per-channel-gains", **drift: object) -> np.ndarray:
    """Return u + i v, the logarithm of what gains are multiplied by, (Nants, Nfreqs, Ntimes, Npols)."""
    block = {"kind": effect, "seed": 3}
    gains = draw_truth(Effect.registry.make({**block, "drift": drift}), observed)["gains"]
    return np.log(gains / draw_truth(Effect.registry.make(block), observed)["gains"])


def test_the_variance_of_a_random_walk_grows_linearly_from_the_drawn_gains(observed):
    change = drifted(
        observed, kind="random-walk", amplitude=0.02, phase="0.04 rad", time="50 s", channels="independent"
    )
    assert change.shape == (30, 20, TIMES, 2)
    assert change[:, :, 0] == pytest.approx(0, abs=1e-15)
    for part, scale in ((change.real, 0.02), (change.imag, 0.04)):
        variance = np.var(part, axis=(0, 1, 3))[1:] / (scale**2 * np.arange(1, TIMES) * SECONDS / 50)
        # 1200 walks: the variance is known to sqrt(2 / 1200) = 4 %.
        assert abs(variance - 1).max() < 0.17
        steps = np.diff(part, axis=2)
        assert abs(np.mean(steps[:, :, 1:] * steps[:, :, :-1])) < 5 * np.var(steps) / np.sqrt(steps.size)
    assert abs(np.mean(change.real * change.imag)) < 0.15 * np.std(change.real) * np.std(change.imag)


def test_channels_drift_alike_unless_they_are_independent(observed):
    common = drifted(observed, kind="random-walk")
    assert common == pytest.approx(np.broadcast_to(common[:, :1], common.shape), abs=1e-13)
    last = drifted(observed, kind="random-walk", channels="independent")[:, :, -1].real
    correlation = np.mean(last[:, 1:] * last[:, :-1]) / np.var(last)
    assert abs(correlation) < 5 / np.sqrt(last.size)


@pytest.fixture(scope="module")
def wideband() -> Observation:
    """Thirty antennas, 64 channels of 480 kHz and ten integrations of 5 s, without data."""
    instrument = small_instrument(
        layout={"kind": "linear", "count": 30},
        channels={"count": 64, "width": "480 kHz"},
        times={"count": 10, "integration": f"{SECONDS} s"},
        polarizations=["xx", "yy"],
    )
    return Observation(make_template(instrument))


@pytest.mark.parametrize("channels", [{"kind": "polynomial", "order": 3}, {"kind": "delays", "max_delay": "200 ns"}])
def test_a_drift_with_a_shape_has_its_rms_in_the_mean_over_the_band(wideband, channels):
    change = drifted(wideband, kind="random-walk", amplitude=0.02, phase="0.04 rad", time="50 s", channels=channels)
    assert change.shape == (30, 64, 10, 2)
    assert change[:, :, 0] == pytest.approx(0, abs=1e-14)
    for part, scale in ((change.real, 0.02), (change.imag, 0.04)):
        growth = np.mean(part[:, :, 1:] ** 2, axis=(0, 1, 3)) / (scale**2 * np.arange(1, 10) * SECONDS / 50)
        # 60 walks, each of four components at least: the variance is known to sqrt(2 / 240) = 9 %.
        assert abs(growth - 1).max() < 0.4
        assert np.mean(growth) == pytest.approx(1, abs=0.25)
        steps = np.diff(part, axis=2)
        for products in (steps[1:] * steps[:-1], steps[..., 0] * steps[..., 1]):
            # Averages over 29 pairs, nine steps, and four components.
            assert abs(np.mean(products)) < 5 * np.var(steps) / np.sqrt(29 * 9 * 4)
    # The covariance of Legendre polynomials up to order 3 at both ends over their variance there is -1 / 4; that of
    # delays is sinc(2 x 200 ns x 30.24 MHz) = 0.01.
    expected = -0.25 if channels["kind"] == "polynomial" else 0.01
    ends = np.moveaxis(np.diff(change, axis=2), 1, 0)[[0, -1]].reshape(2, -1)
    assert np.corrcoef(ends.real)[0, 1] == pytest.approx(expected, abs=5 / np.sqrt(ends.shape[1]))


def test_a_drift_with_a_shape_is_smooth_in_frequency(wideband):
    shape = {"kind": "polynomial", "order": 2}
    change = drifted(wideband, kind="random-walk", amplitude=0.02, channels=shape)[:, :, -1]
    place = np.linspace(-1, 1, 64)
    rows = np.moveaxis(change.real, 1, 0).reshape(64, -1)
    fitted = np.polynomial.polynomial.polyfit(place, rows, 2)
    assert np.polynomial.polynomial.polyval(place, fitted) == pytest.approx(rows.T, abs=1e-12)
    change = drifted(wideband, kind="random-walk", amplitude=0.02, channels={"kind": "delays", "max_delay": "200 ns"})
    # The window has side lobes of -150 dB and a main lobe of 6.5 / 30.72 MHz = 210 ns to either side.
    spectrum = np.fft.fft(change[:, :, -1] * np.kaiser(64, 20)[:, None], axis=1)
    power, delay = np.mean(abs(spectrum) ** 2, axis=(0, 2)), abs(np.fft.fftfreq(64, 480e3))
    assert power[delay > 450e-9].max() < 1e-12 * power[delay < 150e-9].min()


def test_a_drift_with_a_shape_of_one_component_is_that_of_all_channels(wideband):
    for kind in ("random-walk", "sinusoid", "jumps"):
        common = drifted(wideband, kind=kind)
        assert drifted(wideband, kind=kind, channels={"kind": "polynomial", "order": 0}) == pytest.approx(
            common, abs=1e-13
        )


def test_jumps_of_a_shape_come_at_the_same_times_in_all_channels(observed):
    change = drifted(observed, kind="jumps", amplitude=0.05, phase="0.1 rad", interval="100 s", channels="delays")
    steps = np.diff(change, axis=2)
    moved = abs(steps) > 1e-12
    assert (moved == moved[:, :1]).all()
    expected = -np.expm1(-SECONDS / 100)
    assert moved[:, 0].mean() == pytest.approx(expected, abs=5 * np.sqrt(expected / moved[:, 0].size))
    crowd = SECONDS / 100 / expected
    assert np.var(steps.real[moved]) == pytest.approx(0.05**2 * crowd, rel=0.4)


def test_a_sinusoid_of_a_shape_is_one_in_every_channel(wideband):
    change = drifted(wideband, kind="sinusoid", amplitude=0.03, period="40 s", channels={"kind": "delays"}).real
    angle = 2 * np.pi * np.arange(10) * SECONDS / 40
    waves = np.stack([np.sin(angle), np.cos(angle)])
    rows = np.moveaxis(change, 2, -1).reshape(-1, 10)
    fitted, misfit, *_ = np.linalg.lstsq(waves.T, rows.T, rcond=None)
    # Times are Julian dates, which are good to 4e-5 s.
    assert np.sqrt(misfit.max()) < 1e-3 * 0.03
    assert np.mean(np.sum(fitted**2, axis=0)) == pytest.approx(0.03**2, rel=0.25)


def test_words_for_channels_keep_their_keys_and_anything_else_is_refused_in_one_sentence(tmp_path):
    def keyed(channels: object) -> object:
        return identity(RandomWalk.model_validate({"kind": "random-walk", "channels": channels}))

    assert keyed("common") == {"kind": "random-walk"}
    assert keyed("independent") == {"kind": "random-walk", "channels": "independent"}
    assert keyed("delays") == {"kind": "random-walk", "channels": {"kind": "delays"}}
    effect = {"kind": "per-channel-gains", "drift": {"kind": "jumps", "channels": {"kind": "delays"}}}
    data = override(tiny(tmp_path), "corruption.effects", [effect])
    allowed = "(allowed: common, independent, polynomial, delays, correlated)"
    for channels, told in (
        ("comn", "drift.channels: 'comn' is not a choice, did you mean 'common'? " + allowed),
        ({"kind": "delays", "max_delay": "-1 ns"}, "drift.channels.max_delay = '-1 ns': must be greater than 0 s"),
    ):
        effect["drift"]["channels"] = channels
        with pytest.raises(InputError) as caught:
            validate(data, tmp_path)
        assert str(caught.value) == f"corruption.effects.0.{told}"


def test_a_sinusoid_has_its_amplitude_and_its_period(observed):
    change = drifted(observed, kind="sinusoid", amplitude=0.03, phase="2 deg", period="40 s")[:, 0]
    angle = 2 * np.pi * np.arange(TIMES) * SECONDS / 40
    waves = np.stack([np.sin(angle), np.cos(angle)])
    for part, amplitude in ((change.real, 0.03), (change.imag, np.deg2rad(2))):
        rows = np.moveaxis(part, 1, -1).reshape(-1, TIMES)
        fitted, misfit, *_ = np.linalg.lstsq(waves.T, rows.T, rcond=None)
        # Times are Julian dates, which are good to 4e-5 s.
        assert np.sqrt(misfit) == pytest.approx(0, abs=1e-4 * amplitude)
        assert np.hypot(*fitted) == pytest.approx(amplitude, rel=1e-4)
        starts = np.exp(1j * np.arctan2(*fitted))
        assert abs(starts.mean()) < 4 / np.sqrt(len(starts))


def test_jumps_come_at_their_rate_with_their_size(observed):
    change = drifted(observed, kind="jumps", amplitude=0.05, phase="0.1 rad", interval="100 s", channels="independent")
    steps = np.diff(change, axis=2)
    moved = abs(steps) > 1e-12
    # The chance of at least one jump in an integration is 1 - exp(-5/100).
    expected = -np.expm1(-SECONDS / 100)
    assert moved.mean() == pytest.approx(expected, abs=5 * np.sqrt(expected / moved.size))
    # The mean number of jumps where there is one is (5 / 100) / expected, and variances add up.
    crowd = SECONDS / 100 / expected
    assert np.var(steps.real[moved]) == pytest.approx(0.05**2 * crowd, rel=0.1)
    assert np.var(steps.imag[moved]) == pytest.approx(0.1**2 * crowd, rel=0.1)
    assert change[:, :, 0] == pytest.approx(0, abs=1e-15)


def test_a_drift_follows_both_seeds_and_every_effect_on_gains_can_have_one(observed):
    first = drifted(observed, kind="random-walk", seed=1)
    assert np.array_equal(first, drifted(observed, kind="random-walk", seed=1))
    assert not np.allclose(first, drifted(observed, kind="random-walk", seed=2))
    other = drifted(observed, "reflection-gains", kind="random-walk", seed=1)
    # The same seeds, and another effect: the logarithm of the gains divided by themselves.
    assert other == pytest.approx(first, abs=1e-12)


def test_only_named_antennas_drift_and_as_they_would_with_all_others(observed):
    every = drifted(observed, kind="random-walk")
    some = drifted(observed, kind="random-walk", antennas=[3, 7])
    others = np.delete(some, [3, 7], axis=0)
    assert others == pytest.approx(0, abs=1e-15)
    assert some[[3, 7]] == pytest.approx(every[[3, 7]], abs=1e-12)
    assert np.abs(some[[3, 7], :, 1:]).min() > 0


def test_a_reflection_swings_in_delay_and_size_in_the_named_cables(observed):
    block = {"kind": "reflection-gains", "amplitude": 0.05, "delay": "300 ns", "delay_scatter": "20 ns", "seed": 4}
    swing = {"delay": "2 ns", "amplitude": 0.2, "period": "100 s", "antennas": [2]}
    constant = draw_truth(Effect.registry.make(block), observed)["gains"]
    moving = draw_truth(Effect.registry.make({**block, "swing": swing}), observed)["gains"]
    assert constant.shape[2] == 1
    expected = np.broadcast_to(np.delete(constant, 2, axis=0), np.delete(moving, 2, axis=0).shape)
    np.testing.assert_allclose(np.delete(moving, 2, axis=0), expected, rtol=1e-13)
    # 1/g - 1 is r exp(-i (2 pi nu tau + phi)): its modulus is r, and its phase over frequency has the slope -2 pi tau.
    waves, still = 1 / moving[2, :, :, 0] - 1, 1 / constant[2, :, 0, 0] - 1
    slope = 2 * np.pi * np.ptp(observed.frequencies)
    turned = np.angle(waves[1:] / waves[:-1]).sum(axis=0) - np.angle(still[1:] / still[:-1]).sum()
    # Julian dates are good to 40 microseconds.
    seconds = 86400 * (observed.times - observed.times[0])
    change = np.abs(waves).mean(axis=0) / np.abs(still).mean() - 1
    basis = np.column_stack([np.sin(2 * np.pi * seconds / 100), np.cos(2 * np.pi * seconds / 100)])
    for values, size in ((change, 0.2), (-turned / slope, 2e-9)):
        found = np.linalg.lstsq(basis, values, rcond=None)[0]
        np.testing.assert_allclose(basis @ found, values, atol=1e-9 * size + 1e-9 * np.abs(values).max())
        assert np.hypot(*found) == pytest.approx(size, rel=1e-6)
    # Both go together.
    np.testing.assert_allclose(-turned / slope / 2e-9, change / 0.2, atol=1e-6)


def test_named_antennas_alone_reflect_and_as_without_names(observed):
    block = {"kind": "reflection-gains", "amplitude": 0.05, "delay": "300 ns", "delay_scatter": "20 ns", "seed": 4}
    every = draw_truth(Effect.registry.make(block), observed)["gains"]
    some = draw_truth(Effect.registry.make({**block, "antennas": [2, 5]}), observed)["gains"]
    assert np.array_equal(some[[2, 5]], every[[2, 5]])
    assert np.all(np.delete(some, [2, 5], axis=0) == 1)


@pytest.mark.parametrize(
    ("block", "field"),
    [
        ({"kind": "bandpass", "drift": {"kind": "jumps", "antennas": [99]}}, "drift.antennas"),
        ({"kind": "coarse-channels", "drift": {"kind": "jumps", "antennas": [99]}}, "drift.antennas"),
        ({"kind": "reflection-gains", "swing": {"delay": "1 ns", "antennas": [99]}}, "swing.antennas"),
        ({"kind": "reflection-gains", "antennas": [99]}, "antennas"),
    ],
)
def test_changes_of_antennas_that_do_not_exist_are_refused(block, field):
    size = size_of_instrument(small_instrument(channels={"count": 64, "width": "40 kHz"}))
    with pytest.raises(InputError, match=rf"^corruption.effects.0.{field}: names antenna 99"):
        require_usable([Effect.registry.make(block)], size)


def test_a_swing_of_an_antenna_without_a_reflection_is_refused():
    block = {"kind": "reflection-gains", "antennas": [1, 2], "swing": {"delay": "1 ns", "antennas": [2, 3]}}
    size = size_of_instrument(small_instrument(channels={"count": 64, "width": "40 kHz"}))
    with pytest.raises(InputError, match=r"^corruption.effects.0.swing.antennas: names antenna 3, which has no refl"):
        require_usable([Effect.registry.make(block)], size)


def test_two_drifts_with_the_same_seeds_are_refused():
    drifting = {"kind": "file-gains", "path": "x.calh5", "drift": "jumps"}
    with pytest.raises(ValidationError, match="as that of item 0: what they draw would not be independent"):
        CorruptionSettings.model_validate({"effects": [drifting, drifting]})
    channel = {"kind": "per-channel-gains", "drift": "sinusoid"}
    assert CorruptionSettings.model_validate({"effects": [channel, {"kind": "bandpass", "drift": "sinusoid"}]})


def test_visibilities_are_multiplied_by_the_gains_of_their_integration(template, rng):
    observed = Observation(template)
    effect = PerChannelGains(drift={"kind": "random-walk", "amplitude": 0.5, "phase": "1 rad", "time": "2 s"})
    truth = draw_truth(effect, observed)
    cube = rng.normal(size=observed.shape) + 1j * rng.normal(size=observed.shape)
    a, b = antenna_indices(template).T
    expected = np.einsum("bftp,bftp,tbfp->tbfp", truth["gains"][a], truth["gains"][b].conj(), cube)
    assert abs(np.diff(truth["gains"], axis=2)).min() > 0
    assert apply_effect(effect, cube.copy(), observed, truth) == pytest.approx(expected, rel=1e-13)


def test_a_file_may_hold_gains_for_every_integration(template, rng, tmp_path):
    shape = (template.Nants_telescope, template.Nfreqs, template.Ntimes, template.Npols)
    gains = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    make_uvcal(template, gains).write_calh5(tmp_path / "g.calh5")
    assert np.array_equal(draw_truth(FileGains(path=tmp_path / "g.calh5"), Observation(template))["gains"], gains)


@pytest.mark.chain
def test_a_run_with_drifting_gains_is_compared_with_the_gains_of_each_integration(tmp_path):
    """The complete sky model recovers gains that change by a third between two integrations, and the flux scale.

    CALAMITY would not: amplitudes that all channels share are in its foreground models as well.
    """
    drift = {"kind": "random-walk", "amplitude": 0.4, "phase": "0.5 rad", "time": "10 s"}
    effects = [{"kind": "per-channel-gains"}, {"kind": "bandpass", "drift": drift}]
    data = override(override(tiny(tmp_path), "corruption.effects", effects), "calibration.calibrator", "sky-based")
    graph = Graph(validate(data, tmp_path))
    tasks = [agreement.agreement(graph), signal_loss._flux_scale(graph), corruption.gains(graph)]
    products = [make([task], tmp_path)[task.key].path for task in tasks]
    true = read_gains(products[2])
    assert len(true.values) == 2
    assert np.median(abs(true.values[1] / true.values[0] - 1)) > 0.3
    found = read_json(products[0] / AGREEMENT)["measurements"]
    # EoR and noise are 1e-4 and 2e-4 of the data.
    assert found["gains_aligned"]["value"] < 1e-3
    assert read_json(products[1] / signal_loss.SCALE)["flux_scale"] == pytest.approx(1, abs=1e-3)


@pytest.mark.chain
@pytest.mark.parametrize("longest", [None, "30 s"])
def test_the_flux_scale_is_that_of_the_blocks_of_the_spectra(tmp_path, longest):
    """Gains that turn between blocks, and are not calibrated, cancel in an average of all, and not in their powers."""
    drift = {"kind": "random-walk", "amplitude": 0.4, "phase": "0.5 rad", "time": "10 s"}
    data = override(tiny(tmp_path), "corruption.effects", [{"kind": "per-channel-gains", "drift": drift}])
    data = override(data, "calibration", {"calibrator": "none"})
    # The third of five integrations is in the middle of the run, at the edge of two blocks.
    data = override(override(data, "instrument.times.count", 5), "instrument.times.integration", "10 s")
    experiment = validate(override(data, "power.coherent_time", longest), tmp_path)
    graph = Graph(experiment)
    residual = experiment.variants["residual"]
    average = spectra.average(graph, residual, "even")
    tasks = [signal_loss._flux_scale(graph), corruption.gains(graph), calibration.calibration(graph, residual, "even")]
    products = [make([task], tmp_path)[task.key].path for task in tasks]
    gains = read_gains(products[1]).values
    blocks = average.blocks_of(read_visibilities(products[2] / RESIDUAL))
    assert sorted(block.times.size for block in blocks) == ([5] if longest is None else [2, 3])
    first, second = np.triu_indices(gains.shape[1], 1)
    ratios = gains[:, first] * gains[:, second].conj()
    taper = make_taper(experiment.power.taper, gains.shape[2]) ** 2
    of_blocks = np.abs([ratios[block.times].mean(axis=0) for block in blocks]) ** 2
    expected = (of_blocks @ taper).mean() / taper.sum()
    assert read_json(products[0] / signal_loss.SCALE)["flux_scale"] == pytest.approx(expected**-0.5, rel=1e-6)
