from __future__ import annotations

import numpy as np
import pytest
from astropy import constants
from astropy import units as u
from hera_pspec import PSpecData, UVPSpec
from hera_pspec.pspecbeam import PSpecBeamFromArray

from calstudy.base.visibilities import antenna_pairs, baseline_vectors, from_cube
from calstudy.instrument.array_layouts.geometric import GolombLayout, HexLayout
from calstudy.instrument.array_layouts.observatories import MwaLayout
from calstudy.power import cosmology as c
from calstudy.power.binned import spherical_average
from calstudy.power.delay import delay_transform, delays, make_taper
from calstudy.power.estimate import DiagonalPSpecData, estimate_power, kelvin_per_jansky, make_pairs
from calstudy.power.interface import estimate_spectra, polarizations_without_data
from calstudy.power.settings import KBins, PowerSettings
from calstudy.power.spectra import delay_spectra

GOLOMB = GolombLayout(kind="golomb", count=5, spacing="14 m")


def two(template, white, seed=1):
    rng = np.random.default_rng(seed)
    return white(template, rng), white(template, rng)


@pytest.mark.filterwarnings("ignore:The Telescope.x_orientation attribute is deprecated:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:Casting complex values to real:numpy.exceptions.ComplexWarning:hera_pspec")
@pytest.mark.parametrize("taper", ["blackman-harris", "hann", "tukey", "none"])
@pytest.mark.parametrize("flagged", [False, True])
@pytest.mark.parametrize("n_channels", [15, 16])
def test_closed_forms_equal_hera_pspec(observe, white, taper, flagged, n_channels):
    even, odd = two(observe(GOLOMB, n_channels), white)
    if flagged:
        even.flag_array[2, 3:5] = True
        even.flag_array[5, 1] = True
        odd.flag_array[2, 7] = True
    baselines = [(int(a), int(b)) for a, b in antenna_pairs(even)]
    results = []
    for kind in (PSpecData, DiagonalPSpecData):
        adapter = PSpecBeamFromArray({-5: np.full(n_channels, 0.14)}, {-5: np.full(n_channels, 0.07)}, even.freq_array)
        estimator = kind(dsets=[even.copy(), odd.copy()], beam=adapter)
        name = {"blackman-harris": "blackmanharris"}.get(taper, taper)
        uvp = estimator.pspec(
            baselines, baselines[::-1], (0, 1), [(-5, -5)], taper=name, allow_fft=True, verbose=False, store_window=True
        )
        key = (0, *baselines[2], "xx"), (1, *baselines[2], "xx")
        results.append((uvp, estimator.get_G(*key), estimator.get_H(*key), estimator.get_H(*key, sampling=True)))
    (ours, *our_matrices), (theirs, *their_matrices) = results[1], results[0]
    for mine, reference in zip(our_matrices, their_matrices, strict=True):
        np.testing.assert_allclose(mine, reference, rtol=0, atol=1e-12 * np.abs(reference).max())
    np.testing.assert_allclose(ours.data_array[0], theirs.data_array[0], rtol=1e-10)
    np.testing.assert_allclose(ours.window_function_array[0], theirs.window_function_array[0], atol=1e-12)


@pytest.mark.filterwarnings("ignore:Casting complex values to real:numpy.exceptions.ComplexWarning:hera_pspec")
def test_an_estimator_that_is_used_again_keeps_nothing_of_another_taper(observe, white):
    """Normalization and spectra of baselines are kept for all pairs of one call."""
    even, odd = two(observe(GOLOMB), white)
    pairs = [(int(a), int(b)) for a, b in antenna_pairs(even)]
    adapter = PSpecBeamFromArray({-5: np.full(32, 0.14)}, {-5: np.full(32, 0.07)}, even.freq_array)

    def estimator():
        return DiagonalPSpecData(dsets=[even.copy(), odd.copy()], beam=adapter)

    def power(found, taper):
        return found.pspec(pairs, pairs, (0, 1), [(-5, -5)], taper=taper, allow_fft=True, verbose=False).data_array[0]

    used = estimator()
    for taper in ("blackmanharris", "none", "blackmanharris"):
        np.testing.assert_allclose(power(used, taper), power(estimator(), taper), rtol=1e-12)


def test_other_weightings_are_refused(observe, white):
    even, odd = two(observe(GOLOMB), white)
    estimator = DiagonalPSpecData(dsets=[even, odd])
    bls = [(0, 1)]
    with pytest.raises(NotImplementedError, match="identity"):
        estimator.pspec(bls, bls, (0, 1), [(-5, -5)], input_data_weight="iC", verbose=False)
    with pytest.raises(NotImplementedError, match="'I'"):
        estimator.pspec(bls, bls, (0, 1), [(-5, -5)], norm="H^-1", verbose=False)
    with pytest.raises(NotImplementedError, match="as many"):
        estimator.pspec(bls, bls, (0, 1), [(-5, -5)], n_dlys=8, verbose=False)


def expected_power(first, second, frequencies, beam, taper):
    """The paper's P = X^2 Y / (Omega_pp B_pp) V~ V~* at the band centre, in mK^2 h^-3 Mpc^3."""
    cosmo, centre, width = c.make_cosmology("Planck15"), frequencies.mean(), frequencies[1] - frequencies[0]
    z = c.redshift(centre)
    omega_pp = beam.solid_angles(np.array([centre]), "xx")[1]
    kelvin = 2 * 1e-26 * (constants.c.value / frequencies) ** 2 / (2 * constants.k_B.value)
    spectra = [delay_transform(v * kelvin, frequencies, taper) for v in (first, second)]
    bandwidth = width * np.sum(make_taper(taper, frequencies.size) ** 2)
    volume = c.transverse_scale(cosmo, z) ** 2 * c.radial_scale(cosmo, z)
    # hera_pspec: the delay axis reversed, the first conjugated.
    product = np.roll((spectra[0].conj() * spectra[1])[..., ::-1], 1 - frequencies.size % 2, axis=-1)
    return 1e6 * cosmo.h**3 * volume / (omega_pp[0] * bandwidth) * product


@pytest.mark.parametrize("taper", ["blackman-harris", "none"])
def test_spectra_are_those_of_the_paper_in_a_narrow_band(observe, white, beam, taper):
    """Within a narrow band nothing evolves: hera_pspec's number is the paper's formula."""
    template = observe(GOLOMB, n_channels=32, width=1e3)
    even, odd = two(template, white)
    uvp = estimate_power(even, odd, beam, PowerSettings(taper=taper))
    expected = expected_power(even.data_array[..., 0], odd.data_array[..., 0], template.freq_array, beam, taper)
    np.testing.assert_allclose(uvp.data_array[0][..., 0], expected, rtol=0, atol=1e-3 * np.abs(expected).max())
    np.testing.assert_allclose(uvp.dly_array, delays(32, 1e3), rtol=1e-9)
    assert (uvp.vis_units, uvp.norm_units) == ("mK", "h^-3 Mpc^3")


def white_sky_visibilities(template, beam, power, n_skies):
    """Visibilities in Jy, (Nbls, Nfreqs, n_skies), of skies of flat P(k) in K^2 Mpc^3: a direct sum over pixels."""
    healpy = pytest.importorskip("healpy")
    cosmo, rng, nside = c.make_cosmology("Planck15"), np.random.default_rng(11), 64
    theta, phi = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside) // 2))
    near = beam.power(theta, template.freq_array[0]) > 1e-6
    theta, directions = theta[near], healpy.ang2vec(theta, phi)[near]
    pixel_area = healpy.nside2pixarea(nside)
    geometry = 2j * np.pi / constants.c.value * baseline_vectors(template) @ directions.T
    cube = np.empty((template.Nbls, template.Nfreqs, n_skies), dtype=complex)
    for channel, frequency in enumerate(template.freq_array):
        z = c.redshift(frequency)
        area = c.transverse_scale(cosmo, z) ** 2 * pixel_area
        depth = c.radial_scale(cosmo, z) * template.channel_width[channel]
        temperature = rng.normal(scale=np.sqrt(power / (area * depth)), size=(theta.size, n_skies))
        brightness = (temperature * u.K).to_value(u.Jy / u.sr, u.brightness_temperature(frequency * u.Hz))
        response = 0.5 * pixel_area * np.exp(geometry * frequency) * beam.power(theta, frequency)
        cube[:, channel] = response @ brightness
    return cube


def test_flat_power_comes_back_within_one_percent(observe, beam, tabulate):
    """White sky through a chromatic Gaussian beam over the paper's bandwidth -> the input P(k), outside the wedge."""
    layout = GolombLayout(kind="golomb", count=9, spacing="4 m")
    template = observe(layout, n_channels=96, width=320e3, polarizations=("xx", "yy"))
    power, n_pairs_of_skies = 12482.356, 40
    cube = white_sky_visibilities(template, beam, power, 2 * n_pairs_of_skies)
    fixed = tabulate(beam, template.freq_array)
    settings = PowerSettings(bins=KBins(width="0.5 h/Mpc"), wedge_buffer="200 ns")
    estimates = []
    for skies in np.split(cube, n_pairs_of_skies, axis=2):
        uvd = from_cube(template, skies[None])
        spectra = delay_spectra(estimate_power(uvd, uvd, fixed, settings), settings)
        spectrum = spherical_average(spectra, settings, exclude_wedge=True)
        filled = spectrum.n_modes > 0
        assert spectrum.n_modes.sum() > 1000
        estimates.append(np.average(spectrum.power.real[filled], weights=spectrum.n_modes[filled]))
    expected = 1e6 * c.make_cosmology("Planck15").h ** 3 * power
    assert np.std(estimates) / np.sqrt(n_pairs_of_skies) / expected < 0.006
    assert np.mean(estimates) / expected == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(("taper", "tolerance"), [("blackman-harris", 5e-4), ("none", 5e-3)])
def test_normalization_is_exact_over_the_whole_band(observe, beam, tabulate, taper, tolerance):
    """Visibilities of the variance that flat P(k) gives at each frequency, with beam and scales evolving.

    Each baseline is rescaled to its expected tapered variance, so that the mean over delays has no sampling error left
    but that of the evolution with frequency.
    """
    template = observe(MwaLayout(kind="mwa-compact-minredundant", count=16), n_channels=96, width=320e3)
    frequencies, cosmo, power = template.freq_array, c.make_cosmology("Planck15"), 12482.356
    fixed, z = tabulate(beam, frequencies), c.redshift(frequencies)
    volume = np.array([c.transverse_scale(cosmo, x) ** 2 * c.radial_scale(cosmo, x) for x in z])
    jansky = (1 * u.K).to_value(u.Jy / u.sr, u.brightness_temperature(frequencies * u.Hz))
    variance = 0.25 * jansky**2 * fixed.angles[1] * power / (volume * 320e3)
    rng, weights = np.random.default_rng(5), make_taper(taper, frequencies.size) ** 2
    shape = (1, template.Nbls, frequencies.size, 1)
    unit = (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)
    unit /= np.sqrt(np.average(np.abs(unit[..., 0]) ** 2, axis=2, weights=weights))[..., None, None]
    uvd = from_cube(template, unit * np.sqrt(variance)[:, None])
    mean = estimate_power(uvd, uvd, fixed, PowerSettings(taper=taper)).data_array[0].real.mean()
    assert mean / (1e6 * cosmo.h**3 * power) == pytest.approx(1.0, abs=tolerance)


def test_flux_conventions():
    frequencies = np.array([150e6, 180e6])
    omega = np.array([0.2, 0.1])
    kelvin = kelvin_per_jansky(frequencies, omega, "avg")
    jansky = (1 * u.K).to_value(u.Jy / u.sr, u.brightness_temperature(frequencies * u.Hz)) * omega
    np.testing.assert_allclose(kelvin * jansky, 1.0, rtol=1e-12)
    for convention in (None, "sum"):
        np.testing.assert_allclose(kelvin_per_jansky(frequencies, omega, convention), 2 * kelvin)


def test_redundant_pairs_are_all_others_of_the_group_and_point_alike(observe):
    template = observe(HexLayout(kind="hex", side=3), n_channels=8)
    pairs = make_pairs(template, PowerSettings())
    vectors = {}
    for (a, b), vector in zip(antenna_pairs(template).tolist(), baseline_vectors(template), strict=True):
        vectors[a, b], vectors[b, a] = vector, -vector
    groups = {}
    for first, second in pairs:
        assert first not in (second, second[::-1])
        np.testing.assert_allclose(vectors[first], vectors[second], atol=0.1)
        groups.setdefault(tuple(np.rint(vectors[first] * 2).astype(int)), set()).add((first, second))
    lengths = {tuple(np.rint(v * 2).astype(int)) for v in vectors.values()}
    for group, found in groups.items():
        members = {b for pair in found for b in pair}
        assert len(found) == len(members) * (len(members) - 1)
        assert len(members) == sum(np.allclose(v, np.array(group) / 2, atol=0.3) for v in vectors.values())
        assert tuple(-np.array(group)) not in groups
    singles = {g for g in lengths if sum(np.allclose(v, np.array(g) / 2, atol=0.3) for v in vectors.values()) == 1}
    assert len(lengths - singles) == 2 * len(groups)


def test_choice_of_pairs(observe):
    random = observe(MwaLayout(kind="mwa-compact-minredundant", count=12), n_channels=8)
    assert all(first == second for first, second in make_pairs(random, PowerSettings()))
    golomb = observe(GOLOMB, n_channels=8)
    with pytest.raises(ValueError, match="allowed for this array: 'same-baseline'"):
        make_pairs(golomb, PowerSettings(pairs="redundant-group"))
    hexagon = observe(HexLayout(kind="hex", side=2), n_channels=8)
    assert len(make_pairs(hexagon, PowerSettings(pairs="same-baseline"))) == hexagon.Nbls


def test_reversed_baselines_of_a_group_are_conjugated(observe, beam):
    """All baselines of a group see the same sky: crossing them gives the same as crossing each with itself."""
    template = observe(HexLayout(kind="hex", side=2), n_channels=16)
    swapped = template.copy()
    swapped.reorder_blts(order="baseline")
    swapped.conjugate_bls(np.arange(swapped.Nblts)[::2])
    for uvd in (template, swapped):
        vectors = baseline_vectors(uvd)
        rng = np.random.default_rng(2)
        sources = rng.normal(size=(40, 2)) * 0.1
        phases = (vectors[:, :2] @ sources.T)[:, None] * uvd.freq_array[:, None] / constants.c.value
        data = from_cube(uvd, np.exp(2j * np.pi * phases).sum(axis=-1)[None, ..., None])
        settings = PowerSettings()
        power = delay_spectra(estimate_power(data, data, beam, settings), settings).power
        np.testing.assert_allclose(power.imag, 0, atol=1e-9 * power.real.max())
        assert (power.real > 0).all()


def test_inputs_are_untouched_and_the_result_survives_hdf5(observe, white, beam, tmp_path):
    even, odd = two(observe(GOLOMB, polarizations=("xx", "yy")), white)
    before = even.copy(), odd.copy()
    uvp = estimate_power(even, odd, beam, PowerSettings())
    assert (even, odd) == before
    uvp.write_hdf5(str(tmp_path / "p.h5"))
    back = UVPSpec()
    back.read_hdf5(str(tmp_path / "p.h5"))
    assert back == uvp
    assert back.cosmo == uvp.cosmo
    settings = PowerSettings()
    power = delay_spectra(uvp, settings).power
    # What is read lies otherwise in memory, and may be added up in another order.
    np.testing.assert_allclose(delay_spectra(back, settings).power, power, rtol=0, atol=1e-12 * np.abs(power).max())


def test_a_polarization_without_data_is_left_out(observe, white, beam):
    even, odd = two(observe(GOLOMB, polarizations=("xx", "yy")), white)
    first = even.polarization_array[0]
    alone = estimate_spectra(
        *(uvd.select(polarizations=[first], inplace=False) for uvd in (even, odd)), beam, PowerSettings()
    )
    odd.flag_array[..., 1] = True
    assert polarizations_without_data(even, odd) == [even.polarization_array[1]]
    found = estimate_spectra(even, odd, beam, PowerSettings())
    np.testing.assert_allclose(found.power, alone.power, rtol=1e-10)
    assert even.Npols == 2
    even.flag_array[:] = True
    assert polarizations_without_data(even, odd) == []


class WiderInY:
    """A beam whose solid angles in yy are other multiples of those in xx."""

    def __init__(self, beam):
        self.beam = beam

    def solid_angles(self, frequencies, pol):
        linear, squared = self.beam.solid_angles(frequencies, pol)
        return (linear, squared) if pol == "xx" else (2 * linear, 3 * squared)


def test_each_polarization_has_the_solid_angles_of_its_own_beam(observe, white, beam):
    """Temperatures go as 1 / Omega_p, and the normalization as Omega_p^2 / Omega_pp: together as 1 / Omega_pp."""
    both = two(observe(GOLOMB, polarizations=("xx", "yy")), white)
    found = estimate_power(*both, WiderInY(beam), PowerSettings()).data_array[0]
    equal = estimate_power(*both, beam, PowerSettings()).data_array[0]
    np.testing.assert_allclose(found, equal / [1, 3], rtol=1e-10)


def test_a_baseline_without_odd_data_is_crossed_by_its_even_data_alone(observe, white, beam):
    even, odd = two(observe(HexLayout(kind="hex", side=2), n_channels=8), white)
    settings = PowerSettings(pairs="redundant-group")
    pairs = make_pairs(even, settings)
    whole, lost = set(pairs), pairs[0][0]
    odd.flag_array[(antenna_pairs(odd) == sorted(lost)).all(axis=1)] = True
    found = estimate_power(even, odd, beam, settings)
    kept = set(found.get_blpairs())
    assert kept == {pair for pair in whole if pair[1] != lost}
    assert lost in {first for first, _ in kept}


def test_bad_data_are_refused(observe, white, beam):
    template = observe(GOLOMB)
    even, odd = two(template, white)
    many = white(observe(GOLOMB, n_times=2), np.random.default_rng(0))
    with pytest.raises(ValueError, match="even data have 2 integrations, expected 1"):
        estimate_power(many, odd, beam, PowerSettings())
    kelvin = odd.copy()
    kelvin.vis_units = "K str"
    with pytest.raises(ValueError, match=r"odd data are in 'K str', expected 'Jy'"):
        estimate_power(even, kelvin, beam, PowerSettings())
    fewer = white(observe(GOLOMB, n_channels=16), np.random.default_rng(0))
    with pytest.raises(ValueError, match="differ in freq_array"):
        estimate_power(even, fewer, beam, PowerSettings())
