"""Draws of what differs from the nominal instrument, and the beams of antennas that are not as designed."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from mwa_pb import beam_full_EE, config
from pydantic import ValidationError
from pyuvdata import UVBeam, analytic_beam
from pyuvdata.analytic_beam import ShortDipoleBeam
from scipy.constants import speed_of_light
from scipy.stats import binom

from calstudy.base.errors import InputError
from calstudy.base.identity import identity
from calstudy.base.package_files import BEAM
from calstudy.instrument import as_built as section
from calstudy.instrument.antenna_beams import MisalignedBeam, make_beams
from calstudy.instrument.as_built import Misalignment, dipole_amplitudes, misalignments, position_offsets
from calstudy.instrument.beam_frequencies import MWA_GROUP
from calstudy.instrument.beam_models.formulas import AiryBeam, GaussianBeam
from calstudy.instrument.beams import ExactBeam, MwaTile, make_beam
from calstudy.instrument.dipoles import Tile, dipole_fields
from calstudy.instrument.interface import AntennaBeams
from calstudy.instrument.settings import InstrumentSettings, assigned_beams
from calstudy.instrument.telescope import make_template
from calstudy.simulate.patterns import power_pattern
from calstudy.simulate.source_sums import PairSums

FREQUENCY = np.array([183.04e6])
"""A tabulated one, in Hz: no interpolation takes part in comparisons."""


def instrument(**fields):
    return InstrumentSettings.model_validate(
        {"layout": {"kind": "hex", "side": 2}, "channels": {"first": "183.04 MHz", "count": 8}, **fields}
    )


def test_draws_have_their_scatter_and_scale_with_it():
    many = 20_000
    offsets = position_offsets(section.PositionErrors(scatter="2 cm"), many)
    # The error of a standard deviation is 1 / sqrt(2 n): 0.005 for one axis.
    assert offsets.std(axis=0) == pytest.approx(0.02, rel=0.02)
    np.testing.assert_allclose(10 * offsets, position_offsets(section.PositionErrors(scatter="20 cm"), many))
    np.testing.assert_array_equal(offsets[:5], position_offsets(section.PositionErrors(scatter="2 cm"), 5))
    assert not np.array_equal(offsets, position_offsets(section.PositionErrors(scatter="2 cm", seed=1), many))
    drawn = misalignments(section.BeamErrors(pointing_scatter="0.5 deg", width_scatter="2 %"), many)
    assert np.std([[one.east, one.north] for one in drawn], axis=0) == pytest.approx(np.radians(0.5), rel=0.02)
    assert np.std([one.width for one in drawn]) == pytest.approx(0.02, rel=0.02)
    assert {one.rotation for one in drawn} == {0.0}


def test_dipoles_die_as_often_as_they_should_and_stay_dead_at_higher_fractions():
    tiles = 2000
    few, more = (dipole_amplitudes(section.DipoleErrors(dead_fraction=fraction), tiles) for fraction in ("5 %", "15 %"))
    for amplitudes, fraction in ((few, 0.05), (more, 0.15)):
        low, high = binom.interval(1 - 1e-6, amplitudes.size, fraction)
        assert low <= (amplitudes == 0).sum() <= high
        assert set(np.unique(amplitudes)) == {0.0, 1.0}
    assert (more[few == 0] == 0).all()
    single = dipole_amplitudes(section.DipoleErrors(dead_tiles="40 %"), 36)
    assert sorted((single == 0).sum(axis=(1, 2))) == [0] * 22 + [1] * 14
    scattered = dipole_amplitudes(section.DipoleErrors(amplitude_scatter="10 %"), tiles)
    assert scattered.std() == pytest.approx(0.1, rel=0.02)


def test_listed_dipoles_are_dead():
    dead = {"a": {"antennas": [1, 3], "x": [0, 15]}, "b": {"antennas": [2], "y": [7]}}
    amplitudes = dipole_amplitudes(section.DipoleErrors.model_validate({"dead": dead}), 5)
    assert np.argwhere(amplitudes == 0).tolist() == [[1, 0, 0], [1, 0, 15], [2, 1, 7], [3, 0, 0], [3, 0, 15]]
    silent = section.DipoleErrors.model_validate({"dead": {"a": {"antennas": [2], "y": list(range(16))}}})
    with pytest.raises(InputError, match="all dipoles of feed y of antenna 2 are dead"):
        dipole_amplitudes(silent, 5)


def test_nothing_differs_by_default():
    assert section.AsBuilt().note is None
    changed = instrument(as_built={"positions": {"scatter": "1 cm"}, "beams": {"swapped": [3]}})
    assert changed.as_built.note == "as built: positions 1 cm, swapped feeds 1"
    assert changed.nominal() == instrument()
    assert changed.without_beams() == instrument()
    assert "as_built" not in identity(instrument())
    # A scatter of zero is no scatter: the first point of a sweep is the nominal instrument.
    assert identity(instrument(as_built={"positions": {"scatter": "0 cm"}})) == identity(instrument())
    np.testing.assert_array_equal(
        make_template(instrument(), as_built=True).telescope.antenna_positions,
        make_template(instrument()).telescope.antenna_positions,
    )


def test_only_arrays_of_several_beams_have_a_new_version():
    def revised(**fields):
        return "revised" in str(identity(instrument(**fields)))

    assert not revised(as_built={"positions": {"scatter": "1 cm"}})
    assert not revised(beam="short-dipole")
    assert revised(as_built={"dipoles": {"dead_tiles": "30 %"}})
    assert revised(as_built={"beams": {"swapped": [3]}})
    assert revised(antenna_beams={"other": {"antennas": [1], "beam": "gaussian"}})


def test_antennas_are_where_they_are_built():
    settings = instrument(as_built={"positions": {"scatter": "5 cm"}})
    built, nominal = make_template(settings, as_built=True), make_template(settings)
    moved = built.telescope.get_enu_antpos() - nominal.telescope.get_enu_antpos()
    np.testing.assert_allclose(moved, position_offsets(settings.as_built.positions, 7), atol=1e-8)
    assert make_template(settings.nominal()).telescope == nominal.telescope


@pytest.fixture(scope="module")
def beam_file(tmp_path_factory):
    """What the beam file has at three frequencies: to combine dipoles at one of them needs no other."""
    path = tmp_path_factory.mktemp("beam") / "three-frequencies.h5"
    with h5py.File(BEAM.find()) as whole, h5py.File(path, "w") as file:
        for name in whole:
            if not (match := MWA_GROUP.fullmatch(name)) or abs(float(match[1]) - FREQUENCY[0]) < 1.5e6:
                whole.copy(name, file)
    return path


@pytest.fixture(scope="module")
def tiles(beam_file):
    """An array with dead dipoles in one tile, and in the other feed of another, and all amplitudes scattered."""
    dead = {"broken": {"antennas": [4], "x": [0, 5]}, "other": {"antennas": [5], "y": [10]}}
    settings = instrument(
        as_built={"dipoles": {"dead": dead, "amplitude_scatter": "10 %"}},
        beam={"kind": "mwa-embedded-element", "interpolation": "nearest", "path": str(beam_file)},
    )
    return dipole_amplitudes(settings.as_built.dipoles, 7), make_beams(settings, 7)


@pytest.mark.chain
def test_tiles_with_dead_dipoles_are_those_of_mwa_pb(tiles, monkeypatch):
    """The observatory's own code, with phases of the other sign, as the file has them.

    Its azimuth is north through east, so its azimuth component has the other sign. It fails at the zenith with this
    numpy: that is left out, and beams are compared relative to a component in their first direction.
    """
    # Names that mwa_pb uses and that h5py and numpy have dropped.
    monkeypatch.setattr(h5py.Dataset, "value", property(lambda data: data[()]), raising=False)
    monkeypatch.setattr(np, "NaN", np.nan, raising=False)
    # Called for the zenith, in it or not.
    monkeypatch.setattr(beam_full_EE, "P1sin", lambda nmax, theta: (np.zeros(nmax**2 + 2 * nmax),) * 2)
    amplitudes, beams = tiles
    assert isinstance(beams, AntennaBeams)
    assert len(beams.beams) == 7
    degrees = np.array([[10, 7], [75, 23], [200, 48], [310, 61]])
    azimuth, zenith_angle = np.radians(degrees).T
    model = beam_full_EE.ApertureArray(config.h5file, FREQUENCY[0])
    for antenna in (4, 5):
        found = beams.beams[beams.index[antenna]].at(FREQUENCY).data_array[:, :, 0, degrees[:, 1], degrees[:, 0]]
        tile = beam_full_EE.Beam(model, np.zeros((2, 16)), amps=amplitudes[antenna])
        by_feed = tile.get_response((np.pi / 2 - azimuth) % (2 * np.pi), zenith_angle)
        expected = np.stack([-by_feed[:, 1], by_feed[:, 0]]).conj()
        # At this azimuth most of feed x is along the zenith angle, and of feed y along the azimuth.
        scales = [jones[[1, 0], [0, 1], :1] for jones in (found, expected)]
        np.testing.assert_allclose(found / scales[0], expected / scales[1], atol=1e-9)
    whole = make_beam(instrument().beam, instrument().channels).at(FREQUENCY).data_array
    assert np.abs(whole[:, 0, 0, degrees[:, 1], degrees[:, 0]] - found[:, 0]).max() > 0.01


def phases_across_the_zenith(beams, position):
    """Phase between visibilities of two sources, 5 degrees to both sides of the zenith along the dipole, (2 [x, y],).

    The first antenna is at the origin and has the first beam; the second is at `position` (m) and has the last.
    """
    patterns = [power_pattern(beam.at(FREQUENCY), FREQUENCY, ["x", "y"]) for beam in beams]
    delays = np.array([np.zeros(3), position]) / speed_of_light
    pair = np.array([0]), np.array([1])
    sums = PairSums(delays, pair, FREQUENCY, patterns, np.array([0, len(beams) - 1]), np.float64)

    def visibility(azimuth, feed):
        up, along = np.cos(np.radians(5)), np.sin(np.radians(5))
        source = np.array([along * np.cos(np.radians(azimuth)), along * np.sin(np.radians(azimuth)), up])
        # Fringes are relative to the centre, here the zenith.
        return sums.at(source[:, None], np.array([0.0, 0.0, 1.0]), np.ones((1, 1)))[0, feed, 0]

    return [
        np.angle(visibility(azimuth, feed) / visibility(azimuth + 180, feed)) for feed, azimuth in ((0, 0), (1, 90))
    ]


def test_a_dipole_is_where_its_number_says(beam_file):
    """A tile with one live dipole has the fringes of a tile that stands at the place of the dipole.

    Neighbours along a dipole's axis hardly move the centre of its field; those beside it move it a lot.
    """
    fields = dipole_fields(beam_file, instrument().channels.band, "nearest")
    for dipole in range(16):
        row, column = divmod(dipole, 4)
        place = np.array([1.1 * column - 1.65, 1.65 - 1.1 * row, 0.0])
        alone = Tile(fields, np.tile(np.arange(16) == dipole, (2, 1)))
        found = phases_across_the_zenith([fields.whole, alone], np.zeros(3))
        assert found == pytest.approx(phases_across_the_zenith([fields.whole], place), rel=0.07)


def test_tiles_have_no_phase_at_the_zenith(tiles):
    """The field at the zenith along the feed, in the column at azimuth 0, where north is along the azimuth."""
    for beam in tiles[1].beams:
        zenith = beam.at(FREQUENCY).data_array[:, :, 0, 0, 0]
        along = zenith[[1, 0], [0, 1]]
        assert along.real == pytest.approx(1, abs=1e-3)
        assert along.imag == pytest.approx(0, abs=1e-12)


def test_alike_tiles_share_a_beam():
    dead = {"dead": {"a": {"antennas": [1, 2], "x": [3]}}}
    assigned = assigned_beams(instrument(as_built={"dipoles": dead}), 7)
    assert len(set(assigned)) == 2
    assert assigned[1] == assigned[2] != assigned[0]
    assert len(set(assigned_beams(instrument(as_built={"beams": {"width_scatter": "1 %"}}), 7))) == 7
    assert len(set(assigned_beams(instrument(), 7))) == 1


EVERYTHING = Misalignment(east=0.02, north=-0.03, rotation=0.1, width=1.04, swapped=True)


def directions():
    azimuth, zenith_angle = np.meshgrid(np.radians(np.arange(0, 360, 20.0)), np.radians([0.0, 1, 5, 20, 40, 70]))
    return azimuth.ravel(), zenith_angle.ravel()


def evaluate(beam):
    azimuth, zenith_angle = directions()
    return beam.at(FREQUENCY).efield_eval(az_array=azimuth, za_array=zenith_angle, freq_array=FREQUENCY)[:, :, 0]


def test_a_turned_dipole_is_a_dipole_along_the_turned_axis():
    """The far field of a short dipole is the part of its axis that is perpendicular to the line of sight."""
    azimuth, zenith_angle = directions()
    tilt, turn = np.radians(7), np.radians(20)
    found = evaluate(MisalignedBeam(ExactBeam(ShortDipoleBeam(), "", None), Misalignment(east=tilt, rotation=turn)))
    # Turned about the vertical, then tilted about north: the axis of feed x, in east, north, up.
    axis = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn), -np.cos(turn) * np.sin(tilt)])
    along_azimuth = np.array([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)])
    cosine = np.cos(zenith_angle)
    along_zenith_angle = np.array([cosine * np.cos(azimuth), cosine * np.sin(azimuth), -np.sin(zenith_angle)])
    np.testing.assert_allclose(found[:, 0], [axis @ along_azimuth, axis @ along_zenith_angle], atol=1e-12)


class DipoleTable:
    """A short dipole, tabulated every degree."""

    name, stand_in = "dipole", None

    def at(self, frequencies):
        axes = {"axis1_array": np.radians(np.arange(360.0)), "axis2_array": np.radians(np.arange(91.0))}
        table = ShortDipoleBeam().to_uvbeam(freq_array=frequencies, **axes)
        table.peak_normalize()
        return table


@pytest.mark.parametrize(
    "nominal", [ExactBeam(ShortDipoleBeam(), "dipole", None), DipoleTable()], ids=["exact", "table"]
)
def test_a_swapped_antenna_has_the_other_dipole_on_each_feed(nominal):
    """The far field of a dipole along north on feed x, and of one along east on feed y."""
    azimuth, zenith_angle = np.radians(np.array([[0, 10], [40, 5], [135, 30], [250, 60], [300, 80]], dtype=float)).T
    cosine = np.cos(zenith_angle)
    along_north = np.array([np.cos(azimuth), cosine * np.sin(azimuth)])
    along_east = np.array([-np.sin(azimuth), cosine * np.cos(azimuth)])
    for swapped, expected in ((True, [along_north, along_east]), (False, [along_east, along_north])):
        beam = MisalignedBeam(nominal, Misalignment(swapped=swapped)).at(FREQUENCY)
        if isinstance(beam, UVBeam):
            rows, columns = np.rint(np.degrees([zenith_angle, azimuth])).astype(int)
            found = beam.data_array[:, :, 0, rows, columns]
        else:
            found = beam.efield_eval(az_array=azimuth, za_array=zenith_angle, freq_array=FREQUENCY)[:, :, 0]
        # Directions on the grid of the table, where splines have its values but for rounding.
        np.testing.assert_allclose(np.moveaxis(found, 1, 0), expected, atol=1e-10)


def test_a_formula_without_polarization_has_its_field_along_the_feed():
    """Its response with a real dipole near the zenith is one at all azimuths; pyuvdata's goes through all values."""
    azimuth, zenith_angle = np.radians(np.arange(0, 360, 15.0)), np.full(24, np.radians(0.1))
    points = {"az_array": azimuth, "za_array": zenith_angle, "freq_array": FREQUENCY}
    dipole = ShortDipoleBeam().efield_eval(**points)
    for formula in (GaussianBeam(kind="gaussian"), AiryBeam(kind="airy")):
        found = make_beam(formula).at(FREQUENCY).efield_eval(**points)
        np.testing.assert_allclose((found * dipole.conj()).sum(axis=0), 1, atol=1e-3)
        # The other feed is across.
        np.testing.assert_allclose((found * dipole[:, ::-1].conj()).sum(axis=0), 0, atol=1e-3)
    plain = analytic_beam.AiryBeam(diameter=4.0).efield_eval(**points)
    assert np.ptp((plain * dipole.conj()).sum(axis=0).real) > 1.9


def test_a_formula_is_moved_as_a_whole():
    """The offset from the antenna's own axis gives the field, and a rotation of the antenna turns it."""
    azimuth, zenith_angle = directions()
    airy = ExactBeam(analytic_beam.AiryBeam(diameter=14.0), "", None)
    moved = MisalignedBeam(airy, Misalignment(east=0.03, north=0.04, rotation=0.3, width=1.1))
    axis = np.array([np.sin(0.05) * 0.6, np.sin(0.05) * 0.8, np.cos(0.05)])
    sine = np.sin(zenith_angle)
    offset = np.arccos(axis @ [sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith_angle)])
    nominal = analytic_beam.AiryBeam(diameter=14.0).efield_eval(
        az_array=azimuth, za_array=np.minimum(offset / 1.1, np.pi / 2), freq_array=FREQUENCY
    )
    power = (np.abs(evaluate(moved)) ** 2).sum(axis=0)
    np.testing.assert_allclose(power, (np.abs(nominal[:, :, 0]) ** 2).sum(axis=0), atol=1e-9)
    turned = evaluate(MisalignedBeam(airy, Misalignment(rotation=0.3)))
    along, across = (turned * evaluate(airy)).sum(axis=0), (turned * evaluate(airy)[:, ::-1]).sum(axis=0)
    total = (evaluate(airy) ** 2).sum(axis=0)
    np.testing.assert_allclose(along, np.cos(0.3) * total, atol=1e-9)
    np.testing.assert_allclose(across, np.outer([np.sin(0.3), -np.sin(0.3)], np.ones(len(azimuth))) * total, atol=1e-9)


def test_tables_are_turned_like_formulas():
    """A tile tabulated every degree, then misaligned, against the misaligned formula on the same grid."""
    formula = MisalignedBeam(ExactBeam(MwaTile(), "tile", None), EVERYTHING)
    grid = {"axis1_array": np.radians(np.arange(360.0)), "axis2_array": np.radians(np.arange(91.0))}

    class Table:
        name, stand_in = "tile", None

        def at(self, frequencies):
            table = MwaTile().to_uvbeam(freq_array=frequencies, **grid)
            table.peak_normalize()
            return table

    found = MisalignedBeam(Table(), EVERYTHING).at(FREQUENCY).data_array[:, :, 0]
    azimuth, zenith_angle = np.meshgrid(*grid.values())
    expected = formula.at(FREQUENCY).efield_eval(
        az_array=azimuth.ravel(), za_array=zenith_angle.ravel(), freq_array=FREQUENCY
    )
    above = zenith_angle < np.radians(85)
    errors = np.abs(found - expected.reshape(found.shape))[:, :, above]
    # Bicubic splines of a beam of 20 degrees on a grid of one degree.
    assert errors.max() < 1e-5
    assert np.abs(evaluate(formula) - evaluate(ExactBeam(MwaTile(), "tile", None))).max() > 0.1


def test_no_misalignment_changes_nothing():
    for nominal in (MwaTile(), analytic_beam.AiryBeam(diameter=14.0)):
        same = evaluate(MisalignedBeam(ExactBeam(nominal, "", None), Misalignment()))
        np.testing.assert_allclose(same, evaluate(ExactBeam(nominal, "", None)), atol=1e-12)


@pytest.mark.parametrize(
    "fields",
    [
        {"dipoles": {"dead_fraction": "100 %"}},
        {"dipoles": {"dead_fraction": "15 deg"}},
        {"dipoles": {"dead": {"a": {"antennas": [0], "x": [16]}}}},
        {"positions": {"scatter": 0.02}},
        {"beams": {"swapped": [1, 1]}},
    ],
)
def test_bad_values_are_refused(fields):
    with pytest.raises(ValidationError):
        instrument(as_built=fields)
