"""The injected EoR that a calibration of measured data leaves, beside the prediction of the fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.figures import Drawing, StudyFigure
from calstudy.figures.signal_loss import TRANSFER, draw_map, draw_transfer
from calstudy.plotting import style
from calstudy.products.expected_loss import EXPECTED, expected_loss
from calstudy.products.files import spectrum_file
from calstudy.products.graph import required
from calstudy.products.observed_injection import transfer
from calstudy.products.signal_loss import TRANSFER as FILE
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, half

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calstudy.power.expected import ExpectedBins
    from calstudy.power.transfer import TransferFunction, TransferMap
    from calstudy.products.graph import MeasuredGraph

MAX_DELAY = 2e-6
LAST_K = 1.5


@dataclass(frozen=True)
class ObservedLoss:
    """Transfer functions of a calibration of measured data.

    `outside` and `inside` the wedge are per |k| and `map` per baseline length and delay, by injection; `expected` is
    the prediction of the fit, None if not known.
    """

    outside: TransferFunction
    inside: TransferFunction
    map: TransferMap
    expected: ExpectedBins | None


@style.journal_style()
def draw_observed_loss(loss: ObservedLoss, buffer: float, stand_ins: Sequence[str] = ()) -> Figure:
    """Draw T per |k| on the left, with the expectation outside the wedge as a line, and per (|b|, tau) on the right.

    Bars are 95 % (1.96 sigma). The dashed line is the horizon plus `buffer`, s.
    """
    figure = style.new_figure(style.TWO_COLUMNS, 3.0)
    left, right = figure.subplots(1, 2, width_ratios=(1.2, 1.0))
    left.axhline(1.0, color=style.GREY, linewidth=0.7, zorder=0)
    where = f"wedge + {1e9 * buffer:.0f} ns"
    draw_transfer(left, loss.outside, f"injected, outside {where}", "o", style.BLUE)
    draw_transfer(left, loss.inside, f"injected, inside {where}", "s", style.ORANGE)
    if loss.expected is not None:
        label = f"expected of the fit, outside {where}"
        left.plot(loss.expected.k, loss.expected.outside, color=style.BLUE, linewidth=0.9, label=label)
    filled = np.isfinite(loss.outside.transfer) | np.isfinite(loss.inside.transfer)
    last = min(float(loss.outside.bin_edges[1:][filled].max(initial=0.1)), LAST_K)
    left.set(xlabel=style.WAVENUMBER, ylabel=TRANSFER, xlim=(0, last), ylim=(-0.03, 1.15))
    left.legend(loc="lower right")
    draw_map(figure, right, loss.map, buffer, MAX_DELAY)
    style.note_stand_ins(figure, stand_ins)
    return figure


class ObservedSignalLoss(StudyFigure):
    """The transfer function of the calibration of measured data."""

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
        from calstudy.power.expected import ExpectedBins
        from calstudy.power.tables import load_spectrum
        from calstudy.power.transfer import TransferFunction, TransferMap

        folder, prediction = job.inputs["transfer"], None
        if "expected" in job.inputs:
            prediction = load_spectrum(job.inputs["expected"] / EXPECTED, ExpectedBins)
        outside, inside = (
            load_spectrum(folder / spectrum_file(FILE, part), TransferFunction)
            for part in ("outside-wedge", "inside-wedge")
        )
        by_length = load_spectrum(folder / spectrum_file(FILE, "wedge"), TransferMap)
        loss = ObservedLoss(outside, inside, by_length, prediction)
        figure = draw_observed_loss(loss, job.settings["wedge_buffer"], job.settings["notes"])
        shown: dict[str, Any] = {"outside": outside, "inside": inside, "map": by_length}
        return Drawing(figure, shown if prediction is None else {**shown, "expected": prediction})
