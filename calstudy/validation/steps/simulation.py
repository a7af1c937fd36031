"""Steps -1 and 1.0: the simulation, before anything is calibrated.

Step -1: simulation engines compared with pyuvsim, and with a closed form.

The closed form: one source of flux I at s, seen by dishes of power beam A, gives V_ab = A(s) I exp(2 pi i b.s / lambda)
/ 2. With a Gaussian beam A is known, and s is given by astropy's own transformation to the horizon.

Step 1.0: foregrounds and EoR with perfect gains: outside the wedge there is only the EoR.

Outside means |tau| > |b|/c + buffer, and beyond the taper's main lobe if that is wider. With foregrounds of power P^F
there, P^{F+S} - P^S = P^F + 2 Re <F* S>: a floor, and a cross term of zero mean that scatters by sqrt(2 P^F P^S / N).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from astropy import units
from astropy.coordinates import AltAz, Longitude, SkyCoord
from astropy.time import Time
from pydantic import Field
from pyradiosky import SkyModel

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.visibilities import baseline_vectors, subset_template
from calstudy.claims.bins import beyond_wedge
from calstudy.corrupt.levels import rms
from calstudy.experiment.model import Component, Variant
from calstudy.instrument.beams import make_beam
from calstudy.instrument.settings import BEAMS, DEFAULT_LAYOUT, LAYOUTS, InstrumentSettings
from calstudy.instrument.telescope import make_template
from calstudy.power.spectra import DelaySpectra
from calstudy.power.transfer import BANDS
from calstudy.products import spectra
from calstudy.products.graph import Graph
from calstudy.run.task import Task
from calstudy.simulate.interface import Engine
from calstudy.simulate.nodes import integration_times
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.sky.settings import SyntheticSources
from calstudy.validation.step import MINREDUNDANT, Findings, Limit, Step, StepInput, largest, mean_over, only
from calstudy.verdicts.criterion import AtMost, Finding

if TYPE_CHECKING:
    from pyuvdata import UVData


REFERENCE = ("pyuvsim", "double")
CANDIDATES = (
    ("dense", "double"),
    ("dense", "single"),
    ("matvis", "double"),
    ("fftvis", "single"),
    ("fftvis", "double"),
    REFERENCE,
)
"""Engines and precisions that are compared. matvis in single precision rounds its phases to 1e-4 and is left out."""
FLUX = 3.0
BEAM = BEAMS.make("gaussian")
OFFSETS = ((0.0, 0.0), (6.0, 20.0), (15.0, 200.0), (40.0, 310.0))
"""Directions of the single source: degrees from the zenith, azimuth in degrees (north through east)."""


class Engines(Step):
    """The largest differences of the engines from pyuvsim, over the rms, and from the closed form."""

    kind: str = "engines"
    version: ClassVar[int] = 3
    number = "-1"
    proves = "simulation engines agree with pyuvsim and with closed forms"
    parameters: ClassVar = {
        "sources": 5000,
        "antennas": 12,
        "channels": 2,
        "times": 2,
        "engines": ["dense", "matvis", "fftvis", "pyuvsim"],
    }
    small_parameters: ClassVar = {"sources": 300, "antennas": 5, "times": 1, "engines": ["dense", "pyuvsim"]}
    limits: ClassVar = {
        "double_pyuvsim": Limit(
            "largest difference of an engine in double precision from pyuvsim, over the rms of the visibilities",
            AtMost(1e-6),
            "-60 dB in brightness, 20 dB below the EoR",
        ),
        "double_closed_form": Limit(
            "largest relative difference from A(s) I exp(2 pi i b.s) / 2 for single sources, double precision",
            AtMost(1e-6),
            "as above; only the coordinates of the sky are shared with the engines",
        ),
    }

    engines: Annotated[tuple[str, ...], Field(min_length=1)]
    sources: int = Field(ge=1, description="Brightest sources of the whole sky.")
    antennas: int = Field(ge=2, le=36, description="First tiles of the minimally redundant array.")
    channels: int = Field(ge=1, description="Spread over the paper's band.")
    times: int = Field(ge=1, description="Integrations, spread over the paper's.")

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        compared = [item for item in CANDIDATES if item[0] in self.engines]
        errors, closed = self.errors(compared), {item: closed_form_error(*item) for item in compared}
        both = {**errors, **{key: largest((errors.get(key, 0.0), value)) for key, value in closed.items()}}
        values = {
            f"{precision}_{what}": Finding(
                largest(value for (_, kind), value in found.items() if kind == precision), 0.0
            )
            for precision in ("double", "single")
            for what, found in (("pyuvsim", errors), ("closed_form", closed))
            if any(kind == precision for _, kind in found)
        }
        return Findings(
            values, tuple(f"{name} ({kind}): {value:.1e} of the rms" for (name, kind), value in both.items())
        )

    def errors(self, compared: Sequence[tuple[str, str]]) -> dict[tuple[str, str], float]:
        """Return the largest difference from pyuvsim over the rms of the visibilities, by engine and precision."""
        instrument = InstrumentSettings(layout=LAYOUTS.make({"kind": DEFAULT_LAYOUT, "count": self.antennas}))
        whole = make_template(instrument)
        times, channels = _spread(whole.Ntimes, self.times), _spread(whole.Nfreqs, self.channels)
        template = subset_template(whole, integration_times(whole)[times], whole.freq_array[channels])
        beam = make_beam(instrument.beam, instrument.channels)
        sky = make_foregrounds(SyntheticSources(count=self.sources), whole.freq_array).sky
        cubes = {item: _make(*item).simulate(sky, beam, template) for item in dict.fromkeys([*compared, REFERENCE])}
        reference = cubes.pop(REFERENCE)
        return {item: float(np.abs(cube - reference).max()) / rms(reference) for item, cube in cubes.items()}


def _make(engine: str, precision: str) -> Engine:
    return Engine.registry.make({"kind": engine, "precision": precision})


def _spread(length: int, count: int) -> np.ndarray:
    return np.unique(np.linspace(0, length - 1, count + 2).round().astype(int)[1:-1])


def closed_form_error(engine: str, precision: str) -> float:
    """Return the largest relative difference of visibilities of single sources from the closed form."""
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
    simulator = _make(engine, precision)
    differences = []
    for zenith_angle, azimuth in OFFSETS:
        angles = np.radians([zenith_angle, azimuth])
        sky = _source(template, *angles)
        cube = simulator.simulate(sky, beam, template)[0, :, :, 0]
        differences.append(np.abs(cube / _closed_form(template, *angles) - 1).max())
    return largest(differences)


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
    turns = (baseline_vectors(template) @ direction)[:, None] * template.freq_array / SPEED_OF_LIGHT
    # The width of the power beam is proportional to the wavelength.
    width = np.radians(BEAM.fwhm_deg) * BEAM.reference_frequency / template.freq_array
    power = np.exp(-4 * np.log(2) * (zenith_angle / width) ** 2)
    return power * FLUX / 2 * np.exp(2j * np.pi * turns)


class Foregrounds(Step):
    """P^{F+S} / P^S - 1 over all modes outside the wedge, the floor P^F / P^S, and the excess over it."""

    kind: str = "foregrounds"
    version: ClassVar[int] = 2
    number = "1.0"
    proves = "outside the wedge, the power of foregrounds and EoR equals that of the EoR alone"
    experiments: ClassVar = {"minredundant": MINREDUNDANT}
    sections: ClassVar = ("power",)
    limits: ClassVar = {
        "beyond_floor": Limit(
            "|P^{F+S} - P^S - P^F| / P^S over all modes beyond horizon, buffer and main lobe of the taper: excess over "
            "the floor P^F of the foregrounds",
            AtMost(0.01),
            "1 %",
        ),
        "excess": Limit(
            "|P^{F+S} - P^S| / P^S over the same modes, including the floor",
            AtMost(0.01),
            "stricter, without allowance for sidelobes of the taper; the short band of the small scale cannot meet it",
            small="full scale only",
        ),
    }

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        components: dict[str, tuple[Component, ...]] = {
            "eor": ("eor",),
            "foregrounds": ("foregrounds",),
            "both": ("foregrounds", "eor"),
        }
        return {
            name: spectra.variant_power(graph, " + ".join(parts), Variant(components=parts))
            for name, parts in components.items()
        }

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        run = only(runs)
        signal, floor, both = (run.delay_spectra(product) for product in ("eor", "foregrounds", "both"))
        outside = beyond_wedge(signal.delay, signal.length, run.experiment.power.wedge_buffer)
        k = np.hypot(signal.k_perp[:, None], signal.k_parallel)
        excess = _over_signal(both.power.real - signal.power.real, signal, outside)
        beyond = both.power.real - signal.power.real - floor.power.real
        accounted, remarks = _over_signal(beyond, signal, outside), []
        for low, high in itertools.pairwise(BANDS):
            band = outside & (k > low) & (k <= high)
            if band.any():
                found, leak = _over_signal(beyond, signal, band), _over_signal(floor.power.real, signal, band)
                remarks.append(
                    f"k from {low:g} to {high:g} h/Mpc: floor P^F / P^S = {leak.value:.2e}, excess beyond it "
                    f"{found.value:.1e} ± {found.uncertainty:.1e}"
                )
        values = {
            "excess": Finding(abs(excess.value), excess.uncertainty),
            "beyond_floor": Finding(abs(accounted.value), accounted.uncertainty),
            "floor": _over_signal(floor.power.real, signal, outside),
        }
        return Findings(values, tuple(remarks))


def _over_signal(power: np.ndarray, signal: DelaySpectra, used: np.ndarray) -> Finding:
    """Return the mean of `power` over that of the signal, over the modes used."""
    level = float(signal.power.real[used].mean())
    found = mean_over(power, used)
    return Finding(found.value / level, found.uncertainty / level)
