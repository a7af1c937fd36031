"""The delay floor of an experiment's foregrounds for every interpolation of its beam between tabulated frequencies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.constants import speed_of_light

from calstudy.checks.beam import INTERPOLATIONS, interpolated, require_tabulated
from calstudy.errors import InputError
from calstudy.experiment.model import Experiment
from calstudy.instrument.telescope import make_template, subset_template
from calstudy.simulate.chunks import simulate_visibilities
from calstudy.simulate.engine import make_engine
from calstudy.simulate.floor import MAIN_LOBES, DelayFloor, delay_floor, delay_profile, floor_buffers
from calstudy.simulate.nodes import integration_times
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.visibilities import baseline_vectors, from_cube

if TYPE_CHECKING:
    from pyuvdata import UVData


@dataclass(frozen=True)
class InterpolationFloor:
    """Delay spectra and floors of foregrounds simulated with one interpolation of the beam.

    Attributes
    ----------
    delay : (Ndelays,) float
        Non-negative delays, s.
    spectrum : (Ndelays,) float
        Rms over the shortest third of the baselines, relative to its largest, Dolph-Chebyshev taper.
    horizon
        Longest horizon delay of these baselines, s.
    floors
        By taper.
    """

    delay: np.ndarray
    spectrum: np.ndarray
    horizon: float
    floors: dict[str, DelayFloor]


def compare_floors(
    experiment: Experiment, tell: Callable[[str], None] = lambda text: None
) -> dict[str, InterpolationFloor]:
    """Simulate the foregrounds of an experiment at its middle integration, once with every interpolation.

    Every channel is simulated, so that nothing but the beam is interpolated.

    Parameters
    ----------
    experiment
        Its instrument, foregrounds and engine are used.
    tell
        Called with the name of each interpolation before its simulation.

    Raises
    ------
    InputError
        If the beam is not tabulated, or a catalogue or beam file is missing.
    """
    instrument = experiment.instrument
    require_tabulated(instrument.beam)
    whole = make_template(instrument)
    times = integration_times(whole)
    template = subset_template(whole, times[len(times) // 2 :][:1], whole.freq_array)
    sky = make_foregrounds(experiment.sky.foregrounds, whole.freq_array).sky
    settings = experiment.simulation
    engine = make_engine(settings)
    floors = {}
    for name in INTERPOLATIONS:
        tell(name)
        beam = interpolated(instrument.beam, instrument.channels, name)
        cube = simulate_visibilities(engine, sky, beam, template, settings, smooth_in_frequency=False)
        floors[name] = _measure(from_cube(template, cube))
    return floors


def _measure(foregrounds: UVData) -> InterpolationFloor:
    buffers = floor_buffers(foregrounds)
    if len(buffers) < len(MAIN_LOBES):
        raise InputError("instrument.channels: too wide or too few, no delay lies beyond the horizon and the main lobe")
    lengths = np.linalg.norm(baseline_vectors(foregrounds), axis=1)
    short = lengths <= np.quantile(lengths, 1 / 3)
    delays, power = delay_profile(foregrounds, "dolph-chebyshev")
    delay, folded = folded_spectrum(delays, power[short].mean(axis=0))
    return InterpolationFloor(
        delay=delay,
        spectrum=np.sqrt(folded / folded.max()),
        horizon=float(lengths[short].max() / speed_of_light),
        floors={taper: delay_floor(foregrounds, buffer, taper) for taper, buffer in buffers.items()},
    )


def folded_spectrum(delays: np.ndarray, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return delays >= 0, (N // 2,), and the mean power of both signs of each, from the order of `numpy.fft`."""
    half = delays.size // 2
    return delays[:half], np.concatenate([power[:1], (power[1:half] + power[:-half:-1]) / 2])
