"""Step 0.0: noise alone, whose power follows from its standard deviation.

For white noise of standard deviation sigma (Jy, complex) per integration, N_t integrations averaged, and a taper T, the
noise power of one baseline is

    P_N = dnu sum_nu T^2 s^2 / sum_nu T^2 (Omega_pp / Omega_p^2) / (X^2 Y),   s = sigma / sqrt(N_t) in mK,

which is the familiar X^2 Y Omega_eff T^2 dnu; X and Y are evaluated at the channels of the band. Even and odd
data have independent noise, so that Re and Im of their product have mean zero and standard deviation
P_N / sqrt(2).

Baselines have independent noise. Means and mean squares over a baseline's delays are the samples, from whose scatter
the sampling errors are computed: these include correlations between delays and the long tails of the products.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np

from calstudy.corrupt.levels import Levels
from calstudy.experiment.model import Variant
from calstudy.instrument.beams import make_beam
from calstudy.instrument.settings import InstrumentSettings
from calstudy.power.cosmology import make_cosmology, radial_scale, redshift, transverse_scale
from calstudy.power.delay import make_taper
from calstudy.power.estimate import kelvin_per_jansky
from calstudy.power.settings import PowerSettings
from calstudy.products import corruption, spectra
from calstudy.products.graph import Graph
from calstudy.run.task import Task
from calstudy.validation.step import MINREDUNDANT, Findings, Limit, Step, StepInput, only
from calstudy.verdicts.criterion import Equal, Finding


class Noise(Step):
    """The scatter of the estimates over that of theory, and the means of Re and Im in units of P_N."""

    number = "0.0"
    proves = "the theoretical P_N equals the scatter of the estimates; even x odd has mean zero"
    experiments: ClassVar = {"noise": MINREDUNDANT}
    sections: ClassVar = ("instrument", "power")
    limits: ClassVar = {
        "scatter_over_theory": Limit(
            "rms of even x odd over P_N / sqrt(2)",
            Equal(1, 3),
            "3 sigma of the sampling error, from the scatter of baselines",
        ),
        "mean_real": Limit("mean of Re(even x odd) over P_N", Equal(0, 3), "independent noise has no cross power"),
        "mean_imaginary": Limit("mean of Im(even x odd) over P_N", Equal(0, 3), "as above"),
    }

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the spectra of the noise alone, and its level."""
        noise = Variant(components=("noise",))
        return {"noise": spectra.variant_power(graph, "noise", noise), "levels": corruption.levels(graph)}

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        """Compare the spectra of the noise with P_N."""
        run = only(runs)
        found = run.delay_spectra("noise")
        theory = noise_power(run.experiment.instrument, run.experiment.power, run.levels)
        products = found.power * np.sqrt(found.n_pairs)[:, None] / theory
        square = _mean(np.mean(products.real**2, axis=1))
        scatter = np.sqrt(2 * square.value)
        values = {
            "scatter_over_theory": Finding(scatter, scatter * square.uncertainty / (2 * square.value)),
            "mean_real": _mean(products.real.mean(axis=1)),
            "mean_imaginary": _mean(products.imag.mean(axis=1)),
        }
        return Findings(
            values, (f"P_N of one baseline: {theory:.4g} mK2 h-3 Mpc3; {len(products)} baselines or groups",)
        )


def noise_power(instrument: InstrumentSettings, power: PowerSettings, levels: Levels) -> float:
    """Return P_N of one baseline and the first polarization in mK2 h-3 Mpc3; see the module."""
    channels = instrument.channels
    frequencies = channels.first + channels.width * np.arange(channels.count)
    omega_p, omega_pp = make_beam(instrument.beam, channels).solid_angles(frequencies, instrument.polarizations[0])
    sigma = levels.noise if levels.noise_spectrum is None else np.array(levels.noise_spectrum)[:, 0]
    temperature = 1e3 * sigma / np.sqrt(instrument.times.count) * kelvin_per_jansky(frequencies, omega_p, None)
    cosmology = make_cosmology(power.cosmology)
    redshifts = np.asarray(redshift(frequencies))
    volume = cosmology.h**3 * np.array(
        [transverse_scale(cosmology, z) ** 2 * radial_scale(cosmology, z) for z in redshifts]
    )
    taper = make_taper(power.taper, channels.count) ** 2
    return float(channels.width * np.sum(taper * temperature**2) / np.sum(taper * omega_pp / omega_p**2 / volume))


def _mean(values: np.ndarray) -> Finding:
    """Return the mean of independent samples and its standard error."""
    return Finding(float(values.mean()), float(values.std(ddof=1) / np.sqrt(values.size)))
