"""Checks of sky, beam and floor: they find what was put there."""

from pathlib import Path

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from pyradiosky import SkyModel

from calstudy.base.errors import ExperimentError
from calstudy.experiment.files import validate
from calstudy.figures.beam_fit import compare_floors, compare_interpolations, draw_delay_floors, draw_interpolations
from calstudy.figures.simulated_sky import count_sources, draw_counts
from calstudy.instrument.settings import InstrumentSettings
from calstudy.sky.counts import draw_population

SMALL = {
    "name": "small",
    "instrument": {
        "layout": {"kind": "mwa-compact-minredundant", "count": 5},
        "channels": {"width": "320 kHz", "count": 96},
        "times": {"count": 3},
    },
    "sky": {"foregrounds": {"kind": "g4jy-and-counts", "count": 300}},
    "simulation": {"chunks": 2},
}


def population(factor: float) -> SkyModel:
    """Return a drawn population with its fluxes multiplied."""
    right_ascension, declination, flux = draw_population(0.05, 10.0, seed=3)
    stokes = np.zeros((4, 1, len(flux)))
    stokes[0, 0] = factor * flux
    return SkyModel(
        name=np.arange(len(flux)).astype(str),
        skycoord=SkyCoord(right_ascension, declination, unit="rad", frame="icrs"),
        stokes=stokes * units.Jy,
        spectral_type="flat",
    )


def test_counts_find_a_population_as_drawn_and_one_that_is_too_bright():
    counts = count_sources(population(1.0))
    assert (np.abs(counts.ratio - 1) < 4 * counts.error).all()
    # 24,831 square degrees of GLEAM, and what it leaves out within this area.
    assert counts.area == pytest.approx(24831 / 41253 * 4 * np.pi, rel=0.05)
    brighter = count_sources(population(1.2))
    assert (brighter.ratio > 1.1).all()
    upper, _ = draw_counts(counts).axes
    flux, drawn = upper.containers[0].lines[0].get_data()
    np.testing.assert_allclose(drawn / flux**2.5 * np.diff(counts.edges) * counts.area, counts.number)


@pytest.mark.chain
def test_the_smooth_fit_is_nearest_to_the_table():
    fit = compare_interpolations(InstrumentSettings(), step=16)
    assert fit.fit_max.max() < 5e-4
    assert (fit.fit_rms < fit.fit_max).all()
    rms = {name: np.sqrt(np.mean(values**2)) for name, values in fit.others.items()}
    assert rms["nearest"] > 10 * rms["linear"] > 10 * rms["cubic"] / 2
    assert len(draw_interpolations(fit).axes[0].lines) == 5


@pytest.mark.chain
def test_a_smooth_beam_has_the_lowest_floor():
    experiment = validate(SMALL, Path())
    floors = compare_floors(experiment.instrument, experiment.sky, experiment.simulation)
    peaks = {name: floor.floors["dolph-chebyshev"].worst_db for name, floor in floors.items()}
    assert peaks["chebyshev"] < peaks["linear"] - 10
    assert peaks["linear"] < peaks["nearest"] - 10
    assert floors["nearest"].spectrum.max() == 1
    assert len(draw_delay_floors(floors, -40.0).axes) == 2


@pytest.mark.parametrize("figure", ["beam-fit", "delay-floor"])
def test_a_formula_is_not_interpolated(figure):
    instrument = {**SMALL["instrument"], "beam": "gaussian"}
    with pytest.raises(ExperimentError, match=f"asks for '{figure}', which .* gaussian is a formula"):
        validate({**SMALL, "instrument": instrument, "outputs": {"figures": [figure]}}, Path())
