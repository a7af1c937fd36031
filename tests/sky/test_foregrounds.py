"""Foreground skies: counts, spectra, cuts, and what happens to files that cannot be used."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import requests
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.io.votable import from_table, parse
from astropy.table import Table
from pydantic import ValidationError
from pyradiosky import SkyModel
from scipy.integrate import quad
from tiny import tiny

from calstudy.base.errors import InputError
from calstudy.experiment.files import override, validate
from calstudy.simulate.sources import stokes_i
from calstudy.sky import catalogue
from calstudy.sky import settings as section
from calstudy.sky.counts import differential_counts
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.studies.preflight import require_possible

FREQUENCIES = 167.075e6 + 80e3 * np.arange(384)


@pytest.fixture(scope="module")
def synthetic():
    return make_foregrounds(section.SyntheticSources(flux_limit="100 mJy"), FREQUENCIES)


def flux(sky):
    return sky.stokes[0, 0].to_value("Jy")


def write_gleam(path, rows=6, **columns):
    """A table with the columns of the GLEAM catalogue."""
    table = {
        "GLEAM": [f"J{row}" for row in range(rows)],
        "RAJ2000": np.linspace(0, 300, rows),
        "DEJ2000": np.linspace(-80, 20, rows),
        "Fintwide": 0.02 * 2.0 ** np.arange(rows),
        "alpha": np.where(np.arange(rows) == 4, np.nan, -0.5),
    }
    Table(table | columns).write(path, **({"format": "votable"} if path.suffix == ".vot" else {}))
    return path


@pytest.mark.parametrize(("faint", "bright"), [(0.1, 0.2), (0.2, 0.4), (0.4, 0.8), (0.8, 1.6), (1.6, 4.0)])
def test_stand_in_sky_has_the_measured_counts(synthetic, faint, bright):
    mean = 4 * np.pi * quad(differential_counts, faint, bright)[0]
    found = ((flux(synthetic.sky) >= faint) & (flux(synthetic.sky) < bright)).sum()
    assert abs(found / mean - 1) < 0.05


def test_stand_in_sky_holds_the_real_bright_sources(synthetic):
    """3C 123 (206 Jy at 178 MHz, index -0.7) and 3C 273 (about 70 Jy), where they are."""
    names = synthetic.sky.name.astype(str)
    assert (np.char.startswith(names, "GLEAM") | np.char.startswith(names, "J")).sum() == 1894
    for position, jansky in ((SkyCoord("04h37m04.4s +29d40m14s"), 190.0), (SkyCoord("12h29m06.7s +02d03m09s"), 70.0)):
        near = synthetic.sky.skycoord.separation(position) < 1 * units.arcmin
        assert flux(synthetic.sky)[near].sum() == pytest.approx(jansky, rel=0.15)


def test_stand_in_is_announced(synthetic):
    assert "1894 real G4Jy components" in synthetic.stand_in
    assert "Franzen" in synthetic.stand_in


def test_bright_synthetic_sources_are_only_where_g4jy_is_not(synthetic):
    made_up = np.char.startswith(synthetic.sky.name.astype(str), "synthetic") & (flux(synthetic.sky) >= 4)
    directions = synthetic.sky.skycoord[made_up]
    assert made_up.sum() > 500
    assert ((directions.dec.deg >= 30) | (np.abs(directions.galactic.b.deg) < 10)).all()


def test_brightest_sources_and_the_same_ones_with_a_fainter_limit(synthetic):
    few = make_foregrounds(section.SyntheticSources(flux_limit="100 mJy", count=300), FREQUENCIES).sky
    np.testing.assert_array_equal(few.name, synthetic.sky.name[:300])
    assert (np.diff(flux(few)) <= 0).all()


def test_spectra(synthetic):
    assert synthetic.sky.spectral_type == "flat"
    real = make_foregrounds(section.SyntheticSources(flux_limit="2 Jy", spectrum="catalogue"), FREQUENCIES).sky
    assert real.spectral_type == "spectral_index"
    assert (real.reference_frequency == 200e6 * units.Hz).all()
    assert np.isfinite(real.spectral_index).all()
    assert np.median(real.spectral_index) == pytest.approx(-0.8, abs=0.05)


def test_counts_are_not_extrapolated():
    with pytest.raises(ValidationError, match="flux_limit"):
        section.SyntheticSources(flux_limit="0.5 mJy")


def test_no_foregrounds_is_a_dark_sky():
    nothing = make_foregrounds(section.NoSources(kind="none"), FREQUENCIES)
    assert nothing.sky.Ncomponents == 1
    assert (nothing.sky.stokes.value == 0).all()


@pytest.mark.parametrize("name", ["gleam.vot", "gleam.fits"])
def test_gleam_file(tmp_path, name):
    path = write_gleam(tmp_path / name)
    sky = make_foregrounds(section.GleamSources(kind="gleam", path=path), FREQUENCIES)
    np.testing.assert_allclose(flux(sky.sky), [0.64, 0.32, 0.16, 0.08])
    np.testing.assert_allclose(sky.sky.skycoord.dec.deg, [20, 0, -20, -40], atol=1e-9)
    assert "6 of GLEAM's 307455" in sky.stand_in
    spectra = make_foregrounds(section.GleamSources(kind="gleam", path=path, spectrum="catalogue"), FREQUENCIES).sky
    np.testing.assert_allclose(spectra.spectral_index, [-0.5, -0.8, -0.5, -0.5])


def test_gleam_file_without_a_column(tmp_path):
    path = tmp_path / "gleam.fits"
    Table({"RAJ2000": [1.0], "DEJ2000": [1.0], "alpha": [0.0]}).write(path)
    with pytest.raises(InputError, match="lacks GLEAM/Name, Fintwide/int_flux_wide"):
        make_foregrounds(section.GleamSources(kind="gleam", path=path), FREQUENCIES)


def test_missing_gleam_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setattr(section, "default_directory", lambda: tmp_path)
    with pytest.raises(InputError, match="calstudy data fetch gleam"):
        make_foregrounds(section.GleamSources(kind="gleam"), FREQUENCIES)


def test_too_high_a_flux_limit(tmp_path):
    path = write_gleam(tmp_path / "gleam.fits")
    with pytest.raises(InputError, match=r"sky\.foregrounds\.flux_limit"):
        make_foregrounds(section.GleamSources(kind="gleam", path=path, flux_limit="5 Jy"), FREQUENCIES)


def point_sky(spectrum):
    stokes = np.zeros((4, 1, 3)) * units.Jy
    stokes[0, 0] = [3.0, 1.0, 0.01] * units.Jy
    return SkyModel(
        name=["a", "b", "c"],
        skycoord=SkyCoord([10, 20, 30], [-30, -40, -50], unit="deg", frame="icrs"),
        stokes=stokes,
        component_type="point",
        **spectrum,
    )


def test_skyh5_catalogue_with_spectral_indices(tmp_path):
    path = tmp_path / "sky.skyh5"
    index = {
        "spectral_type": "spectral_index",
        "spectral_index": np.array([-1.0, 2.0, 0.0]),
        "reference_frequency": np.full(3, 100e6) * units.Hz,
    }
    point_sky(index).write_skyh5(path)
    flat = make_foregrounds(section.FileSources(kind="file", path=path), FREQUENCIES)
    centre = FREQUENCIES.mean() / 100e6
    np.testing.assert_allclose(flux(flat.sky), [centre**2, 3 / centre])
    assert flat.sky.spectral_type == "flat"
    assert "sky.skyh5" in flat.stand_in
    kept = make_foregrounds(section.FileSources(kind="file", path=path, spectrum="catalogue"), FREQUENCIES).sky
    np.testing.assert_array_equal(kept.spectral_index, [2.0, -1.0])


def test_catalogue_at_other_frequencies_is_refused(tmp_path):
    path = tmp_path / "sky.skyh5"
    full = point_sky({"spectral_type": "full", "freq_array": np.array([150e6]) * units.Hz})
    full.write_skyh5(path)
    with pytest.raises(InputError, match="frequencies other than the channels"):
        make_foregrounds(section.FileSources(kind="file", path=path, spectrum="catalogue"), FREQUENCIES)


TEXT_HEADER = "SOURCE_ID\tRA_ICRS [deg]\tDec_ICRS [deg]\t{0}\t{1}\n"


@pytest.mark.parametrize(
    ("columns", "told"),
    [
        (("Flux_76_MHz [Jy]", "Flux_107_MHz [Jy]"), "has fluxes at 76, 107 MHz, and at none of"),
        (("Flux_76_MHz [Jy]", "Flux_181_MHz [Jy]"), None),
        (("Flux [mJy]", "Frequency [Hz]"), r"Flux is in mJy, and must be in Jy"),
        (("Flux [Jy]", "Frequency [MHz]"), r"Frequency is in MHz, and must be in Hz"),
    ],
)
def test_text_catalogues_are_not_extrapolated_and_have_the_units_that_they_name(tmp_path, columns, told):
    path = tmp_path / "mine.txt"
    path.write_text(TEXT_HEADER.format(*columns) + "a\t10.0\t-30.0\t20.0\t15.0\n")
    settings = section.FileSources(kind="file", path=path)
    if told is None:
        assert flux(make_foregrounds(settings, FREQUENCIES).sky) == pytest.approx([15.0])
        return
    with pytest.raises(InputError, match=told):
        make_foregrounds(settings, FREQUENCIES)


def test_errors_of_sources_of_a_file_do_not_depend_on_the_fainter_ones(tmp_path):
    path = tmp_path / "sky.skyh5"
    point_sky({"spectral_type": "flat"}).select(component_inds=[2, 1, 0], inplace=False).write_skyh5(path)
    errors = section.CatalogueErrors(flux_scatter="5 %")
    found = [
        make_foregrounds(section.FileSources(kind="file", path=path, flux_limit=limit, errors=errors), FREQUENCIES).sky
        for limit in ("1 mJy", "0.1 Jy")
    ]
    np.testing.assert_array_equal(found[0].name, ["a", "b", "c"])
    np.testing.assert_array_equal(flux(found[0])[:2], flux(found[1]))


def sub_bands(centres, spectrum):
    """Two points whose fluxes in sub-bands are a polynomial of the frequency in units of 100 MHz, and half of it."""
    stokes = np.zeros((4, len(centres), 2))
    stokes[0] = np.polynomial.Polynomial(spectrum)(np.array(centres) / 100e6)[:, None] * [1, 0.5]
    return SkyModel(
        name=["a", "b"],
        skycoord=SkyCoord([10, 20], [-30, -40], unit="deg", frame="icrs"),
        stokes=stokes * units.Jy,
        component_type="point",
        spectral_type="subband",
        freq_array=np.array(centres) * units.Hz,
        freq_edge_array=(np.array([[-1e6], [1e6]]) + centres) * units.Hz,
    )


@pytest.mark.parametrize("diffuse", [None, section.SyntheticDiffuse(kind="synthetic", nside=16)])
@pytest.mark.parametrize(
    ("centres", "spectrum"),
    [
        ([150e6, 200e6], [2.0, -0.5]),
        ([120e6, 150e6, 200e6], [2.0, -0.5]),
        ([110e6, 140e6, 180e6, 220e6], [9.0, -8.0, 3.0, -0.5]),
    ],
)
def test_sub_bands_are_interpolated_by_the_highest_order_that_they_allow(tmp_path, centres, spectrum, diffuse):
    """A line from two or three of them, a cubic from four; a point alone and beside a map."""
    path = tmp_path / "sky.skyh5"
    sub_bands(centres, spectrum).write_skyh5(path)
    expected = np.polynomial.Polynomial(spectrum)(FREQUENCIES / 100e6)
    kept = make_foregrounds(section.FileSources(kind="file", path=path, spectrum="catalogue"), FREQUENCIES, diffuse)
    np.testing.assert_allclose(stokes_i(kept.sky, FREQUENCIES)[:, :2], expected[:, None] * [1, 0.5], rtol=1e-11)
    flat = make_foregrounds(section.FileSources(kind="file", path=path), FREQUENCIES).sky
    centre = np.polynomial.Polynomial(spectrum)(FREQUENCIES.mean() / 100e6)
    np.testing.assert_allclose(flux(flat), centre * np.array([1, 0.5]), rtol=1e-11)


@pytest.mark.parametrize(
    ("centres", "span"),
    [
        ([70e6, 150e6], "70 to 150 MHz"),
        ([70e6, 100e6, 130e6, 150e6], "70 to 150 MHz"),
        ([200e6, 230e6], "200 to 230 MHz"),
        ([FREQUENCIES.mean()], "182.395 MHz"),
    ],
)
@pytest.mark.parametrize(
    ("spectrum", "wanted"), [("flat", "the middle of the channels"), ("catalogue", "the channels")]
)
def test_sub_bands_that_do_not_enclose_the_channels_are_refused(tmp_path, centres, span, spectrum, wanted):
    path = tmp_path / "sky.skyh5"
    sub_bands(centres, [1.0]).write_skyh5(path)
    sentence = f"has sub-bands centred at {span}, which do not enclose {wanted} of 167.075 to 197.715 MHz; "
    with pytest.raises(InputError, match=re.escape(f"sky.foregrounds.path: {path} {sentence}")):
        make_foregrounds(section.FileSources(kind="file", path=path, spectrum=spectrum), FREQUENCIES)


@pytest.mark.parametrize("place", ["sky.foregrounds", "calibration.assumed.sky.foregrounds"])
def test_plans_refuse_sub_bands_that_do_not_enclose_the_channels(tmp_path, place):
    sub_bands([70e6, 150e6], [1.0]).write_skyh5(tmp_path / "sky.skyh5")
    settings = override(tiny(tmp_path), place, {"kind": "file", "path": str(tmp_path / "sky.skyh5")})
    with pytest.raises(InputError, match=f"^{place}.path: .* do not enclose the middle of the channels"):
        require_possible(validate(settings, tmp_path))


def test_sub_bands_about_the_middle_of_the_channels_are_enough_for_flat_spectra(tmp_path):
    path = tmp_path / "sky.skyh5"
    sub_bands([100e6, 190e6], [1.0]).write_skyh5(path)
    assert flux(make_foregrounds(section.FileSources(kind="file", path=path), FREQUENCIES).sky) == pytest.approx(
        [1, 0.5]
    )
    with pytest.raises(InputError, match="do not enclose the channels"):
        make_foregrounds(section.FileSources(kind="file", path=path, spectrum="catalogue"), FREQUENCIES)


def test_a_sky_that_is_no_catalogue_is_refused_at_frequencies_that_it_lacks():
    sentence = "the sky has sub-bands centred at 150 to 180 MHz, which do not enclose 167.075 to 197.715 MHz; "
    with pytest.raises(InputError, match=re.escape(sentence)):
        stokes_i(sub_bands([150e6, 180e6], [1.0]), FREQUENCIES)


OWN_SKY = """
import numpy as np
from astropy import units
from astropy.coordinates import SkyCoord
from pyradiosky import SkyModel

def sky(frequencies, kind, unit):
    stokes = np.zeros((4, 2 if kind == "subband" else 1, 2))
    stokes[0] = [2.0, 1.0]
    found = {
        "flat": {},
        "spectral_index": {"spectral_index": [-0.8, 0.5], "reference_frequency": [150, 200] * units.MHz},
        "subband": {
            "freq_array": [160e6, 200e6] * units.Hz, "freq_edge_array": [[150e6, 190e6], [170e6, 210e6]] * units.Hz
        },
    }
    points = SkyCoord([10, 20], [-30, -40], unit="deg", frame="icrs")
    return SkyModel(
        name=["a", "b"], skycoord=points, stokes=stokes * units.Unit(unit), spectral_type=kind, **found[kind]
    )
"""


def own_sky(folder, **options):
    (folder / "sky.py").write_text(OWN_SKY)
    return section.CodeSources(kind="code", path=folder / "sky.py", function="sky", options=options)


def test_points_of_own_code_in_kelvin_have_their_flux(tmp_path):
    """S = 2 k T ν² Ω / c² at the reference frequency of each."""
    sky = make_foregrounds(own_sky(tmp_path, kind="spectral_index", unit="K sr"), FREQUENCIES).sky
    boltzmann, light = 1.380649e-23, 299792458.0
    at_reference = 2e26 * boltzmann * np.array([2.0 * 150e6**2, 1.0 * 200e6**2]) / light**2
    assert dict(zip(sky.name, flux(sky), strict=True)) == pytest.approx(dict(zip("ab", at_reference, strict=True)))


def test_skies_of_own_code_that_cannot_be_used_are_refused(tmp_path):
    with pytest.raises(
        InputError, match=r"sky\.foregrounds: .* sky of sky\.py .* reference_frequency or freq_array must"
    ):
        make_foregrounds(own_sky(tmp_path, kind="flat", unit="K sr"), FREQUENCIES)
    with pytest.raises(InputError, match=r"sky of sky\.py has sub-bands centred at 160 to 200 MHz, .* 150 to 190 MHz;"):
        make_foregrounds(own_sky(tmp_path, kind="subband", unit="Jy"), np.array([150e6, 190e6]))


def test_a_sky_of_own_code_is_the_same_at_every_call(tmp_path):
    """Each piece of a simulation calls it: the data would be a patchwork of several skies."""
    drawn = OWN_SKY.replace("[2.0, 1.0]", "np.random.default_rng().uniform(1, 2, 2)")
    settings = own_sky(tmp_path, kind="flat", unit="Jy")
    settings.path.write_text(drawn)
    with pytest.raises(InputError, match="returns another sky at every call"):
        make_foregrounds(settings, FREQUENCIES)
    settings.path.write_text(drawn.replace("rng()", "rng(3)"))
    assert (flux(make_foregrounds(settings, FREQUENCIES).sky) > 1).all()


def test_fluxes_of_own_code_are_in_jansky(tmp_path):
    sky = make_foregrounds(own_sky(tmp_path, kind="flat", unit="mJy"), FREQUENCIES).sky
    np.testing.assert_allclose(sky.stokes[0, 0].value, [2e-3, 1e-3])


@pytest.mark.parametrize(
    ("change", "told"),
    [({"RAJ2000": ["01:02:03"] * 6}, "has text where"), ({"DEJ2000": np.linspace(-80, 100, 6)}, "beyond 90 deg")],
)
def test_gleam_files_of_other_content_are_refused(tmp_path, change, told):
    path = write_gleam(tmp_path / "gleam.vot", **change)
    with pytest.raises(InputError, match=told):
        make_foregrounds(section.GleamSources(kind="gleam", path=path), FREQUENCIES)


@pytest.mark.parametrize("name", ["gleam.dat", "gleam.fits"])
def test_gleam_files_of_no_known_format_are_refused(tmp_path, name):
    (tmp_path / name).write_text("not a table")
    with pytest.raises(InputError, match=f"{name} cannot be read as a VOTable or FITS table"):
        make_foregrounds(section.GleamSources(kind="gleam", path=tmp_path / name), FREQUENCIES)


COLUMNS = {"table": "", "id": "GLEAM", "right_ascension": "RAJ2000", "declination": "DEJ2000", "flux": "Fintwide"}


@pytest.mark.parametrize("name", ["none.skyh5", "wrong.skyh5", "wrong.sav", "wrong.vot"])
def test_unusable_catalogues_are_refused(tmp_path, name):
    for wrong in ("wrong.skyh5", "wrong.sav", "wrong.vot"):
        (tmp_path / wrong).write_text("not a catalogue")
    settings = {"kind": "file", "path": tmp_path / name, "votable": COLUMNS if name.endswith("vot") else None}
    with pytest.raises(InputError, match=name):
        make_foregrounds(section.FileSources.model_validate(settings), FREQUENCIES)


def votable_of_two(path, rows):
    """Write a VOTable of some of two sources, and return the settings that read it."""
    table = Table(
        {
            "source": ["a", "b"],
            "ra": [10.0, 20.0] * units.deg,
            "dec": [-30.0, -20.0] * units.deg,
            "s": [2.0, 1.0] * units.Jy,
        }
    )
    votable = from_table(table[:rows])
    votable.resources[0].tables[0].name = "survey"
    votable.to_xml(str(path))
    columns = {"table": "survey", "id": "source", "right_ascension": "ra", "declination": "dec", "flux": "s"}
    return section.FileSources.model_validate({"kind": "file", "path": path, "votable": columns})


def test_a_votable_without_a_unit_of_the_flux_is_refused(tmp_path):
    settings = votable_of_two(tmp_path / "mine.vot", 2)
    text = settings.path.read_text()
    settings.path.write_text(text.replace(' unit="Jy"', ""))
    with pytest.raises(InputError, match=r"a column of votable\.flux has no unit"):
        make_foregrounds(settings, FREQUENCIES)


def test_any_votable_is_read_by_the_columns_named(tmp_path):
    sky = make_foregrounds(votable_of_two(tmp_path / "mine.vot", 2), FREQUENCIES).sky
    assert flux(sky) == pytest.approx([2.0, 1.0])
    assert sky.skycoord.icrs.ra.deg == pytest.approx([10.0, 20.0])


@pytest.mark.parametrize(("column", "values"), [("s", [9999.0, 1.0]), ("ra", [9999.0, 20.0])])
def test_the_null_value_of_a_votable_is_no_number(tmp_path, column, values):
    settings = votable_of_two(tmp_path / "mine.vot", 2)
    found = parse(str(settings.path))
    field = found.get_first_table().get_field_by_id_or_name(column)
    found.get_first_table().array[column] = values
    field.values.null = 9999.0
    found.to_xml(str(settings.path))
    with pytest.raises(InputError, match=rf"1 entries of column {column} have its null value, 9999\.0; leave out"):
        make_foregrounds(settings, FREQUENCIES)


def test_null_values_of_columns_that_are_not_read_do_not_matter(tmp_path):
    settings = votable_of_two(tmp_path / "mine.vot", 2)
    table = Table.read(settings.path)
    table["e_s"] = [-999, 1]
    found = from_table(table)
    found.resources[0].tables[0].name = "survey"
    found.get_first_table().get_field_by_id_or_name("e_s").values.null = -999
    found.to_xml(str(settings.path))
    assert flux(make_foregrounds(settings, FREQUENCIES).sky) == pytest.approx([2.0, 1.0])


def test_a_source_without_a_position_is_left_out(tmp_path):
    settings = votable_of_two(tmp_path / "mine.vot", 2)
    found = parse(str(settings.path))
    found.get_first_table().array["ra"] = [np.nan, 20.0]
    found.to_xml(str(settings.path))
    foregrounds = make_foregrounds(settings, FREQUENCIES)
    assert flux(foregrounds.sky) == pytest.approx([1.0])
    assert foregrounds.stand_in == "foregrounds: 1 sources of mine.vot"


CSV = {"right_ascension": "ra", "declination": "dec", "flux": "s", "frequency": "150 MHz"}


def test_a_csv_is_read_by_the_columns_named(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text("# by hand\ndec,s,ra,alpha\n-30.0,1.5,10.0,-1.0\n-20.0,3.0,20.0,0.5\n-10.0,,30.0,0.0\n")
    flat = make_foregrounds(section.FileSources(kind="file", path=path, csv=CSV), FREQUENCIES)
    assert flux(flat.sky) == pytest.approx([3.0, 1.5])
    assert flat.sky.skycoord.icrs.dec.deg == pytest.approx([-20.0, -30.0])
    assert flat.stand_in == "foregrounds: 2 sources of mine.csv"
    steep = {"kind": "file", "path": path, "csv": {**CSV, "spectral_index": "alpha"}, "spectrum": "catalogue"}
    sky = make_foregrounds(section.FileSources.model_validate(steep), FREQUENCIES).sky
    at_300 = sky.at_frequencies(np.array([300e6]) * units.Hz, inplace=False)
    assert flux(at_300) == pytest.approx([3 * np.sqrt(2), 0.75])
    path.write_text("dec,s,ra,alpha\n-30.0,1.5,10.0,-1.0\n-20.0,3.0,20.0,\n")
    for spectrum in ("flat", "catalogue"):
        with pytest.raises(
            InputError, match=r"mine\.csv cannot .*1 sources have no spectral index, such as that of row 2"
        ):
            make_foregrounds(section.FileSources.model_validate({**steep, "spectrum": spectrum}), FREQUENCIES)
    with pytest.raises(InputError, match="no column flux, only dec, s, ra, alpha"):
        make_foregrounds(section.FileSources(kind="file", path=path, csv={**CSV, "flux": "flux"}), FREQUENCIES)
    with pytest.raises(ValidationError, match="required for CSV files"):
        section.FileSources(kind="file", path=path)


@pytest.mark.parametrize("rows", ["", "10.0,-30.0,,0.0\n10.0,,1.0,0.0\n"])
@pytest.mark.parametrize("columns", [CSV, {**CSV, "spectral_index": "alpha"}])
def test_a_csv_without_a_source_is_refused(tmp_path, rows, columns):
    path = tmp_path / "mine.csv"
    path.write_text("ra,dec,s,alpha\n" + rows)
    with pytest.raises(InputError, match=r"^sky\.foregrounds\.path: .*mine\.csv .*it holds no source"):
        make_foregrounds(section.FileSources(kind="file", path=path, csv=columns), FREQUENCIES)


def test_a_votable_without_a_source_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"^sky\.foregrounds\.path: .*mine\.vot holds no source"):
        make_foregrounds(votable_of_two(tmp_path / "mine.vot", 0), FREQUENCIES)


def test_points_in_kelvin_have_their_flux(tmp_path):
    path = tmp_path / "mine.skyh5"
    sky = SkyModel(
        name=np.array(["a"]),
        skycoord=SkyCoord([10.0], [-30.0], unit="deg", frame="icrs"),
        stokes=np.array([[[2.0]], [[0]], [[0]], [[0]]]) * units.Jy,
        reference_frequency=np.array([180e6]) * units.Hz,
        spectral_type="spectral_index",
        spectral_index=np.array([-0.8]),
    )
    settings = section.FileSources.model_validate({"kind": "file", "path": path})
    found = []
    for convert in (lambda: None, sky.jansky_to_kelvin):
        convert()
        sky.write_skyh5(str(path), clobber=True)
        found.append(flux(make_foregrounds(settings, FREQUENCIES).sky))
    assert found[1] == pytest.approx(found[0], rel=1e-6)


def test_a_votable_needs_its_columns_named(tmp_path):
    with pytest.raises(ValidationError, match="required for VOTables"):
        section.FileSources(kind="file", path=tmp_path / "mine.vot")


def test_fetched_gleam_is_proved_and_then_held_to_its_hash(tmp_path, monkeypatch):
    def download(url, known_hash, fname, path, progressbar):
        assert "VIII/100" in url
        return str(write_gleam(Path(path) / fname))

    monkeypatch.setattr("pooch.retrieve", download)
    with pytest.raises(InputError, match="6 sources, GLEAM has 307455"):
        catalogue.fetch_gleam(tmp_path, progress=False)
    assert not (tmp_path / catalogue.GLEAM_FILE).exists()
    monkeypatch.setattr(catalogue, "GLEAM_SOURCES", 6)
    path = catalogue.fetch_gleam(tmp_path, progress=False)
    assert catalogue.fetch_gleam(tmp_path, progress=False) == path
    path.write_text(path.read_text().replace("J3", "J9"))
    with pytest.raises(InputError, match="has changed"):
        catalogue.fetch_gleam(tmp_path, progress=False)
    with pytest.raises(InputError, match="has changed"):
        make_foregrounds(section.GleamSources(kind="gleam", path=path), FREQUENCIES)


def test_failed_download_is_one_sentence(tmp_path, monkeypatch):
    def download(*args, **kwargs):
        raise requests.ConnectionError("no route to host")

    monkeypatch.setattr("pooch.retrieve", download)
    with pytest.raises(InputError, match=r"no connection to vizier.*sky\.foregrounds\.path"):
        catalogue.fetch_gleam(tmp_path)


@pytest.mark.parametrize("limit", ["3.5 Jy", "10 Jy"])
def test_a_higher_flux_limit_leaves_the_brighter_sources_as_they_are(synthetic, limit):
    """Also above 2 Jy, where real components replace synthetic sources, and above 4 Jy, where they do no more."""
    few = make_foregrounds(section.SyntheticSources(flux_limit=limit), FREQUENCIES).sky
    assert few.Ncomponents > 100
    np.testing.assert_array_equal(few.name, synthetic.sky.name[: few.Ncomponents])
    np.testing.assert_array_equal(few.skycoord.ra.deg, synthetic.sky.skycoord.ra.deg[: few.Ncomponents])
    np.testing.assert_array_equal(flux(few), flux(synthetic.sky)[: few.Ncomponents])
    assert flux(synthetic.sky)[few.Ncomponents] < float(limit.split()[0])


def test_catalogue_errors_have_the_size_that_is_asked_for(synthetic):
    """Of 20,000 sources: standard deviations are known to 0.5 %, so that 3 % is six of them."""
    few = section.SyntheticSources(flux_limit="100 mJy", count=20_000)
    true = make_foregrounds(few, FREQUENCIES).sky
    errors = section.CatalogueErrors(flux_scale=1.02, flux_scatter="5 %", position_scatter="10 arcsec")
    wrong = make_foregrounds(few.model_copy(update={"errors": errors}), FREQUENCIES)
    ratio = flux(wrong.sky) / flux(true)
    assert ratio.mean() == pytest.approx(1.02, abs=6 * 0.051 / np.sqrt(20_000))
    assert ratio.std() == pytest.approx(1.02 * 0.05, rel=0.03)
    east, north = true.skycoord.spherical_offsets_to(wrong.sky.skycoord)
    for offset in (east, north):
        assert offset.to_value("arcsec").std() == pytest.approx(10, rel=0.03)
    assert abs(np.corrcoef(east.deg, north.deg)[0, 1]) < 0.05
    assert "flux_scatter 0.05" in wrong.stand_in
    np.testing.assert_array_equal(true.name, wrong.sky.name)


def test_errors_of_a_source_do_not_depend_on_the_fainter_ones():
    errors = section.CatalogueErrors(flux_scatter="5 %", position_scatter="10 arcsec")
    many, few = (
        make_foregrounds(section.SyntheticSources(flux_limit="2 Jy", count=count, errors=errors), FREQUENCIES).sky
        for count in (500, 50)
    )
    np.testing.assert_array_equal(flux(few), flux(many)[:50])
    np.testing.assert_array_equal(few.skycoord.dec.deg, many.skycoord.dec.deg[:50])


def test_a_flux_scale_alone_moves_nothing():
    right, wrong = (
        make_foregrounds(section.SyntheticSources(flux_limit="5 Jy", errors=errors), FREQUENCIES).sky
        for errors in (section.CatalogueErrors(), section.CatalogueErrors(flux_scale=1.5))
    )
    np.testing.assert_allclose(flux(wrong), 1.5 * flux(right), rtol=1e-14)
    np.testing.assert_array_equal(wrong.skycoord.ra.deg, right.skycoord.ra.deg)


def test_spectral_indices_scatter_and_do_not_depend_on_the_flux_limit():
    """Ten thousands of sources: the standard deviation is known to 0.5 %."""
    many, few = (
        make_foregrounds(
            section.SyntheticSources(flux_limit=limit, spectrum="catalogue", index_scatter=0.2), FREQUENCIES
        ).sky
        for limit in ("0.5 Jy", "5 Jy")
    )
    made_up = np.char.startswith(many.name.astype(str), "synthetic")
    assert made_up.sum() > 50_000
    assert many.spectral_index[made_up].std() == pytest.approx(0.2, rel=0.03)
    assert many.spectral_index[made_up].mean() == pytest.approx(-0.8, abs=0.005)
    # As much as of the real ones, for which the description of the field gives this number.
    assert many.spectral_index[~made_up].std() == pytest.approx(0.2, abs=0.05)
    np.testing.assert_array_equal(few.spectral_index, many.spectral_index[: few.Ncomponents])
    with pytest.raises(ValidationError, match="has no effect with spectrum: flat"):
        section.SyntheticSources(index_scatter=0.2)


@pytest.mark.parametrize("spectrum", ["flat", "catalogue"])
def test_errors_of_indices_tilt_spectra_about_200_mhz(spectrum):
    right, wrong = (
        make_foregrounds(
            section.SyntheticSources(flux_limit="2 Jy", spectrum=spectrum, errors=errors), FREQUENCIES
        ).sky.at_frequencies([100e6, 200e6] * units.Hz, inplace=False)
        for errors in (section.CatalogueErrors(), section.CatalogueErrors(index_scatter=0.1))
    )
    ratio = (wrong.stokes[0] / right.stokes[0]).value
    np.testing.assert_allclose(ratio[1], 1, rtol=1e-12)
    assert np.log2(ratio[0]).std() == pytest.approx(0.1, rel=0.05)
