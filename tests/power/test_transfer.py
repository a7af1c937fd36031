"""Transfer functions: known losses are found, nothing else counts as loss, and the errors are those of the scatter."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calstudy.power.delay import delay_transform, delays, make_taper
from calstudy.power.spectra import DelaySpectra, SphericalSpectrum
from calstudy.power.tables import load_spectrum, save_spectrum, write_csv
from calstudy.power.transfer import (
    Injection,
    TransferFunction,
    TransferMap,
    correct,
    cylindrical_transfer,
    flux_scale,
    gain_ratio,
    pool,
    signal_response,
    spherical_transfer,
    where_measured,
)

BASELINES, CHANNELS, WIDTH = 40, 64, 400e3
FREQUENCY = 170e6 + WIDTH * np.arange(CHANNELS)
LENGTHS = np.linspace(10.0, 60.0, BASELINES)
BUFFER = 100e-9
ONE_BIN = (0.0, 10.0)


def cross(first: np.ndarray, second: np.ndarray, taper: str = "none") -> DelaySpectra:
    """Delay spectra of (Nbls, Nfreqs) visibilities; k is the delay in us."""
    even, odd = (delay_transform(part, FREQUENCY, taper) for part in (first, second))
    delay = delays(CHANNELS, WIDTH)
    return DelaySpectra(
        power=even.conj() * odd,
        vectors=np.stack([LENGTHS, 0 * LENGTHS, 0 * LENGTHS], axis=1),
        n_pairs=np.ones(BASELINES, dtype=int),
        n_polarizations=1,
        delay=delay,
        k_perp=1e-4 * LENGTHS,
        k_parallel=1e6 * delay,
        frequency=182e6,
        omega_pp=0.1,
        taper=taper,
    )


def inject(signal: np.ndarray, even: np.ndarray, odd: np.ndarray, taper: str = "none") -> Injection:
    return Injection(
        signal=cross(signal, signal, taper), response=cross(even, odd, taper), cross=cross(signal, odd, taper)
    )


def noise(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=(BASELINES, CHANNELS)) + 1j * rng.normal(size=(BASELINES, CHANNELS))


def low_delays_removed(spectra: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Project out of each baseline all delays up to its edge (Nbls,)."""
    transformed = np.fft.fft(spectra, axis=1)
    transformed[np.abs(np.fft.fftfreq(CHANNELS, WIDTH)) <= edge[:, None]] = 0
    return np.fft.ifft(transformed, axis=1)


@given(st.floats(0.01, 3.0))
def test_a_signal_scaled_by_a_factor_has_the_squared_factor_as_transfer_and_itself_as_cross_transfer(factor):
    signal = noise(np.random.default_rng(1))
    found = spherical_transfer(inject(signal, factor * signal, factor * signal), ONE_BIN, BUFFER, inside=False)
    assert found.transfer == pytest.approx([factor**2])
    assert found.cross_transfer == pytest.approx([factor])
    assert found.transfer_error == pytest.approx([0], abs=1e-9)
    assert found.squared_coherence == pytest.approx([1])
    assert found.squared_coherence_error == pytest.approx([0], abs=1e-6)


def test_no_loss_is_one_in_every_bin_and_cell(rng):
    signal = noise(rng)
    injection = inject(signal, signal, signal, "blackman-harris")
    outside = spherical_transfer(injection, np.arange(0, 1.4, 0.1), BUFFER, inside=False)
    filled = outside.n_samples > 0
    assert filled.sum() > 5
    assert outside.transfer[filled] == pytest.approx(np.ones(filled.sum()))
    assert np.isnan(outside.transfer[~filled]).all()
    assert cylindrical_transfer(injection, 4.0).transfer == pytest.approx(1.0)


def test_a_projection_loses_what_it_projects_out_and_nothing_else(rng):
    signal = noise(rng)
    left = low_delays_removed(signal, LENGTHS / 299792458.0 + BUFFER)
    injection = inject(signal, left, left)
    outside, inside = (spherical_transfer(injection, ONE_BIN, BUFFER, inside) for inside in (False, True))
    assert outside.transfer == pytest.approx([1.0])
    assert inside.transfer == pytest.approx([0.0], abs=1e-20)
    found = cylindrical_transfer(injection, 1e-6)
    lost = found.delay <= found.horizon_delay[:, None] + BUFFER
    assert found.transfer == pytest.approx(np.where(lost, 0.0, 1.0), abs=1e-12)


def random_projection(rng: np.random.Generator, lost: int) -> np.ndarray:
    """Projection of all baselines of a channel, which loses `lost` of their dimensions."""
    basis, _ = np.linalg.qr(rng.normal(size=(BASELINES, lost)) + 1j * rng.normal(size=(BASELINES, lost)))
    return np.eye(BASELINES) - basis @ basis.conj().T


def test_gains_that_absorb_some_of_all_baselines_lose_their_share_at_all_delays(rng):
    lost, scale = 10, 1.07
    projections = [random_projection(rng, lost) for _ in range(CHANNELS)]
    found = []
    for _ in range(8):
        signal = noise(rng)
        left = np.stack([matrix @ column for matrix, column in zip(projections, signal.T, strict=True)], axis=1)
        found.append(spherical_transfer(inject(signal, scale * left, scale * left), ONE_BIN, BUFFER, inside=False))
    pooled = pool(found)
    for value, error in (
        (pooled.transfer / scale**2, pooled.transfer_error),
        (pooled.cross_transfer / scale, pooled.cross_transfer_error),
        (pooled.squared_coherence, pooled.squared_coherence_error),
    ):
        assert value[0] == pytest.approx(1 - lost / BASELINES, abs=4 * error[0])
        assert error[0] < 0.02


def test_the_flux_scale_is_what_gains_multiply_a_white_signal_by(rng):
    """Gains of the wrong scale, with errors of 10 %: T free of the scale is what is left without them."""
    signal = noise(rng)
    ratio = (1 + 0.1 * noise(rng) / np.sqrt(2)) / 1.07
    scale = flux_scale(ratio, ratio, make_taper("blackman-harris", CHANNELS) ** 2)
    found = spherical_transfer(
        inject(signal, 0.9 * ratio * signal, 0.9 * ratio * signal, "blackman-harris"),
        ONE_BIN, BUFFER, inside=False, flux_scale=scale,
    )  # fmt: skip
    assert scale == pytest.approx(1.07 / np.sqrt(1.01), rel=0.005)
    assert found.flux_scale == scale
    assert found.scale_free_transfer[0] == pytest.approx(0.81, abs=4 * found.scale_free_transfer_error[0])
    assert found.scale_free_transfer_error[0] < 0.01
    assert found.transfer[0] * scale**2 == pytest.approx(found.scale_free_transfer[0])


def test_the_flux_scale_is_that_of_the_gains_whatever_their_noise_phases_and_gaps(rng):
    antennas, times = 12, 5
    true = 1 + 0.1 * (rng.normal(size=(antennas, CHANNELS)) + 1j * rng.normal(size=(antennas, CHANNELS)))
    # They drift by their own size and by radians during the run.
    true = true * np.exp(np.cumsum(rng.normal(size=(times, antennas, 2)) @ [[1], [1j]], axis=0) / 2)
    ratios = []
    for _ in range(2):
        fitted = true * np.sqrt(1.05)
        fitted *= np.exp(2j * np.pi * rng.random((times, 1, CHANNELS)))
        fitted *= 1 + 0.02 * (rng.normal(size=fitted.shape) + 1j * rng.normal(size=fitted.shape))
        fitted[2, 3], fitted[:, 5, :7], fitted[0, 0, 1] = np.nan, np.nan, 0
        ratios.append(gain_ratio(true, fitted))
    assert np.isnan(ratios[0][:, :7]).any(axis=0).all()
    assert np.isfinite(ratios[0][:, 7:]).all()
    # Noise of 2 % in single gains, even and odd apart, averages down to far below 1e-3.
    assert flux_scale(*ratios, np.ones(CHANNELS)) == pytest.approx(1.05, abs=1e-3)
    assert np.isnan(flux_scale(np.nan * ratios[0], ratios[1], np.ones(CHANNELS)))


def test_noise_that_both_residuals_share_cancels(template, rng, white):
    """The difference of powers scatters by the noise; the power of the difference does not see it."""
    from calstudy.base.visibilities import from_cube, to_cube

    signal, common = (to_cube(white(template, rng, sigma)) for sigma in (1.0, 30.0))
    without = from_cube(template, common)
    with_signal = from_cube(template, common + 0.5 * signal)
    response = to_cube(signal_response(with_signal, without))
    assert response == pytest.approx(0.5 * signal, abs=1e-12)
    powers = [np.mean(np.abs(part) ** 2) for part in (common + 0.5 * signal, common, signal, response)]
    assert powers[3] / powers[2] == pytest.approx(0.25)
    assert abs((powers[0] - powers[1]) / powers[2] - 0.25) > 0.1


def test_a_sample_that_is_flagged_in_either_residual_is_flagged_in_the_response(template, rng, white):
    with_signal, without = white(template, rng), white(template, rng)
    with_signal.flag_array[1, 2] = without.flag_array[3, 4] = True
    assert np.argwhere(signal_response(with_signal, without).flag_array[..., 0]).tolist() == [[1, 2], [3, 4]]
    assert with_signal.flag_array[3, 4].sum() == without.flag_array[1, 2].sum() == 0


def test_noise_that_is_left_in_the_response_scatters_but_gives_no_bias():
    pulls = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        signal = noise(rng)
        even, odd = (0.8 * signal + 0.7 * noise(rng) for _ in range(2))
        found = spherical_transfer(inject(signal, even, odd, "blackman-harris"), (0.5, 0.9), BUFFER, inside=False)
        pulls.append(
            [
                (found.transfer[0] - 0.64) / found.transfer_error[0],
                (found.cross_transfer[0] - 0.8) / found.cross_transfer_error[0],
                (found.squared_coherence[0] - 1) / found.squared_coherence_error[0],
            ]
        )
    assert np.mean(pulls, axis=0) == pytest.approx([0, 0, 0], abs=4 / np.sqrt(200))
    assert np.std(pulls, axis=0) == pytest.approx([1, 1, 1], abs=0.2)


def test_one_sample_has_no_error(rng):
    signal = noise(rng)
    shortest = LENGTHS[0] / 299792458.0
    found = spherical_transfer(inject(signal, signal, signal), (0.0, 1e6 * shortest), 0.0, inside=True)
    single = cylindrical_transfer(inject(signal, signal, signal), 1e-6)
    assert found.n_samples[0] == BASELINES
    assert np.isnan(single.transfer_error[:, 0]).all()
    assert np.isfinite(single.transfer_error[:, 1:-1]).all()


def test_a_transfer_function_that_is_not_measured_is_not_given(rng):
    """Two bins of the same modes: the response to one of them is the signal, to the other it is noise 30 times that."""
    signal, other = noise(rng), 30 * noise(rng)
    far = np.abs(delays(CHANNELS, WIDTH)) > 0.6e-6
    spectra = np.fft.ifftshift(np.fft.fft(other, axis=1) * far, axes=1)
    response = [signal + np.fft.ifft(np.fft.ifftshift(spectra, axes=1), axis=1) for _ in range(2)]
    measured = spherical_transfer(inject(signal, *response), (0.3, 0.5, 0.7, 1.0), 0.0, inside=False)
    kept = where_measured(measured)
    good = (measured.transfer_error <= 0.3) & (measured.transfer >= -0.1) & (measured.transfer <= 1.2)
    assert good.any()
    assert not good.all()
    for name in ("transfer", "cross_transfer", "cross_transfer_error", "squared_coherence"):
        np.testing.assert_array_equal(getattr(kept, name)[good], getattr(measured, name)[good])
        assert np.isnan(getattr(kept, name)[~good]).all()
    np.testing.assert_array_equal(kept.signal, measured.signal)


def test_pooling_is_as_if_all_modes_were_of_one_injection(rng):
    signals = [noise(rng) for _ in range(3)]
    injections = [
        inject(part, part * factor, part * factor) for part, factor in zip(signals, (0.9, 0.8, 0.7), strict=True)
    ]
    found = [spherical_transfer(item, ONE_BIN, BUFFER, inside=False) for item in injections]
    response, signal = (sum(part.transfer * part.signal for part in found), sum(part.signal for part in found))
    pooled = pool(found)
    assert pooled.transfer == pytest.approx(response / signal)
    assert pooled.n_samples == pytest.approx(3 * found[0].n_samples)
    with pytest.raises(ValueError, match="different bins"):
        pool([found[0], spherical_transfer(injections[0], (0.0, 5.0), BUFFER, inside=False)])


def test_errors_of_pooled_injections_fall_by_the_square_root_of_their_number(rng):
    signal = noise(rng)
    injection = inject(signal, *(0.8 * signal + 0.7 * noise(rng) for _ in range(2)))
    one = spherical_transfer(injection, ONE_BIN, BUFFER, inside=False, flux_scale=1.1)
    four = pool(4 * [one])
    for name in ("transfer", "cross_transfer", "scale_free_transfer", "squared_coherence"):
        assert getattr(four, name) == pytest.approx(getattr(one, name))
        assert getattr(four, f"{name}_error") == pytest.approx(getattr(one, f"{name}_error") / 2)
    # An injection of three times the signal has three times the weight: (3^2 + 1) / 4^2.
    loud = dataclasses.replace(one, signal=3 * one.signal)
    assert pool([loud, one]).transfer_error == pytest.approx(np.sqrt(10) / 4 * one.transfer_error)


def test_what_is_not_known_of_one_injection_is_that_of_the_others(rng):
    signals = [noise(rng) for _ in range(3)]
    injections = [inject(part, 0.8 * part, 0.8 * part) for part in signals]
    found = [spherical_transfer(item, ONE_BIN, BUFFER, inside=False, flux_scale=1.1) for item in injections]
    unknown = dataclasses.replace(found[0], scale_free_transfer=np.full(1, np.nan), flux_scale=np.nan)
    kept, others = pool([unknown, *found[1:]]), pool(found[1:])
    assert np.isfinite(others.scale_free_transfer).all()
    assert kept.scale_free_transfer == pytest.approx(others.scale_free_transfer)
    assert kept.scale_free_transfer_error == pytest.approx(others.scale_free_transfer_error)
    assert (kept.transfer, kept.flux_scale) == (pytest.approx(pool(found).transfer), others.flux_scale)
    # An error that is not known is no error of zero.
    assert np.isnan(pool([dataclasses.replace(found[0], transfer_error=np.full(1, np.nan)), *found[1:]]).transfer_error)


def spectrum(power: list[float], error: float, edges: np.ndarray) -> SphericalSpectrum:
    ones = np.ones(len(power))
    return SphericalSpectrum(
        (edges[1:] + edges[:-1]) / 2, edges, np.array(power, dtype=complex), *(4 * [ones]), error * ones, 0 * ones,
        wedge_excluded=True,
    )  # fmt: skip


def test_corrected_power_is_unbiased_with_both_errors_and_unknown_where_all_is_lost():
    edges = np.array([0.0, 1.0, 2.0, 3.0])
    ones = np.ones(3)
    kept = np.array([0.5, 1.0, 0.01])
    transfer = TransferFunction(
        (edges[1:] + edges[:-1]) / 2, edges, kept, 0.01 * ones, kept, 0.01 * ones, *(6 * [ones]), 1.0
    )
    # Errors of what is left grow with the correction; those of all that was put in are right for all that is restored.
    for reduced, own in ((True, 6.0), (False, 3.0)):
        power, error = correct(spectrum([50.0, 100.0, 1.0], 3.0, edges), transfer, reduced)
        assert power[:2] == pytest.approx([100.0, 100.0])
        assert error[:2] == pytest.approx([np.hypot(own, 2.0), np.hypot(3.0, 1.0)])
        assert np.isnan([power[2], error[2]]).all()


def low_delays_fitted(spectra: np.ndarray, weights: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Subtract the fit of each baseline's delays up to its edge (Nbls,), with weights (Nbls, Nfreqs)."""
    left = spectra.copy()
    modes = np.fft.ifft(np.eye(CHANNELS), axis=0)
    for row, (one, weight, limit) in enumerate(zip(spectra, weights, edge, strict=True)):
        basis = modes[:, np.abs(np.fft.fftfreq(CHANNELS, WIDTH)) <= limit]
        weighted = weight[:, None] * basis
        left[row] -= basis @ np.linalg.solve(basis.conj().T @ weighted, weighted.conj().T @ one)
    return left


def test_power_that_leaked_from_other_delays_is_not_taken_for_the_eor(rng):
    """Foregrounds are fitted with weights that gains of 20 % make uneven: EoR beyond the wedge leaks into it.

    T is 0.12 there and known to 8 %, but it is that of a flat power spectrum. One that falls as the square of the delay
    has less to leak and more to be measured: P^R / T is sixty times too low.
    """
    edge = LENGTHS / 299792458.0 + BUFFER
    weights = np.abs(1 + 0.2 * noise(rng)) ** 2
    falling = 1 / np.maximum(np.abs(np.fft.fftfreq(CHANNELS, WIDTH)), 1 / WIDTH / CHANNELS)
    transfers = {}
    for name, shape in {"flat": np.ones(CHANNELS), "steep": falling}.items():
        signal = np.fft.ifft(np.fft.fft(noise(rng), axis=1) * shape, axis=1)
        left = low_delays_fitted(signal, weights, edge)
        for inside in (True, False):
            transfers[name, inside] = spherical_transfer(inject(signal, left, left), ONE_BIN, BUFFER, inside)
    found = transfers["flat", True]
    assert found.transfer > 5 * found.transfer_error
    assert np.abs(found.cross_transfer) < 4 * found.cross_transfer_error
    assert transfers["steep", True].transfer / found.transfer < 0.05
    for inside, expected in ((True, np.nan), (False, 100.0)):
        residual = 100.0 * transfers["steep", inside].transfer
        power, error = correct(spectrum(residual, 1.0, np.array(ONE_BIN)), transfers["flat", inside], reduced=True)
        # The fit changes no delay beyond the wedge.
        assert power == pytest.approx([expected], nan_ok=True)
        assert np.isfinite(error) == np.isfinite(expected)


def test_a_leak_is_not_taken_for_the_eor_however_well_it_is_known():
    """Of many pooled injections a C of a tenth of T is significant; the leak is nine tenths of T all the same."""
    edges, ones = np.array([0.0, 1.0, 2.0]), np.ones(2)
    transfer = TransferFunction(
        (edges[1:] + edges[:-1]) / 2, edges, 0.1 * ones, 1e-4 * ones, np.array([0.01, 0.09]), 1e-4 * ones,
        *(6 * [ones]), 1.0,
    )  # fmt: skip
    power, error = correct(spectrum([10.0, 10.0], 1.0, edges), transfer, reduced=True)
    assert power == pytest.approx([np.nan, 100.0], nan_ok=True)
    assert np.isfinite(error).tolist() == [False, True]


def test_tables_read_back(tmp_path, rng):
    signal = noise(rng)
    injection = inject(signal, 0.5 * signal, 0.5 * signal)
    found = spherical_transfer(injection, (0.0, 0.5, 1.0), BUFFER, inside=False)
    for value, kind in ((found, TransferFunction), (cylindrical_transfer(injection, 4.0), TransferMap)):
        save_spectrum(tmp_path / "t.h5", value)
        back = load_spectrum(tmp_path / "t.h5", kind)
        assert np.array_equal(back.transfer, value.transfer, equal_nan=True)
    write_csv(tmp_path / "t.csv", found)
    rows = (tmp_path / "t.csv").read_text().splitlines()
    assert rows[0].startswith("k [h/Mpc],k from [h/Mpc],k to [h/Mpc],transfer,transfer error")
    assert len(rows) == 3
    assert float(rows[1].split(",")[3]) == pytest.approx(0.25)
