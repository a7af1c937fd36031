"""The bias of every member of a collection against k."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from calstudy.base.constants import SIGMAS_95
from calstudy.figures import Drawing, StudyFigure, members_of
from calstudy.figures.comparison import look
from calstudy.plotting import style
from calstudy.products.graph import Graph, required
from calstudy.products.score import score
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, Rules

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class MemberBias:
    """Bias of a calibration outside the wedge, s^2 P^R0 / P^S, (Nk,), free of the flux scale s.

    The error is by leaving out antennas; NaN in bins of one baseline or group. `k` are the centres of the bins, h/Mpc.
    """

    k: np.ndarray
    bias: np.ndarray
    bias_error: np.ndarray


def read_member(folder: Path) -> MemberBias:
    """Read the bias of a member from its scores."""
    from calstudy.results.reader import Tables

    bins = Tables((folder,)).score
    return MemberBias(bins.k, bins.bias, bins.bias_error)


@style.journal_style()
def draw_member_bias(members: Mapping[str, MemberBias]) -> Figure:
    """Draw |bias| against k, or, where it is within its 95 % error, the 95 % upper limit as an open symbol."""
    from matplotlib.lines import Line2D

    figure = style.new_figure(style.TWO_COLUMNS, 3.4)
    axes = figure.subplots()
    for place, member in enumerate(members.values()):
        # Points are side by side within a bin, because members limited by the same noise coincide.
        k = member.k + (place / len(members) - 0.5) * 0.6 * np.diff(member.k).min()
        size, error = np.abs(member.bias), SIGMAS_95 * member.bias_error
        seen, its = size > error, look(place)
        points = {"color": its["color"], "marker": its["marker"], "linestyle": ""}
        axes.plot(k, np.where(seen, size, size + error), color=its["color"], linestyle=its["linestyle"], linewidth=0.4)
        axes.errorbar(k[seen], size[seen], yerr=error[seen], elinewidth=0.6, **points)
        axes.plot(k[~seen], (size + error)[~seen], markerfacecolor="white", **points)
    axes.axhline(1, color=style.GREY, linewidth=0.7, linestyle="--", zorder=0)
    axes.set_yscale("log")
    axes.set_xlabel(style.WAVENUMBER)
    axes.set_ylabel(r"$|s^2 P^{R_0} / P^S|$")
    handles = [Line2D([], [], linewidth=0.6, **look(place)) for place in range(len(members))]
    handles.append(Line2D([], [], color=style.GREY, marker="o", markerfacecolor="white", linestyle=""))
    figure.legend(handles, [*members, "open: 95 % upper limit"], loc="outside right upper")
    return figure


def _error(reference: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    return reference[f"{name.removesuffix('.bias')}.bias_error"]


class MemberBiasFigure(StudyFigure):
    """The foregrounds that calibration leaves over the EoR, for every member of a collection."""

    version: ClassVar[int] = 2

    kind: str = "member-bias"
    of = ("collection",)
    caption = (
        "Absolute value of the bias of each member outside the wedge with 95 % bars; open symbols: 95 % upper limit "
        "where it is not above its error. The dashed line is the EoR."
    )
    tolerances: ClassVar[Rules] = ((r".*\.bias", Drawn(_error, "noise and what calibration leaves")),)

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the scores of a member."""
        return {"score": required(score(graph))}

    def draw(self, job: Job) -> Drawing:
        """Draw all members."""
        members = {name: read_member(found["score"]) for name, found in members_of(job).items()}
        return Drawing(draw_member_bias(members), members)
