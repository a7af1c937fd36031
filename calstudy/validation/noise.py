r"""Step 0.0: noise alone, whose power is known from its standard deviation.

For white noise of standard deviation sigma (Jy, complex) per integration, N_t integrations averaged, and a taper T, the
noise power of one baseline is

    P_N = dnu sum_nu T^2 s^2 / sum_nu T^2 (Omega_pp / Omega_p^2) / (X^2 Y),   s = sigma / sqrt(N_t) in mK,

which is the familiar X^2 Y Omega_eff T^2 dnu; X and Y are taken at the band's own channels. Even times odd have
independent noise, so that Re and Im of their product have mean zero and standard deviation P_N / sqrt(2).

Baselines have independent noise. Means and mean squares of a baseline's delays are the samples, from whose scatter
come the sampling errors: correlations between delays, and the products' long tails, are in it.
"""

from __future__ import annotations

import numpy as np
from pydantic import TypeAdapter

from calstudy.claims.statement import Finding
from calstudy.corrupt.levels import Levels
from calstudy.instrument.beams import make_beam
from calstudy.instrument.settings import Beam, Channels
from calstudy.power.cosmology import make_cosmology, radial_scale, redshift, transverse_scale
from calstudy.power.delay import make_taper
from calstudy.power.estimate import kelvin_per_jansky
from calstudy.power.settings import PowerSettings
from calstudy.validation.evidence import Evidence, Measurement


def measure(evidence: Evidence) -> Measurement:
    """Return the scatter of the estimates over the theory's, and the means of Re and Im in units of P_N."""
    name = evidence.only
    spectra = evidence.spectra(name, "noise")
    theory = noise_power(evidence.experiments[name]["instrument"], evidence.power(name), evidence.levels(name))
    products = spectra.power * np.sqrt(spectra.n_pairs)[:, None] / theory
    square = _mean(np.mean(products.real**2, axis=1))
    scatter = np.sqrt(2 * square.value)
    return Measurement(
        {
            "scatter_over_theory": Finding(scatter, scatter * square.uncertainty / (2 * square.value)),
            "mean_real": _mean(products.real.mean(axis=1)),
            "mean_imaginary": _mean(products.imag.mean(axis=1)),
        },
        (f"P_N of one baseline: {theory:.4g} mK2 h-3 Mpc3; {len(products)} baselines or groups",),
    )


def noise_power(instrument: dict, power: PowerSettings, levels: Levels) -> float:
    """Return P_N of one baseline in mK2 h-3 Mpc3, as in the module's text.

    Parameters
    ----------
    instrument
        The `instrument` section as in its file.
    power
        Taper and cosmology.
    levels
        Gives sigma.
    """
    channels = Channels.model_validate(instrument["channels"])
    frequencies = channels.first + channels.width * np.arange(channels.count)
    beam = make_beam(TypeAdapter(Beam).validate_python(instrument["beam"]), channels)
    omega_p, omega_pp = beam.solid_angles(frequencies, instrument["polarizations"][0])
    sigma = levels.noise_std / np.sqrt(instrument["times"]["count"])
    temperature = 1e3 * sigma * kelvin_per_jansky(frequencies, omega_p, None)
    cosmology = make_cosmology(power.cosmology)
    volume = (
        np.array([transverse_scale(cosmology, z) ** 2 * radial_scale(cosmology, z) for z in redshift(frequencies)])
        * cosmology.h**3
    )
    taper = make_taper(power.taper, channels.count) ** 2
    return float(channels.width * np.sum(taper * temperature**2) / np.sum(taper * omega_pp / omega_p**2 / volume))


def _mean(values: np.ndarray) -> Finding:
    """Return the mean of independent samples and its standard error."""
    return Finding(float(values.mean()), float(values.std(ddof=1) / np.sqrt(values.size)))
