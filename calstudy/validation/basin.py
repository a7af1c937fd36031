"""Step 2.2: from how far away does the solver find the minimum, and does its status say when it does not?

The true gains are g = (1 + sigma (n + i n')) exp(2 pi i (nu - nu_0) tau), n and n' normal in every channel and tau of
each antenna uniform between 0 and the largest delay; the fit starts from unity. It has arrived where the misfit
V - g_a g_b* F is not above that of a fit to data without gain errors, which starts at the truth.
"""

from __future__ import annotations

import csv

import numpy as np

from calstudy.claims.statement import Finding
from calstudy.figures.basin import Basin, draw_basin
from calstudy.figures.save import figure_arrays, save_figure
from calstudy.validation.evidence import Evidence, Measurement
from calstudy.validation.scene import Scene, rms

ARRIVED = 1.1
"""A fit has arrived if its misfit is below this times that of a fit from the truth."""
COLUMNS = ("gain error", "largest delay [s]", "status", "steps", "misfit over floor", "message")


def measure(evidence: Evidence) -> Measurement:
    """Write the table basin.csv and the figure, and return how far the basin goes and how often a status is false.

    Parameters
    ----------
    evidence
        `parameters`: `gain_errors`, `delays` (s), and optionally how many `antennas` and `channels` are used.
    """
    name = evidence.only
    scene = Scene.of(evidence, name)
    errors, delays = (np.array(evidence.parameters[key], float) for key in ("gain_errors", "delays"))
    floor = _fit(scene, 0.0, 0.0)[1]
    cells = {(error, delay): _fit(scene, error, delay) for error in errors for delay in delays}
    ratio = np.array([[cells[error, delay][1] / floor for delay in delays] for error in errors])
    converged = np.array([[cells[error, delay][0].status == "converged" for delay in delays] for error in errors])
    with (evidence.output / "basin.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for (error, delay), (record, misfit) in cells.items():
            writer.writerow([error, delay, record.status, record.n_steps, misfit / floor, record.message])
    basin = Basin(errors, delays, ratio, converged, ARRIVED)
    save_figure(draw_basin(basin), figure_arrays(basin), evidence.output, "basin")
    return Measurement(_findings(basin), _remarks(basin))


def _fit(scene: Scene, error: float, delay: float):
    """Return how a fit to data with these gain errors went, and its misfit, Jy."""
    rng = np.random.default_rng(11)
    shape = (2, scene.structure.n_antennas, scene.structure.n_frequencies)
    noise = rng.standard_normal((2, *scene.modelled.shape)) / np.sqrt(2) * scene.noise_std
    normal, turns = rng.standard_normal(shape), rng.uniform(0, delay, scene.structure.n_antennas)
    frequencies = scene.foregrounds.freq_array - scene.foregrounds.freq_array.mean()
    gains = (1 + error * (normal[0] + 1j * normal[1])) * np.exp(2j * np.pi * turns[:, None] * frequencies)
    visibilities = scene.products(gains) * scene.modelled + noise[0] + 1j * noise[1]
    result = scene.calibrate(visibilities)
    return result.solutions[0], rms(scene.misfit(result, visibilities))


def _findings(basin: Basin) -> dict[str, Finding]:
    arrived = basin.misfit < ARRIVED
    without_delay = arrived[:, np.argmin(basin.delays)]
    paper = int(np.argmin(np.abs(basin.gain_errors - 0.1)))
    return {
        "false_convergence": Finding(float(np.sum(basin.converged & ~arrived)), 0.0),
        "missed_convergence": Finding(float(np.sum(~basin.converged & arrived)), 0.0),
        "paper_case": Finding(float(basin.misfit[paper, np.argmin(basin.delays)]), 0.0),
        "largest_gain_error": Finding(float(basin.gain_errors[without_delay].max(initial=0.0)), 0.0),
        "arrived": Finding(float(arrived.mean()), 0.0),
    }


def _remarks(basin: Basin) -> tuple[str, ...]:
    sentences = []
    for error, misfits, converged in zip(basin.gain_errors, basin.misfit, basin.converged, strict=True):
        cells = ", ".join(
            f"{1e9 * delay:.0f} ns {misfit:.3g}{'' if said else ' (not converged)'}"
            for delay, misfit, said in zip(basin.delays, misfits, converged, strict=True)
        )
        sentences.append(f"gain error {error:g}, misfit over floor at delays up to {cells}")
    return tuple(sentences)
