"""Step 2.2: the distance from which the solver finds the minimum, and whether its status is right if it does not.

The true gains are g = (1 + sigma (n + i n')) exp(2 pi i (nu - nu_0) tau), n and n' normal in every channel and tau of
each antenna uniform between 0 and the largest delay. Fits start from unity, and from the results of other
`initial_gains`. A fit has arrived if the misfit V - g_a g_b* F is not above that of a fit to the same data that starts
at the true gains.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from pydantic import Field

from calstudy.base.schema import Section
from calstudy.base.table import Table
from calstudy.base.units import Delay
from calstudy.calibrate.settings import InitialGains, UnityStart
from calstudy.corrupt.levels import rms
from calstudy.plotting import style
from calstudy.plotting.style import figure_arrays, save_figure
from calstudy.validation.step import Findings, Limit, StepInput
from calstudy.validation.steps.single_fit import SingleIntegration, SingleIntegrationStep
from calstudy.verdicts.criterion import AtMost, Finding

if TYPE_CHECKING:
    from calstudy.calibrate.records import CalibrationResult

ARRIVED = 1.1
"""A fit has arrived if its misfit is below this times that of a fit from the true gains."""
LONG_CABLES = 0.4
"""Gain errors per channel up to which a start that fits delays must succeed for cables of any length."""
COLUMNS = ("start", "gain error", "largest delay [s]", "status", "steps", "misfit over floor", "message")
COLOURS = "cividis"
LARGEST = 10.0
"""Misfits over the floor beyond this have the last colour."""


class Start(Section):
    """The start of the fits."""

    initial_gains: InitialGains = UnityStart()
    sky_model: bool = Field(True, description="Whether the fit has the foregrounds as its sky model.")


@dataclass(frozen=True)
class Basin:
    """Results of the fits, by start and true gains.

    `gain_errors` are standard deviations per channel (Ne,), and `delays` are the largest cable delays in s (Nd,), both
    ascending. `floor`, (Ne, Nd), is the rms of V - g_a g_b* F of a fit that starts at the true gains over that of the
    noise. `misfit`, (Ns, Ne, Nd), is the rms of V - g_a g_b* F over that of a fit that starts at the true gains,
    and `converged`, (Ns, Ne, Nd), is the status. A fit with a misfit below `arrived` has found the minimum.
    """

    starts: tuple[str, ...]
    gain_errors: np.ndarray
    delays: np.ndarray
    floor: np.ndarray
    misfit: np.ndarray
    converged: np.ndarray
    arrived: float


def _unity() -> dict[str, Start]:
    return {"unity": Start()}


class BasinOfConvergence(SingleIntegrationStep):
    """The distance from the true gains at which a fit may start, and the number of false statuses."""

    version: ClassVar[int] = 3
    number = "2.2"
    proves = "the range of starting errors from which the fit converges, and that its status is correct everywhere"
    parameters: ClassVar = {
        "antennas": 16,
        "channels": 192,
        "gain_errors": [0.01, 0.1, 0.2, 0.4, 0.7, 1.0],
        "delays": ["0 ns", "30 ns", "100 ns", "200 ns", "300 ns", "500 ns", "1000 ns"],
        "starts": {
            "unity": {},
            "delays": {"initial_gains": "delays"},
            "delays without sky model": {"initial_gains": "delays", "sky_model": False},
        },
    }
    small_parameters: ClassVar = {
        "antennas": 8,
        "channels": 96,
        "gain_errors": [0.01, 0.1, 1.0],
        "delays": ["0 ns", "30 ns", "500 ns"],
    }
    limits: ClassVar = {
        "false_convergence": Limit(
            "number of fits with status 'converged' whose misfit is more than 10 % above that of a fit from the truth",
            AtMost(0),
            "a status must never be wrong",
        ),
        "floor": Limit(
            "misfit of fits from the truth over the rms of the noise, largest value",
            AtMost(1.1),
            "what fits are compared with must be at the noise; to 10 %, as above",
        ),
        "paper_case": Limit(
            "misfit over that of a fit from the truth, at the paper's gain errors of 0.1, from unity",
            AtMost(1.01),
            "the paper's case must be well inside the range of convergence",
        ),
        "out_of_reach": Limit(
            "number of fits from fitted delays, with gain errors up to 0.4, whose misfit is more than 10 % above that "
            "of a fit from the truth",
            AtMost(0),
            "a start that fits delays must bring cables of any length within reach",
        ),
    }

    gain_errors: Annotated[tuple[float, ...], Field(min_length=1)] = Field(
        description="Standard deviations per channel, ascending."
    )
    delays: Annotated[tuple[Delay, ...], Field(min_length=1)] = Field(description="Largest cable delays, ascending.")
    starts: Annotated[dict[str, Start], Field(min_length=1, max_length=3)] = Field(
        default_factory=_unity,
        description="By the names that they have in the figure; the first is that of the criteria.",
    )

    def measure(self, runs: Mapping[str, StepInput], output: Path) -> Findings:
        integration = self.integration(runs)
        fits, floors = {}, []
        for error, delay in itertools.product(self.gain_errors, self.delays):
            visibilities, gains = _data(integration, error, delay)
            floor = _misfit(integration, integration.calibrate(visibilities, start=gains), visibilities)
            floors.append(floor / rms(visibilities - integration.products(gains) * integration.modelled))
            for name, start in self.starts.items():
                settings = integration.settings.model_copy(update={"initial_gains": start.initial_gains})
                result = integration.calibrate(visibilities, settings, sky_model=start.sky_model)
                fits[name, error, delay] = result.solutions[0], _misfit(integration, result, visibilities) / floor
        cells = list(itertools.product(self.starts, self.gain_errors, self.delays))
        shape = (len(self.starts), len(self.gain_errors), len(self.delays))
        basin = Basin(
            starts=tuple(self.starts),
            gain_errors=np.array(self.gain_errors),
            delays=np.array(self.delays),
            floor=np.reshape(floors, shape[1:]),
            misfit=np.reshape([fits[cell][1] for cell in cells], shape),
            converged=np.reshape([fits[cell][0].status == "converged" for cell in cells], shape),
            arrived=ARRIVED,
        )
        found = ((cell, *fits[cell]) for cell in cells)
        rows = [(*cell, record.status, record.steps, misfit, record.message) for cell, record, misfit in found]
        Table(COLUMNS, rows).write_csv(output / "basin.csv")
        save_figure(draw_basin(basin), figure_arrays(basin), output, "basin")
        return Findings(_findings(basin), tuple(_remarks(rows)))


def _data(integration: SingleIntegration, error: float, delay: float) -> tuple[np.ndarray, np.ndarray]:
    """Return data with these gain errors, Jy, (Nbls, Nfreqs), and the gains, (Nants, Nfreqs)."""
    rng = np.random.default_rng(11)
    shape = (2, integration.structure.n_antennas, integration.structure.n_frequencies)
    noise = rng.standard_normal((2, *integration.modelled.shape)) / np.sqrt(2) * integration.noise_std
    normal, turns = rng.standard_normal(shape), rng.uniform(0, delay, integration.structure.n_antennas)
    frequencies = integration.foregrounds.freq_array - integration.foregrounds.freq_array.mean()
    gains = (1 + error * (normal[0] + 1j * normal[1])) * np.exp(2j * np.pi * turns[:, None] * frequencies)
    return integration.products(gains) * integration.modelled + noise[0] + 1j * noise[1], gains


def _misfit(integration: SingleIntegration, result: CalibrationResult, visibilities: np.ndarray) -> float:
    return rms(integration.misfit(result, visibilities))


def _findings(basin: Basin) -> dict[str, Finding]:
    arrived = basin.misfit < ARRIVED
    without_delay = arrived[0, :, np.argmin(basin.delays)]
    paper = int(np.argmin(np.abs(basin.gain_errors - 0.1)))
    found = {
        "false_convergence": Finding(float(np.sum(basin.converged & ~arrived)), 0.0),
        "missed_convergence": Finding(float(np.sum(~basin.converged & arrived)), 0.0),
        "floor": Finding(float(basin.floor.max()), 0.0),
        "paper_case": Finding(float(basin.misfit[0, paper, np.argmin(basin.delays)]), 0.0),
        "largest_gain_error": Finding(float(basin.gain_errors[without_delay].max(initial=0.0)), 0.0),
        "arrived": Finding(float(arrived[0].mean()), 0.0),
    }
    if len(basin.starts) > 1:
        small = basin.gain_errors <= LONG_CABLES
        found["out_of_reach"] = Finding(float(np.sum(~arrived[1:, small])), 0.0)
    return found


def _remarks(rows: Sequence[tuple]) -> Iterator[str]:
    for (start, error), cells in itertools.groupby(rows, key=operator.itemgetter(0, 1)):
        told = ", ".join(
            f"{1e9 * delay:.0f} ns {misfit:.3g}{'' if status == 'converged' else ' (not converged)'}"
            for _, _, delay, status, _, misfit, _ in cells
        )
        yield f"from {start}, gain error {error:g}, misfit over floor at delays up to {told}"


@style.journal_style()
def draw_basin(basin: Basin) -> Figure:
    """Draw the misfit of each fit as colour and number, and its status as a symbol, with one panel per start."""
    figure = style.new_figure(style.ONE_COLUMN if len(basin.starts) == 1 else style.TWO_COLUMNS, 3.0)
    panels = figure.subplots(1, len(basin.starts), sharey=True, squeeze=False)[0]
    for axes, name, misfit, converged in zip(panels, basin.starts, basin.misfit, basin.converged, strict=True):
        mesh = _draw_panel(axes, misfit, converged)
        axes.set_xticks(np.arange(len(basin.delays)) + 0.5, [f"{1e9 * delay:.0f}" for delay in basin.delays])
        axes.tick_params(length=0)
        axes.set(xlabel="largest cable delay (ns)", title=f"from {name}")
    panels[0].set_yticks(np.arange(len(basin.gain_errors)) + 0.5, [f"{error:g}" for error in basin.gain_errors])
    panels[0].set_ylabel("gain error per channel")
    bar = figure.colorbar(mesh, ax=panels.tolist(), extend="max", pad=0.02, aspect=25)
    bar.set_label("misfit over that of a fit from the truth")
    handles = [
        Line2D([], [], color=style.BLACK, marker=marker, linestyle="", markersize=4, fillstyle="none", label=label)
        for marker, label in (("o", "status: converged"), ("x", "status: not converged"))
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
    return figure


def _draw_panel(axes: Axes, misfit: np.ndarray, converged: np.ndarray) -> QuadMesh:
    shown = np.clip(misfit, 1.0, LARGEST)
    mesh = axes.pcolormesh(shown, norm=LogNorm(1.0, LARGEST), cmap=COLOURS, edgecolor="white", linewidth=0.5)
    for row, column in np.ndindex(misfit.shape):
        value = misfit[row, column]
        colour = "white" if value < LARGEST**0.5 else style.BLACK
        marker = "o" if converged[row, column] else "x"
        axes.plot(column + 0.5, row + 0.62, marker, color=colour, markersize=4, fillstyle="none")
        label = f"{value:.2f}" if value < 100 else f"{value:.0f}"
        axes.text(column + 0.5, row + 0.3, label, color=colour, fontsize=style.NOTE_SIZE, ha="center", va="center")
    return mesh
