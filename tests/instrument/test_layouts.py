"""Layouts against published facts about the array, and grouping against invariances."""

from __future__ import annotations

import csv
import itertools
from importlib.resources import files

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from pyuvdata.utils import ECEF_from_ENU, ENU_from_ECEF, LatLonAlt_from_XYZ

from calstudy.base.errors import InputError
from calstudy.instrument.array_layouts.csv import CsvLayout
from calstudy.instrument.array_layouts.geometric import GOLOMB_MARKS, HexLayout, LinearLayout, RectangularLayout
from calstudy.instrument.array_layouts.observatories import HeraLayout, MwaLayout
from calstudy.instrument.layouts import SITES, east_north_up, make_array, make_layout, redundant_groups
from calstudy.instrument.settings import InstrumentSettings


def vectors_of(layout):
    first, second = np.triu_indices(len(layout.numbers), 1)
    return layout.enu[second] - layout.enu[first]


# Lengths and groups measured on the observatory's metafits of 2016 to 2018.
@pytest.mark.parametrize(
    ("kind", "shortest", "longest", "groups", "singletons", "largest"),
    [
        ("mwa-compact-minredundant", 7.72, 176.15, 614, 598, 2),
        ("mwa-compact-hex-east", 13.97, 84.00, 63, 3, 28),
        ("mwa-compact-hex-south", 13.96, 84.01, 63, 3, 28),
    ],
)
def test_mwa_subarrays_have_the_known_baselines(kind, shortest, longest, groups, singletons, largest):
    vectors = vectors_of(make_layout(MwaLayout(kind=kind)))
    length = np.linalg.norm(vectors, axis=1)
    assert len(vectors) == 630
    assert length.min() == pytest.approx(shortest, abs=0.006)
    assert length.max() == pytest.approx(longest, abs=0.006)
    size = np.bincount(redundant_groups(vectors, 1.0).index)
    assert (len(size), (size == 1).sum(), size.max()) == (groups, singletons, largest)


def test_known_tile_positions():
    """Two tiles of each part against their surveyed offsets from the array centre (observatory metafits, to 1 mm)."""
    layout = make_layout(MwaLayout(kind="mwa-compact"))
    place = dict(zip(layout.names, layout.enu, strict=True))
    assert place["Tile011"][:2] == pytest.approx([-149.785, 265.814], abs=1e-3)
    assert place["Tile012"][:2] == pytest.approx([-95.365, 270.188], abs=1e-3)
    assert place["HexE01"][:2] == pytest.approx([86.373, 284.121], abs=1e-3)
    assert place["HexS36"][:2] == pytest.approx([32.013, 85.713], abs=1e-3)


@pytest.mark.parametrize("site", SITES)
def test_local_components_are_those_of_pyuvdata(site):
    place = SITES[site]
    centre = np.array([axis.to_value("m") for axis in place.location.geocentric])
    vectors = np.random.default_rng(1).normal(scale=1e3, size=(20, 3))
    expected = ENU_from_ECEF(centre + vectors, center_loc=place.location)
    # Of coordinates of the order of the Earth's radius, which pyuvdata subtracts.
    assert east_north_up(vectors, place) == pytest.approx(expected, abs=1e-8)


def test_subarrays_are_parts_of_the_whole_array():
    whole = make_layout(MwaLayout(kind="mwa-compact"))
    assert len(whole.numbers) == 128
    assert whole.enu[:, 2].mean() == pytest.approx(0, abs=1e-9)
    assert np.abs(whole.enu[:, 2]).max() < 4
    for kind in ("mwa-compact-minredundant", "mwa-compact-hex-east", "mwa-compact-hex-south"):
        part = make_layout(MwaLayout(kind=kind))
        np.testing.assert_array_equal(part.enu, whole.enu[part.numbers])
        assert part.names == tuple(whole.names[number] for number in part.numbers)


def test_hexagon_is_redundant_and_complete():
    layout = make_layout(HexLayout(kind="hex", side=4, spacing="14 m"))
    assert len(layout.numbers) == 37
    groups = redundant_groups(vectors_of(layout), 0.01)
    # A hexagon of side n has as many distinct separations as the half of the hexagon of side 2n - 1 without its centre.
    assert groups.index.max() + 1 == (3 * 7 * 6 + 1 - 1) // 2
    assert np.linalg.norm(vectors_of(layout), axis=1).min() == pytest.approx(14.0)


def test_longest_baseline_of_a_rectangular_array_is_the_one_asked_for():
    for count in (9, 16, 20, 64, 67):
        layout = make_layout(RectangularLayout(kind="rectangular", count=count, spacing="2 m", max_baseline="100 m"))
        length = np.linalg.norm(vectors_of(layout), axis=1)
        assert length.max() == pytest.approx(100.0)
        assert length.min() == pytest.approx(2.0)


@pytest.mark.parametrize("count", GOLOMB_MARKS)
def test_golomb_rulers_have_no_repeated_distance(count):
    marks = GOLOMB_MARKS[count]
    assert len(marks) == count
    distances = [second - first for first, second in itertools.combinations(marks, 2)]
    assert len(set(distances)) == len(distances)


def test_linear_array_groups_by_separation():
    layout = make_layout(LinearLayout(kind="linear", count=10, spacing="14 m"))
    size = np.bincount(redundant_groups(vectors_of(layout), 0.1).index)
    assert sorted(size) == list(range(1, 10))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_grouping_ignores_the_direction_and_order_of_baselines(seed):
    generator = np.random.default_rng(seed)
    vectors = vectors_of(make_layout(HexLayout(kind="hex", side=2)))
    reference = redundant_groups(vectors, 0.1)
    flipped = generator.integers(0, 2, len(vectors)).astype(bool)
    order = generator.permutation(len(vectors))
    groups = redundant_groups((np.where(flipped, -1, 1)[:, None] * vectors)[order], 0.1)
    together = reference.index[order][:, None] == reference.index[order]
    np.testing.assert_array_equal(groups.index[:, None] == groups.index, together)
    oriented = np.where(groups.conjugated, -1, 1)[:, None] * (np.where(flipped, -1, 1)[:, None] * vectors)[order]
    apart = np.linalg.norm(oriented[:, None] - oriented, axis=-1)
    assert apart[together].max() < 0.1


def test_groups_are_numbered_by_their_first_baseline():
    vectors = np.array([[14.0, 0, 0], [0, 7.0, 0], [-14.0, 0, 0], [0, 7.0, 0.01]])
    groups = redundant_groups(vectors, 0.1)
    assert groups.index.tolist() == [0, 1, 0, 1]
    assert groups.conjugated.tolist() == [False, False, True, False]


def test_csv_layout(tmp_path):
    path = tmp_path / "array.csv"
    path.write_text("name,number,east_m,north_m,up_m\na,7,0,0,0\nb,3,10,2.5,-1\n")
    layout = make_layout(CsvLayout(kind="csv", path=path))
    assert layout.names == ("a", "b")
    assert layout.numbers.tolist() == [7, 3]
    np.testing.assert_array_equal(layout.enu, [[0, 0, 0], [10, 2.5, -1]])


@pytest.mark.parametrize(
    "text",
    [
        # The layout format of pyuvsim, and what spreadsheets write.
        "# core\nName  Number  BeamID  E  N  U\na  7  0  0  0  0\n# broken\nb  3  0  10  2.5  -1\n",
        "Name;Number;East;North;Up\na;7;0;0;0\nb;3;10;2.5;-1\n",
        "name,number,east_m,north_m,up_m\na,7.0,0,0,0\nb,3e0,10,2.5,-1\n",
        # Local positions count, columns without a use may have no name, and cells may be empty.
        "name,number,east_m,north_m,up_m,lat,lon,,\na,7,0,0,0,1,2,,\nb,3,10,2.5,-1,1,2,,\n",
        "name\tnumber\teast_m\tnorth_m\tup_m\tnote\na\t7\t0\t0\t0\t\nb\t3\t10\t2.5\t-1\t\n",
        "\ufeffname\tnumber\teast_m\tnorth_m\tup_m\r\na\t7\t0\t0\t0\r\n\r\nb\t3\t10\t2.5\t-1\r\n",
    ],
)
def test_tables_of_other_programs_are_read(tmp_path, text):
    path = tmp_path / "array.csv"
    path.write_text(text, encoding="utf-8", newline="")
    layout = make_layout(CsvLayout(kind="csv", path=path))
    assert layout.names == ("a", "b")
    assert layout.numbers.tolist() == [7, 3]
    np.testing.assert_array_equal(layout.enu, [[0, 0, 0], [10, 2.5, -1]])


def test_latitudes_and_longitudes_become_distances(tmp_path):
    enu = make_layout(HeraLayout(kind="hera-19")).enu
    place = SITES["hera"]
    # An independent conversion, by pyuvdata.
    ecef = ECEF_from_ENU(enu, center_loc=place.location)
    latitude, longitude, height = LatLonAlt_from_XYZ(ecef)
    rows = zip(np.degrees(latitude), np.degrees(longitude), height, strict=True)
    lines = [f"{lat:.10f}, {lon:.10f}, {up:.4f}" for lat, lon, up in rows]
    path = tmp_path / "array.csv"
    path.write_text("\n".join(["lat, lon, altitude", *lines]), encoding="utf-8")
    found = make_layout(CsvLayout(kind="csv", path=path)).enu
    # Positions are about the mean; ten digits of a degree are a hundredth of a millimetre.
    np.testing.assert_allclose(found - found.mean(axis=0), enu - enu.mean(axis=0), atol=2e-3)


def test_positions_in_degrees_are_compared_with_the_site(tmp_path):
    path = tmp_path / "array.csv"
    path.write_text("lat,lon,alt\n-30.0,179.9999,0\n-30.0,-179.9999,0\n")
    at = {"layout": {"kind": "csv", "path": path}, "beam": "airy"}

    def array(latitude, longitude):
        place = {"latitude": f"{latitude} deg", "longitude": f"{longitude} deg"}
        return make_array(InstrumentSettings.model_validate({**at, "location": place}))

    # Both sides of the meridian of 180 degrees.
    assert np.ptp(array(-30.3, 180.0).enu[:, 0]) == pytest.approx(19.3, abs=0.1)
    assert array(-30.3, -179.5).place.latitude == -30.3
    with pytest.raises(InputError, match=r"instrument.location: is at -26.00, 116.00 deg, and array at -30.00"):
        array(-26, 116)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("latitude,longitude\n-30,21\n-30,21\n", "height_m"),
        ("latitude,longitude,height_m\n-30,21,0\n30,21,0\n", "one degree of each other; line [23] is the farthest"),
        ("number,east_m,north_m,up_m\n1,0,0,0\n3000000000,1,0,0\n", "antenna number 3000000000 .* exceeds"),
        ("e,east_m,n,u\n0,0,0,0\n1,1,1,1\n", "twice"),
        ("# HERA\ne n u\n0 0 0\n\n1 1\n", "line 5 of .* cells"),
        ("east_m,north_m,z\n0,0,0\n1,1,0\n", "missing: up_m; found: 2 rows of east_m, north_m, z"),
        ("number,east_m,north_m,up_m\n", "found: 0 rows of number, east_m, north_m, up_m"),
        ("number,east_m,north_m,up_m\n1.5,0,0,0\n2,1,0,0\n", "line 2 of .* not a number .*'1.5'"),
        ("east_m,north_m,up_m\n0,0,0\n1,x,0\n", "line 3 of .* not a number .*'x'"),
        ("east_m,north_m,up_m\n0,0,0\n", "two rows"),
        ("number,east_m,north_m,up_m\n1,0,0,0\n1,1,0,0\n", "unique; see '1'"),
        ("east_m,north_m,up_m\n0,0,0\n1,nan,0\n", "line 3 of .* finite"),
        # Kilometres, and geocentric coordinates of HERA.
        ("east_m,north_m,up_m\n0,0,0\n0.014,0,0\n0,0.014,0\n", "in metres"),
        ("east_m,north_m,up_m\n5109325,2006835,-3238948\n5109339,2006835,-3238948\n", "centre of the Earth"),
    ],
)
def test_bad_csv_is_one_sentence(tmp_path, text, complaint):
    path = tmp_path / "array.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=complaint):
        make_layout(CsvLayout(kind="csv", path=path))


def test_missing_csv(tmp_path):
    with pytest.raises(InputError, match="there is no file"):
        make_layout(CsvLayout(kind="csv", path=tmp_path / "none.csv"))


def test_impossible_layouts_are_refused():
    with pytest.raises(ValidationError, match="more than the 36 antennas"):
        MwaLayout(kind="mwa-compact-hex-east", count=37)
    with pytest.raises(ValidationError, match="must exceed the length of a row"):
        RectangularLayout(kind="rectangular", spacing="20 m", max_baseline="100 m")


@pytest.mark.parametrize("kind", HeraLayout.sizes)
def test_hera_arrays_have_their_antennas_at_their_spacing(kind):
    layout = make_layout(HeraLayout(kind=kind))
    assert len(layout.numbers) == len(set(layout.names)) == HeraLayout.sizes[kind]
    assert np.linalg.norm(vectors_of(layout), axis=1).min() == pytest.approx(14.6)
    assert layout.location.lat.deg == pytest.approx(-30.7215, abs=1e-3)


def test_hera_is_where_it_was_surveyed():
    """Every antenna of the design against the surveyed position of the antenna with its number, in pyuvdata's table.

    The survey's grid is turned against east by the convergence of its map projection, and lengths on that map are
    longer by its scale factor; both are fitted. What is left are the millimetres to which the table was made.
    """
    with (files("pyuvdata") / "data" / "hera_ant_pos.csv").open() as table:
        rows = sorted(csv.DictReader(table), key=lambda row: int(row["number"]))
    site = SITES["hera"].location
    centre = np.array([axis.to_value("m") for axis in site.geocentric])
    surveyed = ENU_from_ECEF(centre + [[float(row[axis]) for axis in "xyz"] for row in rows], center_loc=site)
    surveyed, design = (
        (enu - enu.mean(axis=0))[:, :2] @ [1, 1j] for enu in (surveyed, make_layout(HeraLayout(kind="hera-350")).enu)
    )
    factor = np.vdot(design, surveyed) / np.vdot(design, design)
    assert abs(abs(factor) - 1) < 1e-3
    assert abs(np.angle(factor, deg=True)) < 0.3
    assert np.abs(surveyed - factor * design).max() < 0.01


def test_parts_of_hera():
    whole = vectors_of(make_layout(HeraLayout(kind="hera-350")))
    for kind in ("hera-128", "hera-320"):
        part = make_layout(HeraLayout(kind=kind))
        first, second = np.triu_indices(len(part.numbers), 1)
        places = first * 350 - first * (first + 1) // 2 + second - first - 1
        np.testing.assert_allclose(vectors_of(part), whole[places], atol=1e-9)
    for kind, side in (("hera-19", 3), ("hera-37", 4)):
        hexagon = make_layout(HexLayout(kind="hex", side=side, spacing="14.6 m"))
        np.testing.assert_array_equal(make_layout(HeraLayout(kind=kind)).enu, hexagon.enu)


def test_mwa_configurations_are_the_parts_of_the_whole_array():
    """Phase II extended is Phase I without its core, and 56 tiles at up to 5.3 km (Wayth et al. 2018)."""
    compact, extended, phase1 = (
        make_layout(MwaLayout(kind=kind)) for kind in ("mwa-compact", "mwa-extended", "mwa-phase1")
    )
    assert len(extended.names) == len(phase1.names) == 128
    assert not set(extended.names) & set(compact.names)
    assert len(set(extended.names) & set(phase1.names)) == 72
    assert set(phase1.names) == {name for name in (*compact.names, *extended.names) if name.startswith("Tile")}
    assert 5.2e3 < np.linalg.norm(vectors_of(extended), axis=1).max() < 5.4e3
    place, known = (dict(zip(layout.names, layout.enu, strict=True)) for layout in (phase1, compact))
    # Horizontal offsets do not depend on the configuration; heights are about its mean.
    assert place["Tile011"][:2] == pytest.approx(known["Tile011"][:2], abs=1e-6)
