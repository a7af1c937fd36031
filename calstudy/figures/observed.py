"""Figures of measured data: spherical and cylindrical power spectra, and the signal loss by injection."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.figures import Drawing, StudyFigure
from calstudy.figures.signal_loss import SignalLoss, draw_loss
from calstudy.figures.spherical import Marking, draw_points, magnitudes
from calstudy.figures.wedge import draw_wedge
from calstudy.plotting import style
from calstudy.products.graph import MeasuredGraph, required
from calstudy.products.observed_injection import expected_loss, transfer
from calstudy.products.observed_results import observed_spectra
from calstudy.products.signal_loss import REGIONS
from calstudy.results.reader import Tables
from calstudy.run.task import Job, Task
from calstudy.verdicts.standing import HIGHEST, LOWEST
from calstudy.verdicts.tolerances import Drawn, half

if TYPE_CHECKING:
    from calstudy.power.spectra import SphericalSpectrum


MARKINGS = {
    "data": Marking("data as given", "D", style.RED, 2.5, -0.15),
    "calibrated": Marking("calibrated", "o", style.BLACK, 2.8),
    "residual": Marking("residual", "s", style.ORANGE, 2.8, 0.15),
}
COLUMNS = {"all-modes": "all modes", "outside-wedge": "outside wedge + {:.0f} ns"}


def draw_observed(columns: Mapping[str, Mapping[str, SphericalSpectrum]], buffer: float) -> style.Figure:
    """Draw |P| of measured data, mK² h⁻³ Mpc³, with 95 % bars of the noise, open where negative; see `COLUMNS`.

    The grey line is one standard deviation of the noise of the residual. The wedge ends `buffer`, s, above the horizon.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 3.4)
    grid = figure.subplots(1, len(columns), sharex=True, sharey=True, squeeze=False)[0]
    for axes, (modes, series) in zip(grid, columns.items(), strict=True):
        for place, (name, marking) in enumerate(MARKINGS.items()):
            draw_points(axes, series[name], marking, name, 2 + place)
        residual, known = series["residual"], np.isfinite(series["residual"].noise_error)
        axes.plot(residual.k[known], residual.noise_error[known], color=style.GREY, linewidth=0.9, zorder=1)
        axes.set_title(COLUMNS[modes].format(1e9 * buffer))
        axes.set(xlabel=style.WAVENUMBER, xscale="log", yscale="log", ylim=_limits(columns))
        style.label_one_two_five(axes.xaxis)
    grid[0].set_ylabel(rf"$|P(k)|$ ({style.POWER_UNIT})")
    entries = {
        mark.label: style.entry(linestyle="none", marker=mark.marker, color=mark.colour) for mark in MARKINGS.values()
    }
    entries[r"noise of the residual, 1 $\sigma$"] = style.entry(color=style.GREY)
    entries[r"open: $P < 0$"] = style.entry(linestyle="none", **style.OPEN_MARKER)
    figure.legend(list(entries.values()), list(entries), loc="outside upper center", ncols=len(entries))
    return figure


def _limits(columns: Mapping[str, Mapping[str, SphericalSpectrum]]) -> tuple[float, float]:
    """Return limits that hold all powers, but the faintest few points, which are noise about zero."""
    spectra = [spectrum for series in columns.values() for spectrum in series.values()]
    values = magnitudes(spectra)
    errors = np.concatenate([series["residual"].noise_error for series in columns.values()])
    return 0.3 * float(min(np.quantile(values, 0.03), np.nanmin(errors) * SIGMAS_95)), 4 * float(values.max())


class ObservedSpherical(StudyFigure):
    """Spherical power spectra of measured data."""

    kind: str = "observed-spherical"

    of = ("observed",)
    reads: ClassVar = {"spectra": observed_spectra}
    caption = (
        "Spherical power spectra of the measured data, even x odd, with 95 % bars of the noise alone; open where "
        "negative."
    )
    tolerances = ((r".*\.(power|noise_error)", Drawn(half, "follows from fitted gains; half of it")),)

    def draw(self, job: Job) -> Drawing:
        """Draw a column for each choice of modes."""
        tables = Tables((job.inputs["spectra"],))
        columns = {modes: {name: tables.spherical(name, modes) for name in MARKINGS} for modes in COLUMNS}
        figure = draw_observed(columns, job.settings["wedge_buffer"])
        return Drawing(figure, {modes.replace("-", "_"): series for modes, series in columns.items()})


TITLES = {
    "data": "data as given",
    "calibrated": "calibrated",
    "residual": "residual",
    "noise": r"noise, $P_N$",
}


class ObservedWedge(StudyFigure):
    """Cylindrical power spectra of measured data."""

    kind: str = "observed-wedge"

    of = ("observed",)
    reads: ClassVar = {"spectra": observed_spectra}
    caption = (
        "Cylindrical power spectra of the measured data: as given, calibrated, the residual, and the power of their "
        "noise from the difference of the two halves; negative values in blue."
    )
    tolerances = ((r".*\.power", Drawn(half, "follows from fitted gains; half of it")),)

    def draw(self, job: Job) -> Drawing:
        """Draw a panel for each spectrum."""
        tables = Tables((job.inputs["spectra"],))
        found = {name: tables.wedge(name) for name in TITLES}
        figure = draw_wedge(found, TITLES, job.settings["wedge_buffer"])
        return Drawing(figure, found)


def draw_observed_loss(loss: SignalLoss, buffer: float) -> style.Figure:
    """Draw T as in `calstudy.figures.signal_loss`, with the expectation outside the wedge as a line."""
    where = f"wedge + {1e9 * buffer:.0f} ns"
    figure, axes = draw_loss(loss, f"injected, {{}} {where}", buffer)
    if loss.expected is not None:
        label = f"expected of the fit, outside {where}"
        axes.plot(loss.expected.k, loss.expected.outside, color=style.BLUE, linewidth=0.9, label=label)
    # All that counts as measured.
    axes.set_ylim(LOWEST - 0.02, HIGHEST + 0.02)
    axes.legend(loc="lower right")
    return figure


class ObservedSignalLoss(StudyFigure):
    """The transfer function of the calibration of measured data."""

    kind: str = "observed-signal-loss"

    of = ("observed",)
    caption = (
        "What the calibration of these data leaves of an EoR that is put into them: T per k, with what the fit "
        "predicts, and per baseline length and delay."
    )
    needs_injection = True
    shows_sky = False
    tolerances = ((r".*\.(transfer|cross_transfer|squared_coherence)", Drawn(half, "half of it")),)

    def inputs(self, graph: MeasuredGraph) -> Mapping[str, Task]:
        """Return measurement and expectation."""
        prediction = expected_loss(graph)
        return {"transfer": required(transfer(graph)), **({"expected": prediction} if prediction else {})}

    def draw(self, job: Job) -> Drawing:
        """Draw T per k and per (|b|, tau)."""
        tables = Tables(tuple(job.inputs.values()))
        outside, inside = (tables.transfer(region) for region in REGIONS)
        expected = tables.expected_transfer if "expected" in job.inputs else None
        loss = SignalLoss(outside, inside, tables.transfer_map(), expected)
        return Drawing(draw_observed_loss(loss, job.settings["wedge_buffer"]), loss)
