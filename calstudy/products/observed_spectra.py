"""Power spectra of measured data: wedge and spherical averages, with errors from the measured noise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from calstudy.base.errors import InputError
from calstudy.base.resources import Cost
from calstudy.products.files import spectrum_file, write_json
from calstudy.products.graph import once
from calstudy.products.observed import SOURCES, WHAT, ObservedGraph, noise_power, power_of
from calstudy.products.spectra import EXCISION, read_delay_spectra
from calstudy.run.task import Job, Stage, Task

if TYPE_CHECKING:
    import numpy as np

    from calstudy.power.spectra import DelaySpectra

NOISE_SUMMARY = "noise.json"


@once
def observed_spectra(graph: ObservedGraph) -> Task:
    """Return the task of the averaged spectra of all data in `WHAT`, and of the noise."""
    inputs = {what: power_of(graph, what) for what in WHAT}
    sources = SOURCES if graph.parts.autos else SOURCES[:1]
    for what in ("data", "residual"):
        inputs |= {f"noise of {what} from {source}": noise_power(graph, what, source) for source in sources}
    return Task(OBSERVED_SPECTRA, "wedge and spherical", {"power": graph.power}, inputs)


def average_spectra(job: Job) -> Mapping[str, Any]:
    """Write wedge and spherical spectra with errors as HDF5 and CSV, and the level of the noise to noise.json.

    The errors are those of the noise alone, from the difference of the halves on each baseline.
    """
    import numpy as np

    from calstudy.power.binned import cylindrical_average
    from calstudy.power.tables import save_spectrum

    settings = job.settings["power"]
    delays = {name: read_delay_spectra(folder) for name, folder in job.inputs.items()}
    levels = {
        what: {source: _levels(delays, what, source, settings.wedge_buffer) for source in SOURCES}
        for what in ("data", "residual")
    }
    for what in WHAT:
        if not np.isfinite(delays[what].power).any():
            raise InputError(f"{what}: all data are flagged, because no solve of the calibration gave gains")
        save_spectrum(job.output / spectrum_file(what, "wedge"), cylindrical_average(delays[what], settings))
        noise = "data" if what == "data" else "residual"
        level = next((found for found in levels[noise].values() if found is not None), None)
        if level is None:
            raise InputError(
                "power.wedge_buffer: no baseline has delays beyond |b|/c + buffer, from which the noise would be "
                "known; use a smaller one, or data with autocorrelations"
            )
        _write_spherical(job, what, delays, f"noise of {noise} from {SOURCES[0]}", level)
    noise_file = job.output / spectrum_file("noise", "wedge")
    save_spectrum(noise_file, cylindrical_average(delays[f"noise of residual from {SOURCES[0]}"], settings))
    summary = {what: _summary(**found) for what, found in levels.items()}
    write_json(job.output / NOISE_SUMMARY, summary)
    return {"noise": summary}


def _levels(delays: Mapping[str, DelaySpectra], what: str, source: str, buffer: float) -> np.ndarray | None:
    """Return P_N of each baseline, or None if it is not known from this source."""
    import numpy as np

    from calstudy.realdata.noise import noise_of_baselines

    name = f"noise of {what} from {source}"
    if name not in delays:
        return None
    found = noise_of_baselines(delays[name], buffer, everywhere=source == "autos")
    return found if np.isfinite(found).any() else None


def _write_spherical(
    job: Job, what: str, delays: Mapping[str, DelaySpectra], noise_name: str, level: np.ndarray
) -> None:
    from dataclasses import replace

    from calstudy.power.binned import modes_in_bins, spherical_average
    from calstudy.power.errors import noise_error, with_errors
    from calstudy.power.tables import save_spectrum, write_csv
    from calstudy.realdata.noise import noise_of_units

    settings, spectra = job.settings["power"], delays[what]
    of_units = noise_of_units(spectra, delays[noise_name], level)
    for modes, excise in EXCISION.items():
        spectrum = with_errors(spherical_average(spectra, settings, excise))
        bins = modes_in_bins(spectra, settings, excise)
        spectrum = replace(spectrum, noise_error=noise_error(spectra, bins, spectrum.k.size, of_units))
        save_spectrum(job.output / spectrum_file(what, modes), spectrum)
        write_csv(job.output / f"{what}.{modes}.csv", spectrum)


def _summary(difference: np.ndarray | None, autos: np.ndarray | None) -> dict[str, Any]:
    """Return the mean P_N over baselines from each source, and the ratio of the two."""
    import numpy as np

    found: dict[str, Any] = {}
    for name, levels in (("difference", difference), ("autos", autos)):
        found[name] = None if levels is None else float(np.nanmean(levels))
    if difference is not None and autos is not None:
        ratio = difference / autos
        ratio = ratio[np.isfinite(ratio)]
        found["difference_over_autos"] = {
            "mean": float(ratio.mean()),
            "error": float(ratio.std() / math.sqrt(ratio.size)),
            "lowest": float(ratio.min()),
            "highest": float(ratio.max()),
        }
    return found


OBSERVED_SPECTRA = Stage(name="observed-spectra", version=1, make=average_spectra, cost=lambda task: Cost(10, disk=5e6))
