"""The bias of every member of a collection against k."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from calstudy.figures import ComparisonFigure, Drawing
from calstudy.figures.comparison_spectra import look
from calstudy.figures.signal_loss import SIGMAS_95
from calstudy.plotting import style
from calstudy.products.files import spectrum_file
from calstudy.products.graph import Graph, required
from calstudy.products.signal_loss import TRANSFER, transfer
from calstudy.products.spectra import spectra
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, Rules

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MODES = "outside-wedge"


@dataclass(frozen=True)
class MemberBias:
    """Bias of a calibration outside the wedge.

    Attributes
    ----------
    k
        Centres of the bins, h/Mpc, (Nk,).
    bias
        s^2 P^R0 / P^S, (Nk,): the residual without EoR over the EoR, free of the flux scale s.
    bias_error
        Its standard deviation by the thermal noise, (Nk,).
    """

    k: np.ndarray
    bias: np.ndarray
    bias_error: np.ndarray


def read_member(spectra_folder: Path, transfer_folder: Path) -> MemberBias:
    """Read the bias of a member.

    Parameters
    ----------
    spectra_folder, transfer_folder
        Products of the stages `spectra` and `transfer`.
    """
    from calstudy.power.spectra import SphericalSpectrum
    from calstudy.power.tables import load_spectrum
    from calstudy.power.transfer import TransferFunction

    names = ("eor", "residual_without_eor")
    eor, residual = (load_spectrum(spectra_folder / spectrum_file(name, MODES), SphericalSpectrum) for name in names)
    scale = load_spectrum(transfer_folder / spectrum_file(TRANSFER, MODES), TransferFunction).flux_scale
    unit = scale**2 / eor.power.real
    return MemberBias(eor.k, unit * residual.power.real, unit * residual.noise_error)


@style.journal_style()
def draw_member_bias(members: Mapping[str, MemberBias], stand_ins: Sequence[str] = ()) -> Figure:
    """Draw |bias| against k, and where it is not above the noise its 95 % upper limit as an open symbol.

    Parameters
    ----------
    members
        By name.
    stand_ins
        See `calstudy.plotting.style.note_stand_ins`.
    """
    from matplotlib.lines import Line2D

    figure = style.new_figure(style.TWO_COLUMNS, 3.4)
    axes = figure.subplots()
    for place, member in enumerate(members.values()):
        # Beside each other within a bin: what is limited by the same noise is the same.
        k = member.k + (place / len(members) - 0.5) * 0.6 * np.diff(member.k).min()
        size, noise = np.abs(member.bias), SIGMAS_95 * member.bias_error
        seen, its = size > noise, look(place)
        points = {"color": its["color"], "marker": its["marker"], "linestyle": ""}
        axes.plot(k, np.where(seen, size, size + noise), color=its["color"], linestyle=its["linestyle"], linewidth=0.4)
        axes.errorbar(k[seen], size[seen], yerr=noise[seen], elinewidth=0.6, **points)
        axes.plot(k[~seen], (size + noise)[~seen], markerfacecolor="white", **points)
    axes.axhline(1, color=style.GREY, linewidth=0.7, linestyle="--", zorder=0)
    axes.set_yscale("log")
    axes.set_xlabel(style.WAVENUMBER)
    axes.set_ylabel(r"$s^2 P^{R_0} / P^S$")
    handles = [Line2D([], [], linewidth=0.6, **look(place)) for place in range(len(members))]
    figure.legend(handles, list(members), loc="outside right upper")
    style.note_stand_ins(figure, stand_ins)
    return figure


def _error(reference: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    return reference[f"{name.removesuffix('.bias')}.bias_error"]


class MemberBiasFigure(ComparisonFigure):
    """What calibration leaves of the foregrounds over the EoR, for every member of a collection."""

    titles: ClassVar[Mapping[str, str]] = {}
    caption = (
        "Bias of each member outside the wedge with 95 % bars; open: 95 % upper limit where it is not above the noise. "
        "The dashed line is the EoR."
    )
    tolerances: ClassVar[Rules] = ((r".*\.bias", Drawn(_error, "thermal noise")),)

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return spectra and transfer function of a member."""
        return {"spectra": spectra(graph), "transfer": required(transfer(graph))}

    def draw(self, job: Job) -> Drawing:
        """Draw all members."""
        names = [name.removeprefix("spectra:") for name in job.inputs if name.startswith("spectra:")]
        members = {name: read_member(job.inputs[f"spectra:{name}"], job.inputs[f"transfer:{name}"]) for name in names}
        return Drawing(draw_member_bias(members, job.settings["notes"]), members)
