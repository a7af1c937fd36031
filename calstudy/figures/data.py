"""Uncalibrated data against the fitted gains times foregrounds (the paper's Fig. CALIBRATED_RESID)."""

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
from calstudy.products import corruption
from calstudy.products.files import DATA, MODEL
from calstudy.products.graph import Graph
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, rms_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@style.journal_style()
def draw_data(comparison: VisibilityComparison, stand_ins: Sequence[str] = ()) -> Figure:
    """Draw data V (the reference) and the model visibility ĝ_a ĝ_b* F̂, with the thermal noise of the data."""
    return draw_comparison(comparison, (r"data $V$", r"model $\hat{g}_a\hat{g}_b^*\widehat{F}$"), stand_ins)


class Data(StudyFigure):
    """Data of one baseline and the fitted gains times model, in one integration."""

    caption = "Data of one baseline, fitted gains times model, and what is left."
    variants = ("residual", "noise")
    needs_calibration = True
    tolerances = ((r".*", Drawn(rms_of("noise"), "the rms of the noise")),)

    def inputs(self, graph: Graph) -> Mapping[str, Task]:
        """Return gains, calibration, data and noise."""
        experiment = graph.experiment
        data, noise = (
            corruption.data(graph, experiment.variants[name], experiment.outputs.inspect.realization)
            for name in ("residual", "noise")
        )
        return {**inspected_calibration(graph), "data": data, "noise": noise}

    def settings(self, graph: Graph) -> Mapping[str, Any]:
        """Return the shown baseline and integration."""
        return inspected(graph)

    def draw(self, job: Job) -> Drawing:
        """Draw the data of a baseline with fitted gains times model, and with the noise in them."""
        from calstudy.products.selection import baseline, layout_of, read_gains, read_spectra, read_used, require_used

        integration = job.settings["integration"]
        pair, length = baseline(layout_of(job.settings["layout"]), job.settings["antennas"])
        paths = (job.inputs["data"] / DATA, job.inputs["calibration"] / MODEL, job.inputs["noise"] / DATA)
        used = read_used(paths[1], [pair])[0, integration]
        require_used(used, pair, integration)
        data, model, noise = (used * read_spectra(path, [pair])[0, integration] for path in paths)
        true, fitted = read_gains(job.inputs["gains"]), read_gains(job.inputs["calibration"])
        both = (true.at(integration, pair), fitted.at(integration, pair))
        corruption_factor, correction = (gains[0] * gains[1].conj() for gains in both)
        shown = Visibilities(data, correction * model, corruption_factor * noise)
        comparison = compare_visibilities(pair, length, fitted.frequency, shown)
        return Drawing(draw_data(comparison, stand_ins=job.settings["notes"]), comparison)
