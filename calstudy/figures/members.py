"""Members of a collection side by side: their bias, and their spectra by solver."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.base.errors import InputError
from calstudy.figures import Drawing, StudyFigure, members_of
from calstudy.figures.comparison import look
from calstudy.figures.spherical import (
    Marking,
    SphericalColumn,
    add_legend,
    draw_band,
    draw_points,
    legend_entries,
    read_column,
    shifted,
)
from calstudy.plotting import style
from calstudy.products.score import score
from calstudy.results.reader import Tables
from calstudy.run.task import Job
from calstudy.verdicts.tolerances import SPHERICAL_RULES, Drawn, Rules, own_error

if TYPE_CHECKING:
    from calstudy.power.score import Score
    from calstudy.power.spectra import SphericalSpectrum


def draw_member_bias(members: Mapping[str, Score]) -> style.Figure:
    """Draw |bias| against k, or, where it is within its 95 % error, the 95 % upper limit as an open symbol."""
    figure = style.new_figure(style.TWO_COLUMNS, 3.4)
    axes = figure.subplots()
    for place, member in enumerate(members.values()):
        # Points are side by side within a bin, because members limited by the same noise coincide.
        width = np.diff(member.k).min() if member.k.size > 1 else 0.0
        k = member.k + (place / len(members) - 0.5) * 0.6 * width
        size, error = np.abs(member.bias), SIGMAS_95 * member.bias_error
        # Where the error is not known, the point has no bar.
        seen, its = ~(size <= error), look(place)
        points = {"color": its["color"], "marker": its["marker"], "linestyle": ""}
        axes.plot(k, np.where(seen, size, size + error), color=its["color"], linestyle=its["linestyle"], linewidth=0.4)
        axes.errorbar(k[seen], size[seen], yerr=error[seen], elinewidth=0.6, **points)
        axes.plot(k[~seen], (size + error)[~seen], markerfacecolor="white", **points)
    axes.axhline(1, color=style.GREY, linewidth=0.7, linestyle="--", zorder=0)
    axes.set_yscale("log")
    axes.set_xlabel(style.WAVENUMBER)
    axes.set_ylabel(r"$|s^2 P^{R_0} / P^S|$")
    handles = [style.entry(linewidth=0.6, **look(place)) for place in range(len(members))]
    handles.append(style.entry(color=style.GREY, marker="o", markerfacecolor="white", linestyle=""))
    figure.legend(handles, [*members, "open: 95 % upper limit"], loc="outside right upper")
    return figure


class MemberBiasFigure(StudyFigure):
    """The foregrounds that calibration leaves over the EoR, for every member of a collection."""

    version: ClassVar[int] = 2

    kind: str = "member-bias"
    of = ("collection",)
    reads: ClassVar = {"score": score}
    caption = (
        "Absolute value of the bias of each member outside the wedge with 95 % bars; open symbols: 95 % upper limit "
        "where it is not above its error. The dashed line is the EoR."
    )
    tolerances: ClassVar[Rules] = ((r".*\.bias", Drawn(own_error, "noise and what calibration leaves")),)

    def draw(self, job: Job) -> Drawing:
        """Draw all members."""
        members = {name: Tables((found["score"],)).score for name, found in members_of(job).items()}
        shown = {
            name: {"k": found.k, "bias": found.bias, "bias_error": found.bias_error} for name, found in members.items()
        }
        return Drawing(draw_member_bias(members), shown)


ROWS = {"residual": r"$|P^{R}|$", "residual_without_eor": r"$|P^{R}|$, no EoR"}
SOLVERS = (
    Marking("the paper's solver", "D", style.BLUE, 2.5, -0.12),
    Marking("the default solver", "s", style.ORANGE, 2.6, 0.12),
)
LAST_K = 1.0
"""End of the axes of k, h/Mpc."""
ARRAYS = {
    "Minimally redundant": ("paper_solver", "minimally_redundant"),
    "Redundant": ("redundant_paper_solver", "redundant"),
}
"""The roles of the members with either solver, in the order of `SOLVERS`."""


def draw_solver_comparison(arrays: Mapping[str, tuple[SphericalColumn, SphericalColumn]]) -> style.Figure:
    """Draw P^R, and below it P^R without EoR, of two solvers: a column for each array.

    Markers are at |P|, open where P is negative; bars are 95 % (1.96 σ); the grey band is P^S ± 1.96 σ; the dotted line
    is 1.96 σ of the thermal noise. `arrays` has, by title, the spectra with the paper's solver and with the default
    one; power in mK² h⁻³ Mpc³, k in h/Mpc.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 5.6)
    figure.set_layout_engine("constrained", hspace=0.02, wspace=0.02)
    grid = figure.subplots(2, len(arrays), sharex=True, sharey="row", squeeze=False)
    for column, (title, solvers) in zip(grid.T, arrays.items(), strict=True):
        for axes, name in zip(column, ROWS, strict=True):
            _draw_panel(axes, solvers, name)
        column[0].set_title(title)
        column[-1].set_xlabel(style.WAVENUMBER)
    shown = [column for solvers in arrays.values() for column in solvers]
    first = min(_first_k(column.eor) for column in shown)
    for row, name in zip(grid, ROWS, strict=True):
        row[0].set(xscale="log", yscale="log", xlim=(0.9 * first, LAST_K), ylim=_limits(shown, name))
        row[0].set_ylabel(rf"{ROWS[name]} ({style.POWER_UNIT})")
        style.label_one_two_five(row[0].xaxis)
    noise = {"thermal noise, 95%": style.entry(linestyle=":", color=style.GREY, linewidth=0.9)}
    add_legend(figure, legend_entries(SOLVERS, noise), ncols=5)
    return figure


def _draw_panel(axes: style.Axes, solvers: Sequence[SphericalColumn], name: str) -> None:
    draw_band(axes, solvers[0].eor)
    noise: SphericalSpectrum = getattr(solvers[0], name)
    axes.plot(noise.k, SIGMAS_95 * noise.noise_error, ":", color=style.GREY, linewidth=0.9, zorder=1, label="noise")
    for place, (column, marking) in enumerate(zip(solvers, SOLVERS, strict=True)):
        draw_points(axes, getattr(column, name), marking, f"{name}, {marking.label}", 2 + place)


def _first_k(spectrum: SphericalSpectrum) -> float:
    """Return the k of the leftmost point, with its shift."""
    left = shifted(spectrum, min(marking.shift for marking in SOLVERS))
    return float(left[np.isfinite(spectrum.power.real)].min())


def _limits(shown: Sequence[SphericalColumn], name: str) -> tuple[float, float]:
    """Return limits from below the noise to above EoR and residuals."""
    used = [getattr(column, name) for column in shown]
    low = min(np.nanmedian(SIGMAS_95 * spectrum.noise_error) for spectrum in used)
    tops = [np.abs(spectrum.power.real) + SIGMAS_95 * spectrum.error for spectrum in used]
    highest = max(float(np.nanmax(top[spectrum.k <= LAST_K])) for top, spectrum in zip(tops, used, strict=True))
    bands = [column.eor.power.real + SIGMAS_95 * column.eor.error for column in shown]
    return 0.1 * float(low), 2 * max(highest, *(float(np.nanmax(band)) for band in bands))


class SolverComparison(StudyFigure):
    """P^R outside the wedge with the paper's solver and the default one, with EoR and without, of one array or both.

    The members in the roles `paper_solver` and `redundant_paper_solver` have the paper's solver, those in the roles
    `minimally_redundant` and `redundant` the default one. An array is shown if both of its roles are played.
    """

    kind: str = "solver-comparison"

    of = ("collection",)
    caption = "Residual power outside the wedge with the paper's solver and the default one: with EoR, and without."
    titles: ClassVar[Mapping[str, str]] = {role: title for title, roles in ARRAYS.items() for role in roles}
    tolerances = SPHERICAL_RULES

    def roles(self, played: Collection[str]) -> Sequence[str]:
        """Return the roles of the arrays that are shown; those of the first array if no array has both."""
        shown = [roles for roles in ARRAYS.values() if all(role in played for role in roles)]
        return [role for roles in shown or [next(iter(ARRAYS.values()))] for role in roles]

    def draw(self, job: Job) -> Drawing:
        """Draw a column for each array."""
        columns = {role: self._read(job, role) for role in self.roles(job.settings["layouts"])}
        arrays = {title: (columns[own], columns[minimum]) for title, (own, minimum) in ARRAYS.items() if own in columns}
        return Drawing(draw_solver_comparison(arrays), columns)

    def _read(self, job: Job, role: str) -> SphericalColumn:
        found = read_column(job.inputs[f"spectra:{role}"], self.titles[role], "outside-wedge")
        shown = found.series(tuple(ROWS))
        if missing := [name for name in ROWS if name not in shown]:
            raise InputError(f"figure {self.label!r}: the member in the role {role} has no variant {missing[0]}")
        return SphericalColumn(found.title, found.eor, **shown)
