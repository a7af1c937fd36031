from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calstudy.calibrate.degeneracy import align
from calstudy.figures.gains import compare_gains, draw_gains, draw_reflections
from calstudy.figures.runtime import draw_runtime, summarize_runtime
from calstudy.figures.visibilities import draw_baselines, draw_comparison
from calstudy.plotting.axes import in_two_domains
from calstudy.power.delay import horizon_delay

C = 299792458.0
FREQUENCY = 167.075e6 + 80e3 * np.arange(384)


def complex_normal(rng, *shape):
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def xy(line):
    return line.get_xdata(), line.get_ydata()


@given(index=st.integers(-180, 180), phase=st.floats(0, 6.28), level=st.floats(1e-3, 1e3))
@settings(max_examples=25, deadline=None)
def test_a_pure_delay_has_its_own_amplitude_at_its_delay(index, phase, level):
    delay = index / (384 * 80e3)
    spectrum = in_two_domains(FREQUENCY, level * np.exp(-2j * np.pi * FREQUENCY * delay + 1j * phase))
    amplitude = np.abs(spectrum.transform)
    peak = amplitude.argmax()
    assert spectrum.delay[peak] == pytest.approx(delay, abs=1e-12)
    assert amplitude[peak] == pytest.approx(level, rel=1e-6)
    far = np.abs(spectrum.delay - delay) > 200e-9
    far &= np.abs(np.abs(spectrum.delay - delay) - 12.5e-6) > 200e-9
    # Sidelobes of the Blackman-Harris taper are at -92 dB.
    assert amplitude[far].max() < 10 ** (-92 / 20) * 1.1 * level


def test_horizon_is_the_light_travel_time():
    np.testing.assert_allclose(horizon_delay(np.array([0.0, 14.0, C])), [0, 14.0 / C, 1.0])


def test_correction_is_blind_to_what_calibration_cannot_know():
    """A phase per channel common to both antennas leaves every calibrated visibility alone."""
    rng = np.random.default_rng(31)
    true = 1 + 0.1 * complex_normal(rng, 2, 384)
    recovered = true * np.exp(1j * rng.uniform(0, 6.28, 384))
    aligned, _ = align(recovered, true)
    comparison = compare_gains((0, 1), FREQUENCY, true, recovered, aligned)
    assert np.abs(comparison.residual.values).max() > 0.5
    np.testing.assert_allclose(comparison.aligned_residual.values, 0, atol=1e-12)
    np.testing.assert_allclose(comparison.correction.values, 0, atol=1e-12)
    np.testing.assert_allclose(comparison.correction.transform, 0, atol=1e-12)


def test_smooth_gain_errors_stay_at_low_delay_though_gains_do_not():
    rng = np.random.default_rng(32)
    true = 1 + 0.1 * complex_normal(rng, 2, 384)
    smooth = 1 + 0.1 * np.cos(2 * np.pi * FREQUENCY * 60e-9)
    comparison = compare_gains((0, 1), FREQUENCY, true, true * smooth, true * smooth)
    high = np.abs(comparison.true.delay) > 500e-9
    assert np.abs(comparison.correction.transform[high]).max() < 1e-4
    assert np.median(np.abs(comparison.residual.transform[:, high])) > 1e-4
    assert np.median(np.abs(comparison.true.transform[:, high])) > 5e-3


def test_gains_are_drawn_as_the_caption_says():
    rng = np.random.default_rng(33)
    true, recovered, aligned = 1 + 0.1 * complex_normal(rng, 3, 2, 384)
    figure = draw_gains(compare_gains((0, 1), FREQUENCY, true, recovered, aligned))
    *gains, as_fitted, free, delays = sorted(figure.axes, key=lambda axes: axes.get_xlabel() == "delay (ns)")
    for index, axes in enumerate(gains):
        solid, dashed = axes.get_lines()
        assert (solid.get_linestyle(), dashed.get_linestyle()) == ("-", "--")
        np.testing.assert_allclose(xy(solid), (FREQUENCY / 1e6, true[index].real))
        np.testing.assert_allclose(xy(dashed), (FREQUENCY / 1e6, recovered[index].real))
        residual, thin = (panel.get_lines()[index] for panel in (as_fitted, free))
        assert (residual.get_linestyle(), thin.get_linestyle()) == (":", "-")
        np.testing.assert_allclose(residual.get_ydata(), (true - recovered)[index].real)
        np.testing.assert_allclose(thin.get_ydata(), (true - aligned)[index].real)
    assert [panel.get_ylabel().split("\n")[1] for panel in (as_fitted, free)] == ["as fitted", "aligned"]
    ratio = true[0] * true[1].conj() / (recovered[0] * recovered[1].conj()) - 1
    np.testing.assert_allclose(as_fitted.get_lines()[2].get_ydata(), ratio.real)
    assert as_fitted.get_lines()[2].get_color() == "#000000"
    expected = in_two_domains(FREQUENCY, ratio)
    np.testing.assert_allclose(xy(delays.get_lines()[-1]), (expected.delay * 1e9, np.abs(expected.transform)))


def test_visibilities_residual_noise_and_horizon_are_drawn(visibility_comparison):
    figure = draw_comparison(visibility_comparison, ("data", "model"))
    values, residuals, delays = sorted(figure.axes, key=lambda axes: axes.get_xlabel() == "delay (ns)")
    noise, residual = residuals.get_lines()
    assert [line.get_linestyle() for line in values.get_lines()] == ["-", "--"]
    assert (noise.get_linestyle(), residual.get_linestyle()) == ("-.", ":")
    solid, dashed = values.get_lines()
    np.testing.assert_allclose(residual.get_ydata(), solid.get_ydata() - dashed.get_ydata(), atol=1e-12)
    # Here the model is exact, so that what is left is the noise, at all delays.
    np.testing.assert_allclose(residual.get_ydata(), noise.get_ydata(), atol=1e-12)
    *_, noise_delay, residual_delay, left, right = delays.get_lines()
    np.testing.assert_allclose(residual_delay.get_ydata(), noise_delay.get_ydata(), atol=1e-12)
    assert left.get_xdata()[0] == pytest.approx(-54.9 / C * 1e9)
    assert right.get_xdata()[0] == pytest.approx(54.9 / C * 1e9)


def test_baselines_show_their_spectra_and_wedge_edges(baseline_spectra):
    figure = draw_baselines(baseline_spectra)
    looks = {"model": ("#CC79A7", "-"), "noise": ("#E69F00", ":"), "residual": ("#56B4E9", "--")}
    for axes, spectra in zip(figure.axes, baseline_spectra, strict=True):
        *lines, left, right = axes.get_lines()
        assert len(lines) == 4
        for line, name in zip(lines[1:], looks, strict=True):
            assert (line.get_color(), line.get_linestyle()) == looks[name]
            np.testing.assert_allclose(xy(line), (spectra.delay * 1e9, getattr(spectra, name)))
        edges = [line.get_xdata()[0] for line in (left, right)]
        np.testing.assert_allclose(edges, np.array([-1, 1]) * spectra.baseline_length / C * 1e9)
        assert f"{spectra.baseline_length:.1f}" in axes.texts[0].get_text()


def test_every_column_of_baselines_ends_in_a_delay_axis(baseline_spectra):
    for count in (1, 2, 3, 4):
        axes = [axes for axes in draw_baselines(baseline_spectra[:count]).axes if axes.get_visible()]
        assert len(axes) == count
        assert sum(item.get_xlabel() == "delay (ns)" for item in axes) == min(count, 2)


def test_reflections_peak_at_their_delay_and_again_at_twice_it():
    delay, level = 36 / (384 * 80e3), 0.01
    gains = 1 / (1 + level * np.exp(-2j * np.pi * FREQUENCY * delay) * np.ones((3, 1)))
    axes = draw_reflections(in_two_domains(FREQUENCY, gains)).axes[0]
    each, median = axes.get_lines()[0], axes.get_lines()[-1]
    for line in (each, median):
        nanoseconds, amplitude = xy(line)
        for multiple in (1, 2):
            at = np.argmin(np.abs(nanoseconds - multiple * delay * 1e9))
            assert amplitude[at] == pytest.approx(level**multiple, rel=0.02)
    first, last = axes.get_xlim()
    assert first < 0 < 2 * delay * 1e9 < last


@given(exponent=st.floats(0.2, 3), amplitude=st.floats(1e-6, 1e2))
@settings(max_examples=10, deadline=None)
def test_run_times_give_back_their_power_law(exponent, amplitude):
    size = np.array([8.0, 16, 64, 100])
    rng = np.random.default_rng(34)
    scatter = np.exp(0.2 * rng.permuted(np.tile(np.linspace(-1, 1, 1001), (4, 1)), axis=1))
    series = summarize_runtime("CPU", size, amplitude * size[:, None] ** exponent * scatter)
    assert series.fit.exponent == pytest.approx(exponent)
    assert series.fit.amplitude == pytest.approx(amplitude)
    assert series.fit.error < 1e-9
    np.testing.assert_allclose(series.high / series.median, np.exp(0.2 * 0.95), rtol=1e-3)
    np.testing.assert_allclose(series.median / series.low, np.exp(0.2 * 0.95), rtol=1e-3)


def test_run_time_figure_has_medians_bands_and_fits():
    size = np.array([8.0, 16, 32])
    rng = np.random.default_rng(35)
    series = [summarize_runtime(name, size, size[:, None] ** 2 * np.exp(rng.normal(size=(3, 99)))) for name in "ab"]
    figure = draw_runtime(series, "number of antennas")
    axes = figure.axes[0]
    for index, item in enumerate(series):
        markers, fit = axes.get_lines()[2 * index : 2 * index + 2]
        np.testing.assert_allclose(xy(markers), (size, item.median))
        np.testing.assert_allclose(fit.get_ydata(), item.fit.amplitude * size**item.fit.exponent)
        vertices = axes.collections[index].get_paths()[0].vertices
        for x, low, high in zip(size, item.low, item.high, strict=True):
            at_size = vertices[vertices[:, 0] == x, 1]
            assert (at_size.min(), at_size.max()) == pytest.approx((low, high))
    told = [text.get_text() for text in figure.legends[0].get_texts()]
    assert all(f"{item.fit.exponent:.2f}" in text for item, text in zip(series, told, strict=True))


def test_run_times_that_cannot_be_fitted_are_refused():
    for size, seconds in (([8, 16], [[1.0], [2.0]]), ([8, 16, 32], [[1.0], [2.0], [0.0]]), ([8, 16, 32], [[1.0]] * 2)):
        with pytest.raises(ValueError, match="positive values at three sizes"):
            summarize_runtime("x", size, seconds)
