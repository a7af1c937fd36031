"""Arrays whose antennas are not as designed, simulated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from pyuvdata.analytic_beam import UniformBeam
from simulation_cases import FAST_ENGINES, local_coordinates, observe, point_sky, random_sky, relative_error

from calstudy.base.errors import ExperimentError
from calstudy.base.visibilities import antenna_indices, baseline_vectors, to_cube
from calstudy.claims.paper import stand_ins
from calstudy.experiment.files import dump, override, validate
from calstudy.instrument.antenna_beams import MisalignedBeam
from calstudy.instrument.as_built import Misalignment, position_offsets
from calstudy.instrument.beams import ExactBeam
from calstudy.instrument.interface import AntennaBeams
from calstudy.instrument.layouts import make_layout
from calstudy.papers.calamity2022 import Calamity2022
from calstudy.products import corruption, simulation, sky_model
from calstudy.products.files import read_visibilities
from calstudy.products.graph import Graph
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.simulate.engines.other_packages import PyuvsimEngine

SMALL = {
    "name": "built",
    "instrument": {
        "layout": {"kind": "hex", "side": 2},
        "beam": "gaussian",
        "channels": {"width": "400 kHz", "count": 32},
        "times": {"count": 2},
    },
    "sky": {"foregrounds": {"kind": "g4jy-and-counts", "count": 50}, "eor": {"nside": 16}},
    "simulation": {"chunks": 1},
}
SCATTERED = {"positions": {"scatter": "20 cm"}}


def experiment(folder: Path, **instrument):
    return validate({**SMALL, "instrument": {**SMALL["instrument"], **instrument}}, folder)


def simulated(experiment, folder: Path):
    """Return the foreground visibilities as their product has them."""
    task = simulation.foregrounds(Graph(experiment))
    (piece,) = task.pieces.values()
    chunk, whole = folder / "chunk", folder / "whole"
    chunk.mkdir(parents=True)
    whole.mkdir()
    piece.make(chunk)
    notes = task.given({"chunk000": chunk}).make(whole)
    return read_visibilities(whole / "visibilities.uvh5"), notes


def test_scattered_positions_are_those_of_a_csv_of_the_shifted_ones(tmp_path: Path):
    """The visibilities are the same, and the data say the nominal positions."""
    built = experiment(tmp_path, as_built=SCATTERED)
    layout = make_layout(built.instrument.layout)
    shifted = layout.enu + position_offsets(built.instrument.as_built.positions, 7)
    rows = "\n".join(",".join(repr(float(value)) for value in row) for row in shifted)
    (tmp_path / "shifted.csv").write_text(f"east_m,north_m,up_m\n{rows}\n")
    found, notes = simulated(built, tmp_path / "built")
    expected, _ = simulated(
        experiment(tmp_path, layout={"kind": "csv", "path": "shifted.csv"}, location="mwa"), tmp_path / "csv"
    )
    assert relative_error(to_cube(found), to_cube(expected)) < 1e-9
    nominal, _ = simulated(experiment(tmp_path), tmp_path / "nominal")
    np.testing.assert_allclose(baseline_vectors(found), baseline_vectors(nominal), atol=1e-9)
    # 20 cm are an eighth of a wavelength: far from nothing.
    assert relative_error(to_cube(found), to_cube(nominal)) > 0.1
    assert "as built: positions 20 cm" in notes["stand_ins"]


@pytest.fixture(scope="module")
def misaligned(gaussian_beam, dipole_beam):
    """An antenna as designed, and others that are tilted, swapped, or tilted with an unpolarized beam."""
    tilted = MisalignedBeam(dipole_beam, Misalignment(east=0.1, north=-0.2, rotation=0.3, width=0.9))
    swapped = MisalignedBeam(dipole_beam, Misalignment(north=0.05, swapped=True))
    unpolarized = MisalignedBeam(gaussian_beam, Misalignment(north=0.05))
    return AntennaBeams((dipole_beam, tilted, swapped, unpolarized), np.array([0, 1, 0, 2, 3]))


@pytest.mark.parametrize("engine", FAST_ENGINES)
@pytest.mark.chain
def test_engines_agree_on_misaligned_antennas(engine, misaligned):
    template = observe(count=5, channels=2, times=1)
    sky = random_sky(template, count=40)
    expected = PyuvsimEngine().simulate(sky, misaligned, template)
    assert engine.refusal(sky, misaligned, template) is None
    assert relative_error(engine.simulate(sky, misaligned, template), expected) < 1e-10
    nominal = PyuvsimEngine().simulate(sky, misaligned.beams[0], template)
    assert relative_error(expected, nominal) > 0.1


@pytest.mark.parametrize("engine", [DenseEngine(), PyuvsimEngine()], ids=lambda engine: engine.label)
def test_a_swapped_dipole_correlates_with_the_other_dipole(engine, dipole_beam):
    """One source of 1 Jy: without its fringe, xx is half the product of the far fields on the feeds x of two antennas.

    E = (-sin a, cos z cos a) is the field of a dipole along east at the azimuth a and zenith angle z, and (cos a,
    cos z sin a) of one along north.
    """
    swapped = MisalignedBeam(dipole_beam, Misalignment(swapped=True))
    beams = AntennaBeams((dipole_beam, swapped), np.array([0, 0, 1, 1]))
    template = observe(count=4, channels=1, times=1)
    azimuth, zenith_angle = np.radians(65.0), np.radians(40.0)
    # Of astropy north through east, of beams east through north.
    sky = point_sky(local_coordinates(template, np.pi / 2 - zenith_angle, np.pi / 2 - azimuth), [1.0])
    cosine = np.cos(zenith_angle)
    east = np.array([-np.sin(azimuth), cosine * np.cos(azimuth)])
    north = np.array([np.cos(azimuth), cosine * np.sin(azimuth)])
    uniform = ExactBeam(UniformBeam(), "uniform", None)
    # A uniform beam has half the flux density in every visibility, with the same fringe.
    fringes = 2 * engine.simulate(sky, uniform, template)
    found = (engine.simulate(sky, beams, template) / fringes)[0, :, 0]
    pairs = [tuple(pair) for pair in antenna_indices(template)]
    for pair, xx, yy in (
        ((0, 1), east @ east, north @ north),
        ((0, 2), east @ north, north @ east),
        ((1, 3), east @ north, north @ east),
        ((2, 3), north @ north, east @ east),
    ):
        # Only rounding: the direction goes through ICRS and back, in double precision.
        np.testing.assert_allclose(found[pairs.index(pair)], [xx / 2, yy / 2], atol=1e-9)


def test_swapped_feeds_of_a_formula_see_across(gaussian_beam):
    """Near the zenith, fields of the other feed are across: the visibilities of one swapped antenna nearly vanish."""
    template = observe(count=3, channels=1, times=1)
    sky = point_sky(local_coordinates(template, np.radians(89.0), np.radians(20.0)), [1.0])
    swapped = MisalignedBeam(gaussian_beam, Misalignment(swapped=True))
    beams = AntennaBeams((gaussian_beam, swapped), np.array([0, 0, 1]))
    found, alike = (np.abs(DenseEngine().simulate(sky, beam, template))[0, :, 0] for beam in (beams, gaussian_beam))
    one_swapped = (beams.index[antenna_indices(template)].sum(axis=1) == 1)[:, None]
    np.testing.assert_allclose(found, np.where(one_swapped, 0, alike), atol=1e-6)


def test_a_misaligned_table_goes_to_all_engines(embedded_beam):
    template = observe(count=3, channels=1, times=1)
    sky = random_sky(template, count=30)
    turned = MisalignedBeam(embedded_beam, Misalignment(east=0.02, rotation=0.05, width=1.02))
    beams = AntennaBeams((embedded_beam, turned), np.array([0, 1, 1]))
    expected = PyuvsimEngine().simulate(sky, beams, template)
    assert relative_error(DenseEngine().simulate(sky, beams, template), expected) < 1e-10


def test_what_reads_the_nominal_instrument_keeps_its_key(tmp_path: Path):
    plain, built = experiment(tmp_path), experiment(tmp_path, as_built=SCATTERED)
    none = experiment(tmp_path, as_built={"positions": {"scatter": "0 cm"}, "dipoles": {}, "beams": {}})
    keys = [simulation.foregrounds(Graph(one)).key for one in (plain, built, none)]
    assert keys[0] == keys[2] != keys[1]
    assert corruption.gains(Graph(built)).key == corruption.gains(Graph(plain)).key
    assert (
        simulation.foregrounds(Graph(built.model_copy(update={"instrument": built.instrument.nominal()}))).key
        == keys[0]
    )


def test_results_say_how_it_is_built(tmp_path: Path):
    built = experiment(tmp_path, as_built={**SCATTERED, "beams": {"width_scatter": "2 %", "swapped": [3]}})
    assert "as built: positions 20 cm, beam widths 2 %, swapped feeds 1" in stand_ins(built)
    assert not any("as built" in note for note in stand_ins(experiment(tmp_path)))
    papers = validate(override(built.model_dump(mode="json"), "calibration.weights", "flags"), tmp_path)
    assert "instrument.as_built" in Calamity2022().refusal("redundant", papers)
    assert validate(yaml.safe_load(dump(built)), tmp_path) == built


def test_plans_count_distinct_beams(tmp_path: Path):
    layout = {"kind": "hex", "side": 4}
    one, three, all_different = (
        simulation.foregrounds(Graph(experiment(tmp_path, layout=layout, as_built=as_built))).pieces["chunk000"].cost
        for as_built in ({}, {"beams": {"swapped": [3, 5]}}, {"beams": {"width_scatter": "1 %"}})
    )
    assert one.seconds < three.seconds < all_different.seconds
    assert one.memory < all_different.memory


@pytest.mark.parametrize(
    ("as_built", "told"),
    [
        ({"dipoles": {"dead_fraction": "15 %"}}, r"as_built\.dipoles: the beam 'gaussian' has no dipoles"),
        ({"beams": {"swapped": [7]}}, r"as_built\.beams\.swapped: names antenna 7, but the layout has 7 antennas"),
        ({"positions": {"scatter": "2 deg"}}, r"as_built\.positions\.scatter"),
        ({"dipoles": {"dead_fraction": "many"}}, r"as_built\.dipoles\.dead_fraction.*fraction"),
    ],
)
def test_mistakes_are_told(as_built, told, tmp_path: Path):
    with pytest.raises(ExperimentError, match=told):
        experiment(tmp_path, as_built=as_built)


def test_the_calibrator_takes_the_instrument_for_the_nominal_one(tmp_path: Path):
    """Unless the experiment says that the calibrator knows how it is built."""
    plain = Graph(experiment(tmp_path))
    built = Graph(experiment(tmp_path, as_built=SCATTERED))
    assert sky_model.sky_model(built).key == simulation.foregrounds(plain).key != simulation.foregrounds(built).key
    assert sky_model.differences(built) == [("instrument.as_built", "positions 20 cm", "nominal")]
    assert "instrument.as_built = nominal, where positions 20 cm is true" in sky_model.described(built)
    known = {**SMALL, "calibration": {"assumed": {"instrument": {"as_built": SCATTERED}}}}
    known["instrument"] = {**SMALL["instrument"], "as_built": SCATTERED}
    graph = Graph(validate(known, tmp_path))
    assert sky_model.is_perfect(graph)
    half = {**known, "calibration": {"assumed": {"instrument.as_built.positions.scatter": "1 cm"}}}
    assert sky_model.differences(Graph(validate(half, tmp_path))) == [
        ("instrument.as_built", "positions 20 cm", "positions 1 cm")
    ]
