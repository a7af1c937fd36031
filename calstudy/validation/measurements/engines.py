r"""Step -1: simulation engines against pyuvsim, and against a closed form.

The closed form: one source of flux I at s, seen by dishes of power beam A, gives V_ab = A(s) I exp(2 pi i b.s / lambda)
/ 2. With a Gaussian beam A is known, and s is that of astropy's own transformation to the horizon.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np
from astropy import units
from astropy.coordinates import AltAz, Longitude, SkyCoord
from astropy.time import Time
from pydantic import Field
from pyradiosky import SkyModel
from scipy.constants import speed_of_light

from calstudy.base.visibilities import baseline_vectors
from calstudy.bench.engines import CANDIDATES, REFERENCE, Work, time_engines
from calstudy.instrument.beam_models.gaussian import GaussianBeam
from calstudy.instrument.beams import make_beam
from calstudy.instrument.settings import InstrumentSettings
from calstudy.instrument.telescope import make_template
from calstudy.simulate.interface import Engine
from calstudy.validation.measurement import Findings, Inputs, Measurement
from calstudy.verdicts.criterion import Finding

if TYPE_CHECKING:
    from pyuvdata import UVData

FLUX = 3.0
BEAM = GaussianBeam(kind="gaussian")
OFFSETS = ((0.0, 0.0), (6.0, 20.0), (15.0, 200.0), (40.0, 310.0))
"""Where the single source is: degrees from the zenith, azimuth in degrees (north through east)."""


class Engines(Measurement):
    """The largest differences of the engines from pyuvsim, over the rms, and from the closed form."""

    engines: Annotated[tuple[str, ...], Field(strict=False, min_length=1)]
    sources: int = Field(ge=1, description="Brightest sources of the whole sky.")
    antennas: int = Field(ge=2, le=36, description="First tiles of the minimally redundant array.")
    channels: int = Field(ge=1, description="Spread over the paper's band.")
    times: int = Field(ge=1, description="Integrations, spread over the paper's.")

    def measure(self, inputs: Inputs) -> Findings:
        """Run all engines on the same work, and on single sources."""
        del inputs
        timings = time_engines(Work(self.sources, self.antennas, self.channels, self.times), list(self.engines))
        errors = {(item.engine, item.precision): item.error for item in timings if item.engine != REFERENCE}
        closed = {item: closed_form_error(*item) for item in CANDIDATES if item[0] in self.engines}
        both = {**errors, **{key: max(errors.get(key, 0.0), value) for key, value in closed.items()}}
        values = {
            f"{precision}_{what}": Finding(max(value for (_, kind), value in found.items() if kind == precision), 0.0)
            for precision in ("double", "single")
            for what, found in (("pyuvsim", errors), ("closed_form", closed))
            if any(kind == precision for _, kind in found)
        }
        return Findings(
            values, tuple(f"{name} ({kind}): {value:.1e} of the rms" for (name, kind), value in both.items())
        )


def closed_form_error(engine: str, precision: str) -> float:
    """Return the largest difference of an engine's visibilities of single sources from A(s) I exp(2 pi i b.s) / 2."""
    settings = InstrumentSettings.model_validate(
        {
            "layout": {"kind": "mwa-compact-minredundant", "count": 4},
            "beam": BEAM,
            "channels": {"count": 8, "width": "3.84 MHz"},
            "times": {"count": 1},
        }
    )
    template = make_template(settings)
    beam = make_beam(settings.beam, settings.channels)
    simulator = Engine.registry.make({"kind": engine, "precision": precision})
    worst = 0.0
    for zenith_angle, azimuth in OFFSETS:
        angles = np.radians([zenith_angle, azimuth])
        sky = _source(template, *angles)
        cube = simulator.simulate(sky, beam, template)[0, :, :, 0]
        worst = max(worst, float(np.abs(cube / _closed_form(template, *angles) - 1).max()))
    return worst


def _source(template: UVData, zenith_angle: float, azimuth: float) -> SkyModel:
    frame = AltAz(obstime=Time(template.time_array[0], format="jd", scale="utc"), location=template.telescope.location)
    position = SkyCoord(
        alt=(np.pi / 2 - zenith_angle) * units.rad, az=Longitude(azimuth * units.rad), frame=frame
    ).transform_to("icrs")
    stokes = np.zeros((4, 1, 1))
    stokes[0] = FLUX
    return SkyModel(name=["source"], skycoord=position.reshape(1), stokes=stokes * units.Jy, spectral_type="flat")


def _closed_form(template: UVData, zenith_angle: float, azimuth: float) -> np.ndarray:
    """Return A I exp(2 pi i b.s / lambda) / 2, (Nbls, Nfreqs)."""
    direction = np.array(
        [np.sin(zenith_angle) * np.sin(azimuth), np.sin(zenith_angle) * np.cos(azimuth), np.cos(zenith_angle)]
    )
    turns = (baseline_vectors(template) @ direction)[:, None] * template.freq_array / speed_of_light
    # The width of the power beam goes with the wavelength.
    width = np.radians(BEAM.fwhm_deg) * BEAM.reference_frequency / template.freq_array
    power = np.exp(-4 * np.log(2) * (zenith_angle / width) ** 2)
    return power * FLUX / 2 * np.exp(2j * np.pi * turns)
