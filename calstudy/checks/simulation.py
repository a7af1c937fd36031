"""What a simulation looks like: the wedge of F alone, P(k) of S alone against its input, delay spectra of baselines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calstudy.corrupt.levels import rms, set_levels
from calstudy.instrument.beams import make_beam
from calstudy.power.average import fringe_stop_and_average
from calstudy.power.delay import delay_transform, delays
from calstudy.power.drawn import input_power
from calstudy.power.errors import with_errors
from calstudy.power.estimate import estimate_power
from calstudy.power.spectra import DelaySpectra, delay_spectra
from calstudy.power.spherical import SphericalSpectrum, spherical_average
from calstudy.power.wedge import WedgeSpectrum, cylindrical_average
from calstudy.visibilities import antenna_pairs, baseline_vectors, to_cube

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.experiment.model import Experiment

LENGTHS = (0.0, 0.5, 1.0)
"""The baselines looked at, as quantiles of length: shortest, median, longest."""


@dataclass(frozen=True)
class BaselineDelays:
    """Rms over integrations of one baseline's delay transforms, first polarization, Jy Hz.

    Attributes
    ----------
    antennas
        The two antenna numbers.
    length
        |b| in m.
    delay
        Ascending, (Ndelays,), s.
    foregrounds, eor
        Of F, and of S scaled to the level that the experiment puts on the data, (Ndelays,) each.
    """

    antennas: tuple[int, int]
    length: float
    delay: np.ndarray
    foregrounds: np.ndarray
    eor: np.ndarray


@dataclass(frozen=True)
class SimulationLook:
    """The simulated components of an experiment, each alone.

    Attributes
    ----------
    wedge
        Of F.
    eor
        P(k) of S as simulated, over all modes, with its sample variance.
    expected : (Nk,) float
        The P(k) that S was drawn from, at the centres of the bins, mK^2 h^-3 Mpc^3.
    baselines
        A short, a middle and a long one.
    buffer
        Delay beyond the horizon at which the experiment's window starts, s.
    """

    wedge: WedgeSpectrum
    eor: SphericalSpectrum
    expected: np.ndarray
    baselines: tuple[BaselineDelays, ...]
    buffer: float

    def ratio(self, low: float, high: float) -> tuple[float, float]:
        """Return measured over expected power and its standard deviation, over bins with low < k <= high (h/Mpc).

        Bins weigh by their independent modes, for the sample variance is the only error.
        """
        modes = self.eor.sample_modes
        chosen = (modes > 0) & (self.eor.k > low) & (self.eor.k <= high)
        weights = modes[chosen]
        if not weights.sum():
            return np.nan, np.nan
        ratios = self.eor.power.real[chosen] / self.expected[chosen]
        return float(np.average(ratios, weights=weights)), float(1 / np.sqrt(weights.sum()))


def look_at_simulation(foregrounds: UVData, eor: UVData, experiment: Experiment) -> SimulationLook:
    """Measure what can be judged by eye of the simulated components.

    Parameters
    ----------
    foregrounds, eor
        F and S as simulated, Jy. Not mutated.
    experiment
        That they belong to: its beam, power section and levels are used.
    """
    settings = experiment.power
    levels = set_levels(rms(to_cube(foregrounds)), rms(to_cube(eor)), experiment.corruption)
    of_foregrounds, of_eor = (_delay_spectra(data, experiment) for data in (foregrounds, eor))
    spectrum = spherical_average(of_eor, settings, exclude_wedge=False)
    return SimulationLook(
        wedge=cylindrical_average(of_foregrounds, settings),
        eor=with_errors(spectrum, signal=spectrum),
        expected=input_power(experiment.sky.eor, spectrum.k, settings.cosmology),
        baselines=_baselines(foregrounds, eor, levels.eor_factor, settings.taper),
        buffer=settings.wedge_buffer,
    )


def _delay_spectra(data: UVData, experiment: Experiment) -> DelaySpectra:
    average = fringe_stop_and_average(data)
    beam = make_beam(experiment.instrument.beam, experiment.instrument.channels)
    return delay_spectra(estimate_power(average, average, beam, experiment.power), experiment.power)


def _baselines(foregrounds: UVData, eor: UVData, factor: float, taper: str) -> tuple[BaselineDelays, ...]:
    lengths = np.linalg.norm(baseline_vectors(foregrounds), axis=1)
    chosen = np.argsort(lengths, kind="stable")[[round(part * (len(lengths) - 1)) for part in LENGTHS]]
    frequencies = foregrounds.freq_array
    delay = delays(len(frequencies), float(np.diff(frequencies).mean()))

    def spectrum(data: UVData, index: int) -> np.ndarray:
        transform = delay_transform(to_cube(data)[:, index, :, 0], frequencies, taper)
        return np.sqrt(np.mean(np.abs(transform) ** 2, axis=0))

    return tuple(
        BaselineDelays(
            antennas=tuple(antenna_pairs(foregrounds)[index].tolist()),
            length=float(lengths[index]),
            delay=delay,
            foregrounds=spectrum(foregrounds, index),
            eor=factor * spectrum(eor, index),
        )
        for index in chosen
    )
