"""Step 2.2: how far away the solver finds the minimum from, and whether its status says when it does not.

The true gains are g = (1 + sigma (n + i n')) exp(2 pi i (nu - nu_0) tau), n and n' normal in every channel and tau of
each antenna uniform between 0 and the largest delay; the fit starts from unity. It has arrived where the misfit
V - g_a g_b* F is not above that of a fit to data without gain errors, which starts at the truth.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from pydantic import Field

from calstudy.base.units import Delay
from calstudy.corrupt.levels import rms
from calstudy.plotting import style
from calstudy.plotting.save import figure_arrays, save_figure
from calstudy.validation.measurement import Findings, Inputs
from calstudy.validation.single_integration import SingleIntegration, SingleIntegrationMeasurement
from calstudy.verdicts.criterion import Finding

if TYPE_CHECKING:
    from calstudy.calibrate.records import SolveRecord

ARRIVED = 1.1
"""A fit has arrived if its misfit is below this times that of a fit from the truth."""
COLUMNS = ("gain error", "largest delay [s]", "status", "steps", "misfit over floor", "message")
COLOURS = "cividis"
LARGEST = 10.0
"""Misfits over the floor beyond this have the last colour."""


@dataclass(frozen=True)
class Basin:
    """How fits from unity ended, by what the true gains were.

    Attributes
    ----------
    gain_errors, delays
        Standard deviation per channel (Ne,), and largest cable delay in s (Nd,), ascending.
    misfit
        rms of V - g_a g_b* F over that of a fit that starts at the truth, (Ne, Nd).
    converged
        Whether the status said so, (Ne, Nd).
    arrived
        A fit with a misfit below this has found the minimum.
    """

    gain_errors: np.ndarray
    delays: np.ndarray
    misfit: np.ndarray
    converged: np.ndarray
    arrived: float


class BasinOfConvergence(SingleIntegrationMeasurement):
    """How far from the truth a fit may start, and how often its status is false."""

    gain_errors: Annotated[tuple[float, ...], Field(strict=False, min_length=1)] = Field(
        description="Standard deviations per channel, ascending."
    )
    delays: Annotated[tuple[Delay, ...], Field(strict=False, min_length=1)] = Field(
        description="Largest cable delays, ascending."
    )

    def measure(self, inputs: Inputs) -> Findings:
        """Fit data with all these gain errors; write the table basin.csv and the figure."""
        integration = self.integration(inputs)
        floor = _fit(integration, 0.0, 0.0)[1]
        pairs = [(error, delay) for error in self.gain_errors for delay in self.delays]
        fits = {pair: _fit(integration, *pair) for pair in pairs}
        shape = (len(self.gain_errors), len(self.delays))
        basin = Basin(
            gain_errors=np.array(self.gain_errors),
            delays=np.array(self.delays),
            misfit=np.reshape([fits[pair][1] / floor for pair in pairs], shape),
            converged=np.reshape([fits[pair][0].status == "converged" for pair in pairs], shape),
            arrived=ARRIVED,
        )
        with (inputs.output / "basin.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(COLUMNS)
            for (error, delay), (record, misfit) in fits.items():
                writer.writerow([error, delay, record.status, record.n_steps, misfit / floor, record.message])
        save_figure(draw_basin(basin), figure_arrays(basin), inputs.output, "basin")
        return Findings(_findings(basin), _remarks(basin))


def _fit(integration: SingleIntegration, error: float, delay: float) -> tuple[SolveRecord, float]:
    """Return how a fit to data with these gain errors went, and its misfit, Jy."""
    rng = np.random.default_rng(11)
    shape = (2, integration.structure.n_antennas, integration.structure.n_frequencies)
    noise = rng.standard_normal((2, *integration.modelled.shape)) / np.sqrt(2) * integration.noise_std
    normal, turns = rng.standard_normal(shape), rng.uniform(0, delay, integration.structure.n_antennas)
    frequencies = integration.foregrounds.freq_array - integration.foregrounds.freq_array.mean()
    gains = (1 + error * (normal[0] + 1j * normal[1])) * np.exp(2j * np.pi * turns[:, None] * frequencies)
    visibilities = integration.products(gains) * integration.modelled + noise[0] + 1j * noise[1]
    result = integration.calibrate(visibilities)
    return result.solutions[0], rms(integration.misfit(result, visibilities))


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


@style.journal_style()
def draw_basin(basin: Basin) -> Figure:
    """Draw the misfit of each fit as colour and number, and what its status said as a symbol."""
    figure = style.new_figure(style.ONE_COLUMN, 3.0)
    axes = figure.subplots()
    shown = np.clip(basin.misfit, 1.0, LARGEST)
    mesh = axes.pcolormesh(shown, norm=LogNorm(1.0, LARGEST), cmap=COLOURS, edgecolor="white", linewidth=0.5)
    for row, column in np.ndindex(basin.misfit.shape):
        misfit = basin.misfit[row, column]
        colour = "white" if misfit < LARGEST**0.5 else style.BLACK
        marker = "o" if basin.converged[row, column] else "x"
        axes.plot(column + 0.5, row + 0.62, marker, color=colour, markersize=4, fillstyle="none")
        axes.text(
            column + 0.5, row + 0.3, f"{misfit:.2f}", color=colour, fontsize=style.NOTE_SIZE, ha="center", va="center"
        )
    axes.set_xticks(np.arange(len(basin.delays)) + 0.5, [f"{1e9 * delay:.0f}" for delay in basin.delays])
    axes.set_yticks(np.arange(len(basin.gain_errors)) + 0.5, [f"{error:g}" for error in basin.gain_errors])
    axes.tick_params(length=0)
    axes.set(xlabel="largest cable delay (ns)", ylabel="gain error per channel")
    bar = figure.colorbar(mesh, ax=axes, extend="max", pad=0.02, aspect=25)
    bar.set_label("misfit over that of a fit from the truth")
    handles = [
        Line2D([], [], color=style.BLACK, marker=marker, linestyle="", markersize=4, fillstyle="none", label=label)
        for marker, label in (("o", "status: converged"), ("x", "status: not converged"))
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
    return figure
