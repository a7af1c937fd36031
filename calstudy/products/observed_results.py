"""Results of measured data: power spectra with errors from the measured noise, and the quality of the calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.table import Table
from calstudy.calibrate.interface import Calibrator
from calstudy.calibrate.settings import GainFit
from calstudy.power.binned import cylindrical_average, modes_in_bins, noise_error, spherical_average, with_errors
from calstudy.power.spectra import of_common_units
from calstudy.power.tables import save_spectrum, write_csv
from calstudy.products.calibration import prepared_fit, read_result
from calstudy.products.files import DATA, read_json, read_visibilities, spectrum_file, write_json
from calstudy.products.graph import MeasuredGraph, memoize, size_of
from calstudy.products.observed import SOURCES, WHAT, calibrated, noise_power, observed, power_of, read_observed
from calstudy.products.spectra import EXCISION, read_delay_spectra
from calstudy.products.table import StudyTable
from calstudy.realdata.halves import PARITIES
from calstudy.run.task import Input, Inputs, Task, called

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.calibrate.records import CalibrationResult
    from calstudy.power.settings import PowerSettings
    from calstudy.power.spectra import DelaySpectra, SphericalSpectrum

NOISE_SUMMARY, QUALITY = "noise.json", "quality.json"
FIT_COLUMNS = ("half", "samples", "complex unknowns", "per sample", "per degree of freedom", "not fitted", "expected")
FIT_NOTE = (
    "chi^2 is the mean of |V - g g* F|^2 / sigma^2, with sigma by the radiometer equation from the autocorrelations: "
    "per sample, per degree of freedom (complex unknowns subtracted), and of integrations that were not fitted, from "
    "the solutions of the integrations before and after, with what noise alone would make of it."
)
NOISE_COLUMNS = ("of", "from the difference", "from the autocorrelations", "ratio, mean over baselines")
NOISE_NOTE = (
    "P_N, the mean over baselines of the power of the noise, in mK2 h-3 Mpc3: from the difference of the two halves, "
    "outside the wedge, and from the autocorrelations. The residual has less noise by what the fit absorbs; the "
    "difference of the data as given also has what the sky changes from one half to the other, times their gains."
)


@memoize
def observed_spectra(graph: MeasuredGraph) -> Task:
    """Return the task of the averaged spectra of all data in `WHAT`, and of the noise."""
    delays = {what: power_of(graph, what) for what in WHAT}
    sources = SOURCES if graph.parts.autos else SOURCES[:1]
    for what in ("data", "residual"):
        delays |= {f"noise of {what} from {source}": noise_power(graph, what, source) for source in sources}
    return ObservedSpectra("wedge and spherical", power=graph.experiment.power, delays=delays)


@memoize
def quality(graph: MeasuredGraph) -> Task:
    """Return the task that measures the quality of the calibration of all parts."""
    return ObservedQuality(
        "quality of the calibration",
        calibrator=graph.experiment.calibration.with_defaults("assumed"),
        autos=graph.parts.autos,
        interleaved=graph.parts.interleaved,
        sky_model=graph.experiment.observed.sky_model is not None,
        data={part: observed(graph, part) for part in graph.parts.facts},
        calibration={part: calibrated(graph, part) for part in graph.parts.facts},
    )


class ObservedTable(StudyTable):
    """The power spectra, and the quality of the calibration."""

    of = "observed"
    place = 1

    def products(self, graph: MeasuredGraph) -> Sequence[Task | None]:
        """Return the products."""
        return [observed_spectra(graph), quality(graph)]


class ObservedSpectra(Task, stage="observed-spectra", version=2, cost=Cost(10, disk=5e6)):
    """Wedge and spherical spectra; errors are those of the noise, from the difference of halves on each baseline."""

    power: PowerSettings
    delays: Inputs

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the spectra as HDF5 and CSV, and the level of the noise to noise.json."""
        delays = {name: read_delay_spectra(folder) for name, folder in self.delays.items()}
        buffer, noises = self.power.wedge_buffer, {}
        for what in ("data", "residual"):
            named = {source: f"noise of {what} from {source}" for source in SOURCES}
            noises[what] = {source: delays[name] for source, name in named.items() if name in delays}
        for what in WHAT:
            if not np.isfinite(delays[what].power).any():
                raise InputError(f"{what}: all data are flagged, because no solve of the calibration gave gains")
            save_spectrum(output / spectrum_file(what, "wedge"), cylindrical_average(delays[what], self.power))
            known = [
                (noise, level)
                for source, noise in noises["data" if what == "data" else "residual"].items()
                if (level := _levels(noise, source, buffer)) is not None
            ]
            if not known:
                raise InputError(
                    "power.wedge_buffer: no baseline has delays beyond |b|/c + buffer, from which the noise would be "
                    "known; use a smaller one, or data with autocorrelations"
                )
            for modes, spectrum in self._spherical(delays[what], *known[0]).items():
                save_spectrum(output / spectrum_file(what, modes), spectrum)
                write_csv(output / f"{what}.{modes}.csv", spectrum)
        noise_file = output / spectrum_file("noise", "wedge")
        save_spectrum(noise_file, cylindrical_average(noises["residual"][SOURCES[0]], self.power))
        summary = {what: _summary(found, buffer) for what, found in noises.items()}
        write_json(output / NOISE_SUMMARY, summary)
        return {"noise": summary}

    def shown(self, folder: Path) -> Sequence[Table]:
        """Return the level of the noise."""
        rows = []
        for what, levels in read_json(folder / NOISE_SUMMARY).items():
            powers = ("" if levels[source] is None else f"{levels[source]:.3g}" for source in SOURCES)
            name = "data as given" if what == "data" else what
            rows.append((name, *powers, _shown(levels.get("difference_over_autos"))))
        return [Table(NOISE_COLUMNS, rows, "Noise of the measured data", NOISE_NOTE)]

    def _spherical(self, spectra: DelaySpectra, noise: DelaySpectra, level: np.ndarray) -> dict[str, SphericalSpectrum]:
        """Return the spherical spectra by their modes, with errors by the noise of each baseline."""
        from calstudy.realdata.noise import noise_of_units

        of_units, found = noise_of_units(spectra, noise, level, self.power.redundancy_tolerance), {}
        for modes, excise in EXCISION.items():
            spectrum = with_errors(spherical_average(spectra, self.power, excise))
            bins = modes_in_bins(spectra, self.power, excise)
            found[modes] = replace(spectrum, noise_error=noise_error(spectra, bins, spectrum.k.size, of_units))
        return found


def _levels(noise: DelaySpectra, source: str, buffer: float) -> np.ndarray | None:
    """Return P_N of each baseline, or None if it is not known of any."""
    from calstudy.realdata.noise import noise_of_baselines

    found = noise_of_baselines(noise, buffer, everywhere=source == "autos")
    return found if np.isfinite(found).any() else None


def _summary(noises: Mapping[str, DelaySpectra], buffer: float) -> dict[str, Any]:
    """Return the mean P_N over baselines from each source, and the ratio of the two on the baselines of both.

    What is not known is None: a mean of no baseline, and the error of a single one.
    """
    found: dict[str, Any] = {}
    for source in SOURCES:
        level = _levels(noises[source], source, buffer) if source in noises else None
        found[source] = None if level is None else float(np.nanmean(level))
    if None in found.values():
        return found
    try:
        common = of_common_units(noises)
    except InputError:
        return found | {"difference_over_autos": None}
    # A baseline that both have may have no delays beyond the buffer.
    levels = [_levels(common[source], source, buffer) for source in SOURCES]
    ratio = np.zeros(0) if levels[0] is None or levels[1] is None else levels[0] / levels[1]
    ratio = ratio[np.isfinite(ratio)]
    return found | {
        "difference_over_autos": {
            "mean": float(ratio.mean()),
            "error": float(ratio.std() / math.sqrt(ratio.size)) if ratio.size > 1 else None,
            "lowest": float(ratio.min()),
            "highest": float(ratio.max()),
        }
        if ratio.size
        else None
    }


def _shown(ratio: Mapping[str, float | None] | None) -> str:
    """Return the text of a ratio with its error; empty without any."""
    if ratio is None:
        return ""
    error = ratio["error"]
    return f"{ratio['mean']:.3f} " + ("(error not known)" if error is None else f"± {error:.3f}")


class ObservedQuality(Task, stage="observed-quality", version=4):
    """The quality of a calibration: chi^2 against the noise, and outliers."""

    calibrator: Calibrator = called("calibration")
    autos: bool
    interleaved: bool
    sky_model: bool
    data: Mapping[str, Input]
    calibration: Mapping[str, Input]

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write chi^2 of each part, chi^2 of integrations that were not fitted, and outliers to quality.json."""
        from calstudy.realdata.quality import assess

        summary: dict[str, Any] = {}
        warnings = []
        data = {part: read_visibilities(folder / DATA) for part, folder in self.data.items()}
        results = {part: read_result(folder) for part, folder in self.calibration.items()}
        for part, result in results.items():
            found = [assess(data[part], result, index) for index in range(result.model.Npols)]
            prefix = f"{part}: " if len(results) > 1 else ""
            warnings += [f"{prefix}{sentence}" for item in found for sentence in item.warnings]
            summary[part] = {"quality": [item.described() for item in found], **self._chi_squared(part, data, results)}
        write_json(output / QUALITY, summary)
        return {
            "chi_squared": {
                part: {key: value for key, value in found.items() if key != "quality"}
                for part, found in summary.items()
            },
            "warnings": warnings,
        }

    def shown(self, folder: Path) -> Sequence[Table]:
        """Return chi^2 of all parts; no table without autocorrelations."""
        found = {part: item for part, item in read_json(folder / QUALITY).items() if item.get("samples")}
        rows = []
        for part, item in found.items():
            held = item.get("held_out", {})
            numbers = (item["per_sample"], item["per_degree_of_freedom"], held.get("per_sample"), held.get("expected"))
            unknowns = "" if item["unknowns"] is None else f"{item['unknowns']:g}"
            texts = ("" if number is None else f"{number:.3f}" for number in numbers)
            rows.append((part, str(item["samples"]), unknowns, *texts))
        return [Table(FIT_COLUMNS, rows, "Fit to the measured data", FIT_NOTE)] if rows else []

    def _chi_squared(
        self, part: str, data: Mapping[str, UVData], results: Mapping[str, CalibrationResult]
    ) -> dict[str, Any]:
        """Return chi^2 of one part, as fitted and with the solutions of the other; empty without autocorrelations."""
        from calstudy.realdata.quality import chi_squared, held_out, predicted

        if not self.autos:
            return {}
        total, samples = chi_squared(data[part], predicted(results[part].gains, results[part].model))
        unknowns = self._unknowns(part, results[part])
        found: dict[str, Any] = {
            "samples": samples,
            "unknowns": unknowns,
            "per_sample": total / samples if samples else None,
            "per_degree_of_freedom": None if unknowns is None or samples <= unknowns else total / (samples - unknowns),
        }
        if self.interleaved:
            other = results[PARITIES[1 - PARITIES.index(part)]]
            total, count = held_out(data[part], predicted(other.gains, other.model))
            found["held_out"] = {
                "samples": count,
                "per_sample": total / count if count else None,
                # The noise of the data, and that of the mean of two predictions.
                "expected": None if unknowns is None or not samples else 1 + 0.5 * unknowns / samples,
            }
        return found

    def _unknowns(self, part: str, result: CalibrationResult) -> float | None:
        """Return the number of complex unknowns of all solves of one part; None without least squares."""
        from calstudy.calibrate.preparation import make_problem
        from calstudy.realdata.quality import count_unknowns

        settings = self.calibrator
        if not isinstance(settings, GainFit):
            return None
        data, sky, noise = read_observed(self.data[part], settings, self.sky_model)
        prepared, total = prepared_fit(settings, data, sky, noise), 0.0
        polarizations = data.polarization_array.tolist()
        for record in result.solutions:
            if not record.usable:
                continue
            problem = make_problem(prepared, settings, record.times, polarizations.index(record.polarization))
            found = None if isinstance(problem, str) else count_unknowns(problem, settings)
            if found is None:
                return None
            total += found
        return total

    def _cost(self) -> Cost:
        samples = size_of(self).samples
        return Cost(10 + 1e-5 * samples, LIBRARIES_MEMORY + 20 * samples * COMPLEX128, 1e6)
