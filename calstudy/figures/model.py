"""The fitted foreground model against the true foregrounds of one baseline (the paper's Fig. MODEL_RESID)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from calstudy.figures import Drawing, StudyFigure
from calstudy.figures.gains import inspected, inspected_calibration
from calstudy.plotting import style
from calstudy.plotting.visibility_comparison import (
    Visibilities,
    VisibilityComparison,
    compare_visibilities,
    draw_comparison,
)
from calstudy.products import corruption, simulation
from calstudy.products.files import DATA, MODEL, VISIBILITIES
from calstudy.products.graph import Graph, required
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, rms_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@style.journal_style()
def draw_model(comparison: VisibilityComparison, stand_ins: Sequence[str] = ()) -> Figure:
    """Draw true foregrounds F (the reference) and their fitted model F̂, both without gains."""
    return draw_comparison(comparison, (r"true foregrounds $F$", r"fitted model $\widehat{F}$"), stand_ins)


class Model(StudyFigure):
    """True and fitted foregrounds of one baseline in one integration."""

    caption = "Foregrounds of one baseline: true and fitted."
    variants = ("residual", "noise")
    needs_calibration = True
    tolerances = (
        (r"(model|residual)\..*", Drawn(rms_of("residual"), "the rms error of the model")),
        (r"noise\..*", Drawn(rms_of("noise"), "the rms of the noise")),
    )

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return gains, calibration, true foregrounds and noise."""
        experiment = graph.experiment
        noise = corruption.data(graph, experiment.variants["noise"], experiment.outputs.inspect.realization)
        return {**inspected_calibration(graph), "foregrounds": required(simulation.foregrounds(graph)), "noise": noise}

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the shown baseline and integration."""
        return inspected(graph)

    def draw(self, job: Job) -> Drawing:
        """Draw the true foregrounds of a baseline and the fitted ones, on the scale of the true gains."""
        from calstudy.products.selection import (
            baseline,
            layout_of,
            read_aligned_gains,
            read_spectra,
            read_used,
            require_used,
        )

        integration = job.settings["integration"]
        pair, length = baseline(layout_of(job.settings["layout"]), job.settings["antennas"])
        gains = read_aligned_gains(job.inputs["gains"], job.inputs["calibration"], integration)
        paths = (
            job.inputs["foregrounds"] / VISIBILITIES,
            job.inputs["calibration"] / MODEL,
            job.inputs["noise"] / DATA,
        )
        used = read_used(paths[1], [pair])[0, integration]
        require_used(used, pair, integration)
        foregrounds, model, noise = (used * read_spectra(path, [pair])[0, integration] for path in paths)
        shown = Visibilities(foregrounds, model / gains.scale**2, noise)
        comparison = compare_visibilities(pair, length, gains.frequency, shown)
        return Drawing(draw_model(comparison, stand_ins=job.settings["notes"]), comparison)
