"""Arrays at other places on the Earth."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from astropy.coordinates import TETE, SkyCoord
from astropy.time import Time
from simulation_cases import point_sky

from calstudy.base.errors import ExperimentError
from calstudy.experiment.files import dump, validate
from calstudy.instrument.beams import make_beam
from calstudy.instrument.layouts import place_of
from calstudy.instrument.settings import Coordinates, InstrumentSettings
from calstudy.instrument.telescope import make_template
from calstudy.products import simulation
from calstudy.products.graph import Graph
from calstudy.simulate.engines.dense import DenseEngine
from calstudy.studies.show import sites

KAROO = {"latitude": "-30.7215 deg", "longitude": "21.4283 deg", "height": "1051.69 m"}


def test_longitudes_count_to_180_or_to_360_degrees():
    def place(longitude):
        return place_of(Coordinates(kind="coordinates", latitude="52.9 deg", longitude=f"{longitude} deg"))

    assert place(350.1) == place(-9.9)
    assert place(180) == place(-180)


@pytest.mark.parametrize(
    ("place", "latitude"),
    [
        ({"layout": "hera-19"}, -30.72152612068925),
        ({"layout": {"kind": "hex", "side": 2}, "location": "hera"}, -30.72152612068925),
        ({"layout": {"kind": "hera-19"}, "location": "mwa"}, -26.70331941),
        ({"layout": {"kind": "hex", "side": 2}, "location": {"latitude": "52.9 deg", "longitude": "6.9 deg"}}, 52.9),
    ],
)
def test_a_source_transits_when_and_where_it_should(place, latitude):
    """Its visibility on a short baseline is largest when its apparent right ascension (astropy's) is the sidereal time.

    The power beam then is that at a zenith angle of its apparent declination less the latitude.
    """
    degrees = max(latitude - 10, -80.0)
    settings = InstrumentSettings.model_validate(
        {
            **place,
            "beam": {"kind": "gaussian", "fwhm_deg": 40},
            "times": {"start_lst": "5 h", "integration": "120 s", "count": 9},
            "channels": {"count": 8},
        }
    )
    template = make_template(settings)
    telescope = template.telescope.location
    assert telescope.lat.deg == pytest.approx(latitude, abs=1e-9)
    middle = np.unique(template.time_array)[4]
    date = TETE(obstime=Time(middle, format="jd"), location=telescope)
    lst = np.degrees(np.unique(template.lst_array)[4])
    source = SkyCoord(lst, degrees, unit="deg", frame=date)
    beam = make_beam(settings.beam, settings.channels)
    cube = DenseEngine().simulate(point_sky(source.icrs.reshape(1), [1.0]), beam, template)
    amplitude = np.abs(cube[:, 0, 0, 0])
    assert amplitude.argmax() == 4
    # Symmetric about the transit: 2 % of the step from one integration to the next is 2.4 s of sidereal time.
    assert abs(amplitude[3] - amplitude[5]) < 0.02 * (amplitude[4] - amplitude[3])
    expected = beam.at(template.freq_array[:1]).power_eval(
        az_array=np.zeros(1), za_array=np.radians([abs(degrees - latitude)]), freq_array=template.freq_array[:1]
    )[0, 0, 0, 0]
    # Half the power beam; refraction is off, aberration is in the apparent coordinates.
    assert amplitude[4] == pytest.approx(0.5 * expected, rel=1e-5)


def experiment(folder: Path, **instrument):
    fields = {"layout": {"kind": "hex", "side": 2}, "beam": "gaussian", "channels": {"width": "400 kHz", "count": 32}}
    return validate({"name": "somewhere", "instrument": {**fields, "times": {"count": 2}, **instrument}}, folder)


def test_the_site_is_part_of_the_key_where_it_is_another(tmp_path: Path):
    plain, same, other, named = (
        simulation.foregrounds(Graph(experiment(tmp_path, **extra))).key
        for extra in ({}, {"location": None}, {"location": KAROO}, {"location": "hera"})
    )
    assert plain == same
    assert len({plain, other, named}) == 3


def test_a_site_is_written_and_read_again(tmp_path: Path):
    for location in (KAROO, "ovro-lwa"):
        made = experiment(tmp_path, location=location)
        assert validate(yaml.safe_load(dump(made)), tmp_path) == made


@pytest.mark.parametrize(
    ("location", "told"),
    [
        ("moon", r"instrument\.location.*'moon'"),
        ({"latitude": "-95 deg", "longitude": "0 deg"}, r"instrument\.location\.latitude.*at least -90"),
        ({"latitude": "-30 deg"}, r"instrument\.location\.longitude"),
        ({"latitude": -30, "longitude": "0 deg"}, r"instrument\.location\.latitude.*has no unit"),
    ],
)
def test_mistakes_are_told(location, told, tmp_path: Path):
    with pytest.raises(ExperimentError, match=told):
        experiment(tmp_path, location=location)


def test_plans_name_the_site(tmp_path: Path):
    (tmp_path / "array.csv").write_text("east_m,north_m,up_m\n0,0,0\n14,0,0\n0,14,0\n30,7,0\n")
    layout = {"kind": "csv", "path": "array.csv"}
    for extra, told in (
        ({}, "mwa, latitude -26.7033 deg"),
        ({"layout": layout, "location": "hera"}, "hera, latitude -30.7215 deg"),
        ({"location": KAROO}, "latitude -30.7215 deg, longitude 21.4283 deg, 1052 m"),
    ):
        (line,) = sites([simulation.foregrounds(Graph(experiment(tmp_path, **extra)))])
        assert re.match(told, line)
    with pytest.raises(ExperimentError) as caught:
        experiment(tmp_path, layout=layout)
    assert str(caught.value).splitlines()[-1].strip(" -") == (
        "instrument.location: is required for instrument.layout 'csv', which is at no site: the name of a site (mwa, "
        "hera, paper, ovro-lwa), or coordinates (latitude and longitude)"
    )
