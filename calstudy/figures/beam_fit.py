"""Check of the beam: its smooth fit in frequency against the table, and other interpolations against the fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, get_args

import numpy as np

from calstudy.base.plugins import Plugin
from calstudy.experiment.model import Experiment
from calstudy.figures import Drawing, StudyFigure
from calstudy.instrument.beam_models.tables import MwaEmbeddedBeam
from calstudy.instrument.settings import Channels, InstrumentSettings
from calstudy.plotting import style
from calstudy.products.graph import Graph
from calstudy.run.task import Job, Task

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calstudy.instrument.beams import GriddedBeam

INTERPOLATIONS = get_args(MwaEmbeddedBeam.model_fields["interpolation"].annotation)
SMOOTH = INTERPOLATIONS[0]
INTERPOLATION_COLOURS = {
    "chebyshev": style.BLUE,
    "cubic": style.GREEN,
    "linear": style.ORANGE,
    "nearest": style.RED,
}
"""One colour for each interpolation in every figure."""


@dataclass(frozen=True)
class BeamInterpolation:
    """Differences between Jones components, relative to the zenith, over directions, feeds and components.

    `fit_rms` and `fit_max` are differences of the smooth fit from the table at the `tabulated` frequencies within the
    band, (Ntab,), Hz. `others` are rms differences of the other interpolations from the fit at `channels`, (Nfreqs,),
    Hz.
    """

    tabulated: np.ndarray
    fit_rms: np.ndarray
    fit_max: np.ndarray
    channels: np.ndarray
    others: dict[str, np.ndarray]


def not_tabulated(experiment: Experiment) -> str | None:
    """Return a refusal of a beam in closed form, which is not interpolated, or None."""
    if hasattr(experiment.instrument.beam, "interpolation"):
        return None
    return f"checks the fit of a beam, and {experiment.instrument.beam.label} is a formula, exact at every frequency"


def compare_interpolations(instrument: InstrumentSettings, step: int = 4) -> BeamInterpolation:
    """Compare a beam's fit with its table, and other interpolations with the fit at one of `step` channels."""
    beams = {name: interpolated(instrument.beam, instrument.channels, name) for name in INTERPOLATIONS}
    tabulated = beams[SMOOTH].tabulated_frequencies
    difference = _difference(beams[SMOOTH], beams["nearest"], tabulated)
    settings = instrument.channels
    channels = (settings.first + settings.width * np.arange(settings.count))[::step]
    return BeamInterpolation(
        tabulated=tabulated,
        fit_rms=_rms(difference),
        fit_max=np.abs(difference).max(axis=(0, 1, 3, 4)),
        channels=channels,
        others={
            name: _rms(_difference(beam, beams[SMOOTH], channels)) for name, beam in beams.items() if name != SMOOTH
        },
    )


def interpolated(beam: Plugin, channels: Channels, interpolation: str) -> GriddedBeam:
    """Return a tabulated beam, fitted over the channels, with one of `INTERPOLATIONS` between its frequencies."""
    from calstudy.instrument.beams import GriddedBeam, make_beam

    found = make_beam(beam.model_copy(update={"interpolation": interpolation}), channels)
    assert isinstance(found, GriddedBeam)
    return found


def _difference(beam: GriddedBeam, other: GriddedBeam, frequencies: np.ndarray) -> np.ndarray:
    """Return J - J', (2, Nfeeds, Nfreqs, Nza, Naz)."""
    return beam.at(frequencies).data_array - other.at(frequencies).data_array


def _rms(difference: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(np.abs(difference) ** 2, axis=(0, 1, 3, 4)))


@style.journal_style()
def draw_interpolations(found: BeamInterpolation, stand_ins: Sequence[str] = ()) -> Figure:
    """Draw differences of Jones components, relative to the zenith, against frequency."""
    figure = style.new_figure(style.ONE_COLUMN, 2.9)
    axes = figure.subplots()
    blue = INTERPOLATION_COLOURS["chebyshev"]
    axes.plot(
        found.tabulated / 1e6, found.fit_max, "^", color=blue, markerfacecolor="white", label="fit − table, largest"
    )
    axes.plot(found.tabulated / 1e6, found.fit_rms, "o", color=blue, label="fit − table, rms")
    for name, rms in found.others.items():
        axes.plot(
            found.channels / 1e6, rms, color=INTERPOLATION_COLOURS[name], linewidth=0.8, label=f"{name} − fit, rms"
        )
    axes.set(yscale="log", xlabel=style.FREQUENCY, ylabel=r"$|\Delta J|\,/\,|J_\mathrm{zenith}|$")
    axes.margins(x=0.01)
    figure.legend(loc="outside upper center", ncols=2)
    style.note_stand_ins(figure, stand_ins)
    return figure


class BeamFitFigure(StudyFigure):
    """The smooth fit of a tabulated beam in frequency against its table, and other interpolations against the fit."""

    caption = "Interpolations of the beam in frequency: differences of Jones components over the zenith."
    sections = ("instrument",)

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return nothing: the beam is read again."""
        del graph
        return {}

    def refusal(self, experiment: Experiment) -> str | None:
        """Refuse a beam in closed form."""
        return not_tabulated(experiment)

    def draw(self, job: Job) -> Drawing:
        """Compare the interpolations."""
        found = compare_interpolations(job.settings["instrument"])
        rms = {name: float(np.sqrt(np.mean(values**2))) for name, values in found.others.items()}
        fit = {"rms": float(np.sqrt(np.mean(found.fit_rms**2))), "largest": float(found.fit_max.max())}
        return Drawing(draw_interpolations(found, job.settings["notes"]), found, {"fit": fit, "rms_to_fit": rms})
