"""The delay floor of an experiment's foregrounds for every interpolation of its beam between tabulated frequencies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.constants import speed_of_light

from calstudy.checks.beam import INTERPOLATIONS, interpolated, require_tabulated
from calstudy.experiment.model import Experiment
from calstudy.instrument.telescope import make_template, subset_template
from calstudy.simulate.chunks import simulate_visibilities
from calstudy.simulate.engine import make_engine
from calstudy.simulate.floor import MAIN_LOBES, DelayFloor, delay_floor, make_window
from calstudy.simulate.nodes import integration_times
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.visibilities import baseline_vectors, from_cube, to_cube

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
    cube = to_cube(foregrounds)
    lengths = np.linalg.norm(baseline_vectors(foregrounds), axis=1)
    width = float(np.diff(foregrounds.freq_array).mean())
    short = lengths <= np.quantile(lengths, 1 / 3)
    window = make_window("dolph-chebyshev", foregrounds.Nfreqs)
    transform = np.abs(np.fft.fft(cube[:, short] * window[:, None], axis=2)) ** 2
    delays = np.fft.fftfreq(foregrounds.Nfreqs, width)
    power = transform.mean(axis=(0, 1, 3))
    half = foregrounds.Nfreqs // 2
    # Both signs of a delay are one.
    folded = np.concatenate([power[:1], (power[1:half] + power[:-half:-1]) / 2])
    buffers = {taper: lobe / (width * foregrounds.Nfreqs) for taper, lobe in MAIN_LOBES.items()}
    return InterpolationFloor(
        delay=delays[:half],
        spectrum=np.sqrt(folded / folded.max()),
        horizon=float(lengths[short].max() / speed_of_light),
        floors={taper: delay_floor(foregrounds, max(100e-9, buffer), taper) for taper, buffer in buffers.items()},
    )
