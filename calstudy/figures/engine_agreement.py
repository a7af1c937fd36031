"""Check of the engine: the foregrounds, and the same foregrounds simulated completely by another engine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.base.visibilities import baseline_vectors, from_cube, to_cube
from calstudy.corrupt.levels import rms
from calstudy.experiment.model import Experiment
from calstudy.figures import Drawing, StudyFigure
from calstudy.figures.beam_fit import NO_DELAY
from calstudy.plotting import style
from calstudy.power.delay import horizon_delay
from calstudy.products import simulation
from calstudy.products.files import VISIBILITIES, read_visibilities
from calstudy.products.graph import Graph, required
from calstudy.run.task import Job, Task
from calstudy.simulate.settings import ENGINES, SimulationSettings

if TYPE_CHECKING:
    from pyuvdata import UVData

    from calstudy.simulate.floor import DelayFloor, Taper

GROUPS = 6
SHORT_AND_LONG = (style.BLUE, style.RED)


@dataclass(frozen=True)
class GroupAgreement:
    """The difference of two simulations on the baselines of a range of lengths, m, in units of their `rms_jy`.

    `spectrum` and `difference` are the rms of the delay spectra of the visibilities and of their difference, over the
    largest of `spectrum`, at delays >= 0 in s, (Ndelays,) each.
    """

    shortest: float
    longest: float
    baselines: int
    rms_jy: float
    largest: float
    rms: float
    delay: np.ndarray
    spectrum: np.ndarray
    difference: np.ndarray


@dataclass(frozen=True)
class EngineAgreement:
    """Agreement of two simulations of the same foregrounds, of all visibilities and by ranges of baseline length.

    `largest` and `rms` are differences over the rms of the visibilities, `worst_slot` the largest of any integration
    and channel over the rms of that. `floors` and `differences` are delay floors of the visibilities and of the
    difference, by taper, relative to the same peaks.
    """

    groups: tuple[GroupAgreement, ...]
    largest: float
    rms: float
    worst_slot: float
    taper: Taper
    floors: dict[Taper, DelayFloor]
    differences: dict[Taper, DelayFloor]


def compare_simulations(foregrounds: UVData, reference: UVData) -> EngineAgreement:
    """Compare two simulations of the same sky, beam and observation, in Jy on equally spaced channels.

    Raises InputError if the band leaves no delays beyond the horizon of the longest baseline.
    """
    from calstudy.simulate.floor import delay_floor, floor_buffers

    buffers = floor_buffers(foregrounds)
    if not buffers:
        raise InputError(NO_DELAY)
    taper: Taper = "dolph-chebyshev" if "dolph-chebyshev" in buffers else next(iter(buffers))
    cube = to_cube(reference)
    difference = from_cube(foregrounds, to_cube(foregrounds) - cube)
    size = np.abs(to_cube(difference))
    level = rms(cube)
    slots = np.sqrt(np.mean(np.abs(cube) ** 2, axis=(1, 3)))
    return EngineAgreement(
        groups=_groups(reference, difference, taper),
        largest=float(size.max() / level),
        rms=rms(size) / level,
        worst_slot=float((size.max(axis=(1, 3)) / slots).max()),
        taper=taper,
        floors={name: delay_floor(reference, buffer, name, GROUPS) for name, buffer in buffers.items()},
        differences={name: delay_floor(difference, gap, name, GROUPS, reference) for name, gap in buffers.items()},
    )


def _groups(reference: UVData, difference: UVData, taper: Taper) -> tuple[GroupAgreement, ...]:
    from calstudy.simulate.floor import delay_profile, folded_spectrum, length_bins

    lengths = np.linalg.norm(baseline_vectors(reference), axis=1)
    edges, bins = length_bins(lengths, GROUPS)
    delays, power = delay_profile(reference, taper)
    _, power_of_difference = delay_profile(difference, taper)
    groups = []
    for index in np.unique(bins):
        members = bins == index
        visibilities, deviations = to_cube(reference)[:, members], np.abs(to_cube(difference)[:, members])
        delay, spectrum = folded_spectrum(delays, power[members].mean(axis=0))
        _, deviation = folded_spectrum(delays, power_of_difference[members].mean(axis=0))
        level = rms(visibilities)
        groups.append(
            GroupAgreement(
                shortest=float(edges[index]),
                longest=float(edges[index + 1]),
                baselines=int(members.sum()),
                rms_jy=level,
                largest=float(deviations.max() / level),
                rms=rms(deviations) / level,
                delay=delay,
                spectrum=np.sqrt(spectrum / spectrum.max()),
                difference=np.sqrt(deviation / spectrum.max()),
            )
        )
    return tuple(groups)


def draw_engine_agreement(
    agreement: EngineAgreement, names: Sequence[str], allowed: float, eor_level: float | None
) -> style.Figure:
    """Draw delay spectra of short and long baselines (left) and relative differences against baseline length (right).

    `names` are those of the engine and of the reference, `allowed` is the sum of the node tolerances of both, relative
    to the rms, and `eor_level` is in amplitude dB, or None.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 3.1)
    left, right = figure.subplots(1, 2)
    groups = agreement.groups
    for group, colour in zip((groups[0], groups[-1]), SHORT_AND_LONG, strict=True):
        _draw_spectra(left, group, colour)
    if eor_level is not None:
        left.axhline(eor_level, color=style.BLACK, linewidth=0.6, label="EoR asked for")
    left.set(xlabel=style.DELAY, ylabel="brightness relative to peak (dB)")
    left.margins(x=0)
    left.legend(loc="upper right", frameon=True, framealpha=0.95, edgecolor="none")
    shortest, longest = zip(*((group.shortest, group.longest) for group in groups), strict=True)
    for name, line in (("largest", "-"), ("rms", "--")):
        values = [getattr(group, name) for group in groups]
        right.hlines(values, shortest, longest, color=style.BLUE, linestyle=line, linewidth=1.2, label=name)
    right.axhline(allowed, color=style.GREY, linestyle="-.", linewidth=0.8, label="sum of node tolerances")
    right.set(yscale="log", xlabel=style.BASELINE_LENGTH, ylabel=f"|{names[0]} − {names[1]}| / rms")
    right.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, columnspacing=1.0)
    return figure


def _draw_spectra(axes: style.Axes, group: GroupAgreement, colour: str) -> None:
    span = f"{group.shortest:.0f} to {group.longest:.0f} m"
    for values, line, label in ((group.spectrum, "-", f"F, {span}"), (group.difference, ":", f"difference, {span}")):
        level = 10 * np.log10(np.maximum(values, np.finfo(float).tiny))
        axes.plot(group.delay * 1e9, level, line, color=colour, linewidth=0.9, label=label)
    axes.axvline(horizon_delay(group.longest) * 1e9, color=colour, linestyle="--", linewidth=0.6)


class EngineAgreementFigure(StudyFigure):
    """The foregrounds against the same foregrounds from another engine, by baseline length and in delay."""

    kind: str = "engine-agreement"

    caption = "Foregrounds of two simulation engines: difference in delay and by baseline length."
    needs_foregrounds = True

    against: str = Field("pyuvsim", description="The engine that is compared with.")
    node_tolerance: float | None = Field(
        None, gt=0, lt=1e-2, description="`simulation.nodes.tolerance` of that engine; by default the experiment's."
    )
    tolerance: float | None = Field(
        None, gt=0, description="The run warns if any visibility differs by more, in units of the rms."
    )

    def refusal(self, experiment: Experiment) -> str | None:
        """Refuse an experiment without foregrounds, or of the same engine."""
        same = ENGINES.make(self.against) == experiment.simulation.engine
        refusal = f"compares {self.against} with itself: simulation.engine is the same" if same else None
        return super().refusal(experiment) or refusal

    def _simulation(self, own: SimulationSettings) -> SimulationSettings:
        nodes = own.nodes.model_copy(update={"tolerance": self.node_tolerance or own.nodes.tolerance})
        return own.model_copy(update={"engine": ENGINES.make(self.against), "nodes": nodes})

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return the foregrounds from both engines."""
        experiment = graph.experiment
        other = Graph(experiment.model_copy(update={"simulation": self._simulation(experiment.simulation)}))
        return {"own": required(simulation.foregrounds(graph)), "against": required(simulation.foregrounds(other))}

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the names of the engines, the sum of the tolerances of their nodes, and the level of the EoR."""
        both = (graph.experiment.simulation, self._simulation(graph.experiment.simulation))
        return {
            "engines": [item.engine.label for item in both],
            "node_tolerances": sum(item.nodes.tolerance for item in both if item.nodes.enabled),
            "eor_level": graph.experiment.corruption.eor_level,
        }

    def draw(self, job: Job) -> Drawing:
        """Compare the two simulations."""
        own, other = (read_visibilities(job.inputs[name] / VISIBILITIES) for name in ("own", "against"))
        found = compare_simulations(own, other)
        names, allowed, level = (job.settings[name] for name in ("engines", "node_tolerances", "eor_level"))
        figure = draw_engine_agreement(found, names, allowed, level)
        beyond = self.tolerance is not None and found.largest > self.tolerance
        text = f"{' and '.join(names)} differ by {found.largest:.1e} of the rms, more than {self.tolerance}"
        numbers = {name: getattr(found, name) for name in ("largest", "rms", "worst_slot")}
        return Drawing(figure, found, {**numbers, "warnings": [text] if beyond else []})
