"""Step 2.3: flagged samples: they must not matter, and those that are left must be calibrated without bias.

*influence*: the data are calibrated twice, with other values under the flags; the largest difference of any gain, model
or residual is to be exactly zero.

*bias*: foregrounds and noise are calibrated for two realizations of the noise. What both residuals share is no
noise: the mean of Re R_even* R_odd over unflagged samples, in units of its standard error (each baseline one sample),
is what gain errors leave of the foregrounds.
"""

from __future__ import annotations

import numpy as np
from pyuvdata import UVData

from calstudy.calibrate.calamity import calibrate
from calstudy.calibrate.records import CalibrationResult
from calstudy.calibrate.settings import CalibrationSettings
from calstudy.claims.statement import Finding
from calstudy.graph.tasks import PARITIES
from calstudy.stages.files import read_visibilities
from calstudy.validation.evidence import Evidence, Measurement
from calstudy.validation.scene import first_integrations
from calstudy.validation.signal import clustered_mean
from calstudy.visibilities import flag_cube, to_cube

HUGE = 1e6


def measure(evidence: Evidence) -> Measurement:
    """Return the largest influence, and the largest bias in sigma, of all patterns of flags."""
    name, count = evidence.only, evidence.parameters["integrations"]
    settings = evidence.calibration(name)
    data = {
        parity: first_integrations(read_visibilities(evidence.folder(name, parity) / "data.uvh5"), count)
        for parity in PARITIES
    }
    sky = first_integrations(read_visibilities(evidence.folder(name, "foregrounds") / "visibilities.uvh5"), count)
    influence, biases, remarks = 0.0, {}, []
    for pattern, flags in patterns(data["even"]).items():
        results = {parity: calibrate(flagged(uvd, flags), settings, sky) for parity, uvd in data.items()}
        influence = max(influence, _influence(data["even"], flags, results["even"], settings, sky))
        biases[pattern] = bias(results["even"].residual, results["odd"].residual)
        statuses = {record.status for result in results.values() for record in result.solutions}
        remarks.append(
            f"{pattern} ({100 * flags.mean():.0f} % flagged): bias {biases[pattern].value:.2f} sigma, "
            f"{', '.join(sorted(statuses))}"
        )
    worst = max(biases.values(), key=lambda finding: abs(finding.value))
    return Measurement(
        {"influence": Finding(influence, 0.0), "bias": Finding(abs(worst.value), worst.uncertainty)}, tuple(remarks)
    )


def patterns(data: UVData) -> dict[str, np.ndarray]:
    """Return the patterns of flags, (Ntimes, Nbls, Nfreqs) each: single channels, bands, 30 % at random."""
    shape = to_cube(data).shape[:3]
    single, bands = np.zeros(shape, bool), np.zeros(shape, bool)
    single[..., [shape[2] // 5, shape[2] // 2, (4 * shape[2]) // 5]] = True
    for start in (shape[2] // 4, (2 * shape[2]) // 3):
        bands[..., start : start + max(2, shape[2] // 32)] = True
    random = np.random.default_rng(7).random(shape) < 0.3
    return {"single channels": single, "bands": bands, "30 % at random": random}


def flagged(data: UVData, flags: np.ndarray, value: complex | None = None) -> UVData:
    """Return a copy of data with these flags, and with `value` under them if it is given."""
    changed = data.copy()
    flag_cube(changed)[flags] = True
    if value is not None:
        to_cube(changed)[flags] = value
    return changed


def _influence(
    data: UVData, flags: np.ndarray, result: CalibrationResult, settings: CalibrationSettings, sky: UVData
) -> float:
    largest = 0.0
    for value in (HUGE * (1 + 2j), complex(np.nan, np.nan)):
        other = calibrate(flagged(data, flags, value), settings, sky)
        for mine, its in (
            (result.gains.gain_array, other.gains.gain_array),
            (result.model.data_array, other.model.data_array),
            (result.residual.data_array, other.residual.data_array),
        ):
            largest = max(largest, float(np.abs(mine - its).max()))
    return largest


def bias(even: UVData, odd: UVData) -> Finding:
    """Return the mean of Re R_even* R_odd over unflagged samples in units of its standard error."""
    used = ~(flag_cube(even) | flag_cube(odd))
    product = np.where(used, (to_cube(even).conj() * to_cube(odd)).real, np.nan)
    # One sample per baseline: its times and channels share gains and model.
    samples = product.transpose(1, 0, 2, 3).reshape(product.shape[1], -1)
    found = clustered_mean(samples)
    return Finding(found.value / found.uncertainty, 1.0)
