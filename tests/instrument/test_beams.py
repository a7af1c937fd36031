"""Beams against closed forms, measured widths of the MWA tile, and an independent array factor."""

from __future__ import annotations

import re
import warnings

import h5py
import healpy
import numpy as np
import pytest
from pyuvdata import BeamInterface, UVBeam, analytic_beam
from pyuvdata.analytic_beam import ShortDipoleBeam
from scipy.constants import speed_of_light
from scipy.integrate import quad
from scipy.signal.windows import blackmanharris
from scipy.special import j1

from calstudy.base.errors import InputError
from calstudy.base.package_files import BEAM
from calstudy.instrument import settings as section
from calstudy.instrument import tabulated
from calstudy.instrument.antenna_beams import MisalignedBeam
from calstudy.instrument.as_built import Misalignment
from calstudy.instrument.beam_frequencies import mwa_frequencies
from calstudy.instrument.beam_models.formulas import AiryBeam, DipoleBeam, GaussianBeam, MwaAnalyticBeam
from calstudy.instrument.beam_models.tables import HERA_FILES, FileBeam, HeraBeam, MwaEmbeddedBeam
from calstudy.instrument.beams import (
    AZIMUTHS,
    ZENITH_ANGLES,
    ExactBeam,
    MwaTile,
    _solid_angles,
    integrate_power,
    make_beam,
)
from calstudy.simulate.patterns import power_pattern

CHANNELS = 167.075e6 + 320e3 * np.arange(96)
BAND = np.array([167.075e6, 182e6, 197.715e6])
EVEN = np.array([166e6, 182e6, 198e6])
"""Frequencies of beamfits files, which must be equally spaced."""


@pytest.fixture(scope="module")
def embedded():
    return make_beam(MwaEmbeddedBeam())


def power(beam, azimuth, zenith_angle, frequencies, feed=0):
    """Power beam along one azimuth, shape (Nfreqs, Nza), from whichever object `Beam.at` gives."""
    jones = BeamInterface(beam.at(frequencies), beam_type="efield").compute_response(
        az_array=np.full(len(zenith_angle), azimuth),
        za_array=zenith_angle,
        freq_array=frequencies,
        interpolation_function="az_za_simple",
    )
    return (np.abs(jones[:, feed]) ** 2).sum(axis=0)


def half_width(values, zenith_angle):
    """Zenith angle at half power."""
    beyond = int(np.argmax(values < 0.5))
    return np.interp(0.5, values[[beyond, beyond - 1]], zenith_angle[[beyond, beyond - 1]])


def test_solid_angles_of_a_short_dipole():
    """∫(1 − sin²θ cos²φ) dΩ = 4π/3 and ∫(...)² dΩ = 16π/15 over the hemisphere."""
    beam = make_beam(DipoleBeam(kind="short-dipole"))
    for polarization in ("xx", "yy"):
        omega_p, omega_pp = beam.solid_angles(BAND, polarization)
        np.testing.assert_allclose(omega_p, 4 * np.pi / 3, rtol=1e-7)
        np.testing.assert_allclose(omega_pp, 16 * np.pi / 15, rtol=1e-7)


def test_solid_angles_of_a_narrow_gaussian():
    """exp(−θ²/s²) has Ω_p = πs²(1 − s²/6 + ...), from sin θ = θ − θ³/6, and half of s² for the square."""
    beam = make_beam(GaussianBeam(kind="gaussian", fwhm_deg=6.0, reference_frequency="182 MHz"))
    omega_p, omega_pp = beam.solid_angles(BAND, "xx")
    squared = (np.deg2rad(3.0) ** 2 / np.log(2)) * (182e6 / BAND) ** 2
    np.testing.assert_allclose(omega_p, np.pi * squared * (1 - squared / 6), rtol=1e-5)
    np.testing.assert_allclose(omega_pp, np.pi * squared / 2 * (1 - squared / 12), rtol=1e-5)


@pytest.mark.parametrize("fwhm", [0.01, 0.3, 6.0])
def test_solid_angles_of_gaussians_much_narrower_than_a_degree(fwhm):
    """2π ∫exp(−kθ²/s²) sin θ dθ, k = 1 and 2, by quadrature out to 12 s."""
    beam = make_beam(GaussianBeam(kind="gaussian", fwhm_deg=fwhm))
    width = np.deg2rad(fwhm / 2) / np.sqrt(np.log(2)) * 182e6 / BAND

    def ring(angle, power, scale):
        return 2 * np.pi * np.sin(angle) * np.exp(-power * (angle / scale) ** 2)

    for power, found in enumerate(beam.solid_angles(BAND, "xx"), start=1):
        expected = [quad(ring, 0, 12 * scale, args=(power, scale))[0] for scale in width]
        np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("diameter", [25, 300])
def test_solid_angles_of_large_dishes(diameter):
    """The Airy disk on an even grid of 200 points in the narrowest sidelobe, or more."""
    beam = make_beam(AiryBeam(kind="airy", diameter=f"{diameter} m"))
    angle = np.linspace(1e-12, np.pi / 2, 200_001)
    argument = np.pi * diameter * np.sin(angle) * BAND[1] / speed_of_light
    values = (2 * j1(argument) / argument) ** 2
    for power, found in enumerate(beam.solid_angles(BAND[1:2], "xx"), start=1):
        expected = 2 * np.pi * np.trapezoid(np.sin(angle) * values**power, angle)
        assert found[0] == pytest.approx(expected, rel=1e-5)


def test_gaussian_width_is_the_power_fwhm_and_shrinks_with_frequency():
    beam = make_beam(GaussianBeam(kind="gaussian", fwhm_deg=20.0, reference_frequency="160 MHz"))
    frequencies = np.array([160e6, 200e6])
    values = power(beam, 0.3, np.deg2rad([10.0, 8.0]), frequencies)
    assert values[0, 0] == pytest.approx(0.5)
    assert values[1, 1] == pytest.approx(0.5)


def test_airy_beam():
    beam = make_beam(AiryBeam(kind="airy", diameter="6 m"))
    angle = np.deg2rad(np.array([3.0, 12.0, 30.0]))
    argument = np.pi * 6.0 * np.sin(angle) * 182e6 / speed_of_light
    values = power(beam, 1.0, angle, np.array([182e6]))
    np.testing.assert_allclose(values[0], (2 * j1(argument) / argument) ** 2, rtol=1e-9)


def test_ideal_tile_is_a_dipole_times_a_sum_over_its_sixteen_dipoles_and_their_images():
    beam = make_beam(MwaAnalyticBeam(kind="mwa-analytic"))
    generator = np.random.default_rng(7)
    azimuth, zenith_angle = generator.uniform(0, 2 * np.pi, 50), generator.uniform(0, np.pi / 2, 50)
    frequency = 180e6
    direction = np.array(
        [np.sin(zenith_angle) * np.cos(azimuth), np.sin(zenith_angle) * np.sin(azimuth), np.cos(zenith_angle)]
    )
    place = np.array([(1.1 * i, 1.1 * j, 0.278 * up) for i in range(4) for j in range(4) for up in (1, -1)])
    sign = np.tile([1, -1], 16)
    wave = 2j * np.pi * frequency / speed_of_light
    response = (sign * np.exp(wave * (place @ direction).T)).sum(axis=1)
    zenith = (sign * np.exp(wave * place[:, 2])).sum()
    dipole = ShortDipoleBeam().efield_eval(az_array=azimuth, za_array=zenith_angle, freq_array=np.array([frequency]))
    tile = beam.at(np.array([frequency])).efield_eval(
        az_array=azimuth, za_array=zenith_angle, freq_array=np.array([frequency])
    )
    np.testing.assert_allclose(np.abs(tile), np.abs(dipole * response / zenith), atol=1e-12)


@pytest.fixture(scope="module")
def mwa_table():
    """What is read of the beam file for the default band."""
    return tabulated._read_mwa(BEAM.find(), section.Channels().band)


@pytest.mark.parametrize("interpolation", ["chebyshev", "linear"])
def test_the_kept_fit_of_the_embedded_element_is_the_fit(monkeypatch, tmp_path, mwa_table, interpolation):
    """Bit by bit; what is kept is of the file's content, and is not of another file, band or interpolation."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    read, reads, band = tabulated._read_mwa, [], section.Channels().band

    def counted(path, wanted):
        reads.append((path, wanted))
        return mwa_table.copy() if (path, wanted) == (BEAM.find(), band) else read(path, wanted)

    monkeypatch.setitem(tabulated.READERS, "mwa-beam", counted)
    beams = []
    for _ in range(2):
        tabulated._fitted.cache_clear()  # As in another process.
        beams.append(tabulated.mwa_embedded_element(None, band, interpolation))
    assert len(reads) == 1
    fit = tabulated.TabulatedBeam(tabulated.fit_table(mwa_table, band, interpolation))
    for beam in beams:
        assert beam.fit_error == fit.fit_error
        for name, value in fit.description.items():
            assert np.array_equal(beam.description[name], value)
        assert np.array_equal(beam.jones(BAND), fit.jones(BAND))
        assert np.array_equal(beam.tabulated_frequencies, fit.tabulated_frequencies)
    other = tmp_path / "other.h5"
    other.write_text("not a beam")
    with pytest.raises(InputError, match="cannot be read as an MWA beam file"):
        tabulated.mwa_embedded_element(other, band, interpolation)


def test_a_beam_file_that_takes_data_from_other_files_is_refused(tmp_path):
    """A link would be followed to a file of the machine that reads the beam."""
    path = tmp_path / "beam.h5"
    with h5py.File(path, "w") as file:
        file["X1_150000000"] = h5py.ExternalLink("other.h5", "/X1_150000000")
    with pytest.raises(InputError, match="X1_150000000 is an external link; write it again as one file"):
        mwa_frequencies(path)


def test_a_damaged_name_in_an_hdf5_file_is_refused_in_a_sentence(tmp_path):
    path = tmp_path / "beam.h5"
    with h5py.File(path, "w") as file:
        file.create_group(b"\xe9")
    with pytest.raises(InputError, match="cannot be read as HDF5"):
        mwa_frequencies(path)


def test_x_is_the_east_west_dipole(embedded):
    """A dipole is blind along its axis: far from zenith, feed x sees less to the east than to the north."""
    angle = np.deg2rad(np.arange(70.0, 86.0))
    for beam in (embedded, make_beam(DipoleBeam(kind="short-dipole"))):
        east, north = (power(beam, azimuth, angle, BAND[1:2])[0].sum() for azimuth in (0, np.pi / 2))
        assert east < 0.5 * north
        east, north = (power(beam, azimuth, angle, BAND[1:2], feed=1)[0].sum() for azimuth in (0, np.pi / 2))
        assert north < 0.5 * east


# Half widths at half maximum of the embedded element beam at its own tabulated frequencies, towards east and north.
@pytest.mark.parametrize(
    ("megahertz", "east", "north"), [(166.4, 10.15, 10.45), (186.88, 9.07, 9.53), (197.12, 8.63, 9.22)]
)
def test_width_of_the_embedded_element_beam(embedded, megahertz, east, north):
    angle = np.deg2rad(np.arange(0, 20, 0.1))
    for azimuth, expected in ((0, east), (np.pi / 2, north)):
        values = power(embedded, azimuth, angle, np.array([megahertz * 1e6]))[0]
        assert np.rad2deg(half_width(values, angle)) == pytest.approx(expected, abs=0.02)


def test_ideal_and_embedded_tile_have_nearly_the_same_width(embedded):
    angle = np.deg2rad(np.arange(0, 20, 0.1))
    ideal = make_beam(MwaAnalyticBeam(kind="mwa-analytic"))
    for azimuth in (0, np.pi / 2):
        widths = [
            np.rad2deg(half_width(power(beam, azimuth, angle, BAND[1:2])[0], angle)) for beam in (embedded, ideal)
        ]
        assert widths[0] == pytest.approx(widths[1], abs=0.25)


def test_embedded_element_beam_peaks_at_zenith_with_one(embedded):
    beam = embedded.at(BAND)
    values = (np.abs(beam.data_array) ** 2).sum(axis=0)
    np.testing.assert_allclose(values[:, :, 0], 1.0, rtol=1e-12)
    assert values.max() <= 1 + 1e-12
    assert beam.data_normalization == "peak"
    assert beam.mount_type == "fixed"
    assert embedded.stand_in is None


def test_solid_angles_of_the_embedded_element_beam(embedded):
    omega_p, omega_pp = embedded.solid_angles(np.array([166.4e6, 197.12e6]), "xx")
    np.testing.assert_allclose(omega_p, [0.156, 0.119], rtol=0.01)
    assert (omega_pp < omega_p / 2 * 1.05).all()


def test_smooth_fit_follows_the_table_to_its_scatter(embedded):
    """2.4e-5 rms is the table's own scatter: an order-8 fit must leave no more than a few times that anywhere."""
    assert embedded.table.fit_error < 4e-4


@pytest.mark.chain
def test_smooth_fit_is_smooth_where_tabulated_steps_are_not(embedded):
    """Delay transform of the power beam: the fit has nothing at the 781 ns of the table's 1.28 MHz; others have."""
    taper = blackmanharris(len(CHANNELS), sym=False)
    delays = np.abs(np.fft.fftfreq(len(CHANNELS), 320e3))

    def beyond_wedge(beam, low, high):
        table = beam.at(CHANNELS)
        values = (np.abs(table.data_array[:, 0, :, ::15, ::45]) ** 2).sum(axis=0)
        spectrum = np.abs(np.fft.fft(values * taper[:, None, None], axis=0)) / taper.sum()
        return np.sqrt(np.mean(spectrum[(delays > low) & (delays < high)] ** 2))

    point_to_point = {kind: make_beam(MwaEmbeddedBeam(interpolation=kind)) for kind in ("cubic", "nearest")}
    assert beyond_wedge(embedded, 200e-9, 400e-9) < 1e-6
    assert beyond_wedge(embedded, 200e-9, 400e-9) < 0.1 * beyond_wedge(point_to_point["cubic"], 200e-9, 400e-9)
    assert beyond_wedge(embedded, 700e-9, 860e-9) < 1e-7
    assert beyond_wedge(point_to_point["nearest"], 700e-9, 860e-9) > 1e-5


@pytest.mark.parametrize("interpolation", ["cubic", "linear", "nearest"])
def test_point_to_point_interpolation_passes_through_the_table(interpolation):
    beam = make_beam(MwaEmbeddedBeam(interpolation=interpolation))
    assert beam.table.fit_error < 1e-12


def test_beam_does_not_depend_on_which_frequencies_are_asked_for_together(embedded):
    together = embedded.at(BAND).data_array[:, :, 1]
    alone = embedded.at(BAND[1:2]).data_array[:, :, 0]
    np.testing.assert_allclose(alone, together, atol=1e-14)


def test_fewer_channels_keep_the_same_beam(embedded):
    few = make_beam(MwaEmbeddedBeam(), section.Channels(first="180 MHz", count=48))
    np.testing.assert_allclose(
        few.at(np.array([182e6])).data_array, embedded.at(np.array([182e6])).data_array, atol=4e-5
    )


def test_band_between_two_tabulated_frequencies(embedded):
    """Eight channels span 0.56 MHz, less than the table's 1.28 MHz."""
    narrow = make_beam(MwaEmbeddedBeam(), section.Channels(first="182.1 MHz", count=8))
    assert 0 < narrow.table.fit_error < 4e-4
    frequency = np.array([182.3e6])
    np.testing.assert_allclose(narrow.at(frequency).data_array, embedded.at(frequency).data_array, atol=4e-5)


def test_few_tabulated_frequencies_limit_the_interpolation(tmp_path, embedded):
    path = tmp_path / "beam.beamfits"
    embedded.at(np.array([166e6, 182.5e6, 199e6])).write_beamfits(path)
    assert make_beam(FileBeam(kind="beamfits", path=path, interpolation="linear")).table.fit_error < 1e-12
    with pytest.raises(InputError, match="cubic needs 4 tabulated frequencies"):
        make_beam(FileBeam(kind="beamfits", path=path, interpolation="cubic"))


def test_frequencies_outside_the_band_are_refused(embedded, mwa_table, monkeypatch):
    with pytest.raises(InputError, match="outside the band"):
        embedded.at(np.array([150e6]))
    monkeypatch.setitem(tabulated.READERS, "mwa-beam", lambda *_: mwa_table)
    with pytest.raises(InputError, match="not within"):
        make_beam(MwaEmbeddedBeam(), section.Channels(first="310 MHz"))


def test_beamfits_round_trip(tmp_path, embedded):
    path = tmp_path / "beam.beamfits"
    frequencies = np.arange(166e6, 199.5e6, 1e6)
    embedded.at(frequencies).write_beamfits(path)
    beam = make_beam(FileBeam(kind="beamfits", path=path))
    # A fit to samples of the fit, over a narrower band: the same but for the order's own truncation.
    np.testing.assert_allclose(beam.at(BAND).data_array, embedded.at(BAND).data_array, atol=3e-5)
    assert "beam.beamfits" in beam.stand_in
    np.testing.assert_allclose(beam.solid_angles(BAND, "yy"), embedded.solid_angles(BAND, "yy"), rtol=1e-4)


ROUND = np.radians(np.arange(0.0, 360.0, 2.0))


def oblique(table):
    """Give the components of a table along axes that are turned by 30 degrees from azimuth and zenith angle."""
    cosine, sine = np.cos(np.pi / 6), np.sin(np.pi / 6)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    table.data_array = np.einsum("ac,c...->a...", turn, table.data_array)
    table.basis_vector_array = np.broadcast_to(turn[:, :, None, None], table.basis_vector_array.shape).copy()


def descending(table):
    table.freq_array, table.data_array = table.freq_array[::-1].copy(), table.data_array[:, :, ::-1].copy()


@pytest.mark.parametrize(
    ("azimuth", "change"),
    [
        (ROUND - np.pi, None),
        (ROUND + np.radians(1), None),
        (np.append(ROUND, 2 * np.pi), None),
        (ROUND, oblique),
        (ROUND, descending),
    ],
    ids=["from -180 deg", "from 1 deg", "0 and 360 deg", "oblique axes", "descending frequencies"],
)
def test_the_order_and_axes_of_a_file_do_not_matter(tmp_path, azimuth, change):
    """A tile that is tilted, so that no two azimuths are alike, against its formula."""
    tile = MisalignedBeam(ExactBeam(MwaTile(), "tile", None), Misalignment(east=0.1, north=0.03)).at(EVEN)
    table = tile.to_uvbeam(freq_array=EVEN, axis1_array=azimuth, axis2_array=np.radians(np.arange(0, 91.0)))
    if change is not None:
        change(table)
    table.write_beamfits(tmp_path / "beam.beamfits")
    beam = make_beam(FileBeam(kind="beamfits", path=tmp_path / "beam.beamfits", interpolation="linear"))
    # Around, and between the last azimuths and the first.
    angles, zenith_angle = np.radians([10.0, 100, 179.5, 190, 260, 300, 359.5]), np.radians(8.0)
    points = angles, np.full(len(angles), zenith_angle)
    fields = power_pattern(beam.at(EVEN), EVEN, ["x", "y"]).fields(*points)
    found = fields.view(np.complex128).transpose(3, 1, 2, 0)
    expected = tile.efield_eval(az_array=points[0], za_array=points[1], freq_array=EVEN)
    zenith = tile.efield_eval(az_array=np.zeros(1), za_array=np.zeros(1), freq_array=EVEN)
    np.testing.assert_allclose(found, expected / np.sqrt((zenith**2).sum(axis=0)), atol=2e-4)


@pytest.mark.parametrize("part", [{"axis2_inds": np.arange(30)}, {"axis1_inds": np.arange(180)}])
def test_a_table_of_a_part_of_the_sky_is_refused(tmp_path, embedded, part):
    path = tmp_path / "beam.beamfits"
    embedded.at(np.arange(166e6, 199.5e6, 1e6)).select(**part, inplace=False).write_beamfits(path)
    with pytest.raises(InputError, match="must have all azimuths and zenith angles up to 90 deg"):
        make_beam(FileBeam(kind="beamfits", path=path))


def test_unusable_beam_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="there is no file"):
        make_beam(MwaEmbeddedBeam(path=tmp_path / "none.h5"))
    wrong = tmp_path / "wrong.h5"
    wrong.write_text("not a beam")
    with pytest.raises(InputError, match="cannot be read"):
        make_beam(MwaEmbeddedBeam(path=wrong))
    with pytest.raises(InputError, match="cannot be read"):
        make_beam(FileBeam(kind="beamfits", path=wrong))
    with pytest.raises(InputError, match="there is no file"):
        make_beam(FileBeam(kind="beamfits", path=tmp_path / "none.fits"))


def test_a_power_beam_is_its_root_along_the_feed(tmp_path):
    """A short dipole from its power: the power is kept, and at the zenith so is the direction of the field."""
    grid = {"axis1_array": np.radians(np.arange(360.0)), "axis2_array": np.radians(np.arange(91.0))}
    dipole = ShortDipoleBeam().to_uvbeam(freq_array=EVEN, beam_type="power", **grid)
    dipole.write_beamfits(tmp_path / "power.beamfits")
    beam = make_beam(FileBeam(kind="beamfits", path=tmp_path / "power.beamfits", interpolation="linear"))
    found = beam.at(EVEN).data_array
    expected = ShortDipoleBeam().to_uvbeam(freq_array=EVEN, **grid).data_array
    np.testing.assert_allclose((np.abs(found) ** 2).sum(axis=0), (np.abs(expected) ** 2).sum(axis=0), atol=1e-6)
    np.testing.assert_allclose(found[..., 0, :], expected[..., 0, :], atol=1e-6)
    assert "within" not in beam.stand_in


def test_the_note_on_a_beam_says_how_far_it_is_from_its_table(tmp_path):
    """The root of an Airy disk's power has cusps at the nulls, where a smooth function of frequency cannot be right."""
    grid = {"axis1_array": np.radians(np.arange(360.0)), "axis2_array": np.radians(np.arange(91.0))}
    frequencies = np.arange(160e6, 206e6, 1e6)
    disk = analytic_beam.AiryBeam(diameter=14.0)
    table = disk.to_uvbeam(freq_array=frequencies, beam_type="power", **grid)
    table.write_beamfits(tmp_path / "power.beamfits")
    beam = make_beam(FileBeam(kind="beamfits", path=tmp_path / "power.beamfits"))
    error = float(re.search(r"\(chebyshev: within ([\d.]+)% of the field at the zenith\)", beam.stand_in)[1])
    inner = (frequencies > 166e6) & (frequencies < 199e6)
    power = (np.abs(beam.at(frequencies[inner]).data_array[:, 0]) ** 2).sum(axis=0)
    expected = np.sqrt(np.abs(table.data_array[0, 0, inner]))
    # The note has two digits.
    assert error == pytest.approx(100 * np.abs(np.sqrt(power) - expected).max(), abs=0.06)
    assert error > 0.3


def healpix_file(path, beam, **options):
    """Write a beam in closed form on HEALPix, the half below the horizon as well, and return it."""
    table = beam.to_uvbeam(freq_array=EVEN, pixel_coordinate_system="healpix", ordering="ring", **options)
    table.write_beamfits(path)
    return table


@pytest.mark.parametrize("kind", ["efield", "power"])
def test_healpix_beams_are_read_better_than_pixels_are_apart(tmp_path, kind):
    """A tile on pixels of 1.8 degrees against its formula, and pyuvdata between these pixels."""
    path = tmp_path / "beam.beamfits"
    table = healpix_file(path, MwaTile(), nside=32, beam_type=kind)
    beam = make_beam(FileBeam(kind="beamfits", path=path, interpolation="linear"))
    azimuth, zenith_angle = np.radians([3.0, 50, 130, 222, 310]), np.radians([0.5, 2.7, 11, 17.5, 33])
    points = {"az_array": azimuth, "za_array": zenith_angle, "freq_array": EVEN}
    expected = (np.abs(MwaTile().efield_eval(**points)) ** 2).sum(axis=0)
    interface = BeamInterface(beam.at(EVEN), beam_type="efield")
    found = (np.abs(interface.compute_response(**points, interpolation_function="az_za_simple")) ** 2).sum(axis=0)
    interface = BeamInterface(table, beam_type=kind)
    bilinear = interface.compute_response(**points, interpolation_function="healpix_simple")
    bilinear = (np.abs(bilinear) ** 2).sum(axis=0) if kind == "efield" else bilinear[0, :2].real
    # Splines of degree 5 over pixels of a tenth of the beam; bilinear interpolation errs by their square.
    assert np.abs(found - expected).max() < 2e-4
    assert np.abs(bilinear - expected).max() > 10 * np.abs(found - expected).max()


def test_nested_pixels_are_the_same_beam(tmp_path):
    found = []
    for ordering in ("ring", "nested"):
        table = MwaTile().to_uvbeam(freq_array=EVEN, pixel_coordinate_system="healpix", nside=16, ordering=ordering)
        table.write_beamfits(tmp_path / f"{ordering}.beamfits")
        path = tmp_path / f"{ordering}.beamfits"
        found.append(make_beam(FileBeam(kind="beamfits", path=path, interpolation="linear")).at(EVEN).data_array)
    np.testing.assert_allclose(*found, atol=1e-12)


def test_a_healpix_beam_without_all_of_the_sky_is_refused(tmp_path):
    path = tmp_path / "part.beamfits"
    healpix_file(path, MwaTile(), nside=16, healpix_pixel_array=np.arange(300))
    with pytest.raises(InputError, match="does not have all pixels above the horizon"):
        make_beam(FileBeam(kind="beamfits", path=path))


def test_a_beam_whose_feed_x_is_north_south_is_refused(tmp_path):
    turned = ShortDipoleBeam(x_orientation="north").to_uvbeam(
        freq_array=EVEN, axis1_array=AZIMUTHS, axis2_array=ZENITH_ANGLES[::10]
    )
    turned.write_beamfits(tmp_path / "north.beamfits")
    with pytest.raises(InputError, match=r"feed x of .* is not east-west"):
        make_beam(FileBeam(kind="beamfits", path=tmp_path / "north.beamfits"))


@pytest.mark.parametrize("grid", ["az_za", "healpix"])
@pytest.mark.parametrize("beam", [analytic_beam.AiryBeam(diameter=8.0), analytic_beam.GaussianBeam(sigma=0.3)])
def test_fields_without_a_direction_are_refused(tmp_path, beam, grid):
    """pyuvdata gives both components of these the same value: a vortex at the zenith."""
    axes = {"axis1_array": AZIMUTHS, "axis2_array": ZENITH_ANGLES[::10]} if grid == "az_za" else {"nside": 16}
    table = beam.to_uvbeam(freq_array=EVEN, beam_type="efield", pixel_coordinate_system=grid, **axes)
    path = tmp_path / "beam.beamfits"
    table.write_beamfits(path)
    with pytest.raises(InputError, match="has fields without a direction at the zenith"):
        make_beam(FileBeam(kind="beamfits", path=path, interpolation="linear"))
    power = beam.to_uvbeam(freq_array=EVEN, beam_type="power", pixel_coordinate_system=grid, **axes)
    power.write_beamfits(path, clobber=True)
    assert make_beam(FileBeam(kind="beamfits", path=path, interpolation="linear")).at(EVEN).Nfreqs == 3


@pytest.mark.parametrize(("model", "frequency", "pixels"), [("fagnoni", 160e6, "healpix"), ("nic-cst", 130e6, "az_za")])
def test_hera_beams_are_those_of_their_files(model, frequency, pixels):
    """At a tabulated frequency and the pixels of the file, which pyuvdata reads by itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # The files are old, and say little of their feeds.
        table = UVBeam.from_file(HERA_FILES[model].path, file_type="beamfits")
    assert table.pixel_coordinate_system == pixels
    channels = section.Channels(first=f"{frequency / 1e6 - 4} MHz", width="1 MHz", count=8)
    beam = make_beam(HeraBeam(kind="hera", model=model, interpolation="linear"), channels)
    at = np.array([frequency])
    rng = np.random.default_rng(3)
    azimuth, zenith_angle = np.radians(rng.integers(0, 360, 200)), np.radians(rng.integers(1, 60, 200))
    if pixels == "healpix":
        chosen = rng.choice(np.flatnonzero(table.pixel_array < 12 * 32**2 // 5), 200)
        zenith_angle, azimuth = healpy.pix2ang(32, table.pixel_array[chosen])
    points = {"az_array": azimuth, "za_array": zenith_angle, "freq_array": at}
    function = "healpix_simple" if pixels == "healpix" else "az_za_simple"
    expected = BeamInterface(table, beam_type="efield").compute_response(**points, interpolation_function=function)
    found = BeamInterface(beam.at(at), beam_type="efield").compute_response(
        **points, interpolation_function="az_za_simple"
    )
    power_found, power_expected = ((np.abs(jones) ** 2).sum(axis=0) for jones in (found, expected))
    np.testing.assert_allclose(power_found, power_expected * (power_found.max() / power_expected.max()), atol=2e-3)


def test_integral_of_an_isotropic_beam_is_the_hemisphere():
    assert integrate_power(np.ones((91, 12)), np.deg2rad(np.arange(91.0))) == pytest.approx((2 * np.pi, 2 * np.pi))


def test_a_beam_of_a_file_is_fitted_and_integrated_once(tmp_path, embedded):
    """Each power spectrum of a run makes the beam again; its solid angles would take longer than the spectrum."""
    path = tmp_path / "beam.beamfits"
    embedded.at(np.arange(166e6, 199.5e6, 1e6)).write_beamfits(path)
    frequencies = np.linspace(170e6, 180e6, 40)
    angles = []
    for _ in range(2):
        before = _solid_angles.cache_info().misses
        angles.append(make_beam(FileBeam(kind="beamfits", path=path)).solid_angles(frequencies, "xx"))
    assert _solid_angles.cache_info().misses == before
    # Channels together, or one by one.
    table = make_beam(FileBeam(kind="beamfits", path=path)).table
    for place in (0, 17, 39):
        power = (np.abs(table.jones(frequencies[place : place + 1])[:, 0, 0]) ** 2).sum(axis=0)
        single = integrate_power(power, table.zenith_angles)
        np.testing.assert_allclose(single, [first[place] for first in angles[0]], rtol=1e-12)
