"""Cylindrical power spectra of measured data, as given, calibrated, of the residual, and of the noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from calstudy.figures import Drawing, StudyFigure
from calstudy.figures.wedge import draw_panels
from calstudy.products.files import spectrum_file
from calstudy.products.observed_results import observed_spectra
from calstudy.run.task import Job, Task
from calstudy.verdicts.tolerances import Drawn, half

if TYPE_CHECKING:
    from calstudy.products.graph import MeasuredGraph

TITLES = {
    "data": "data as given",
    "calibrated": "calibrated",
    "residual": "residual",
    "noise": r"noise, $P_N$",
}
MAX_DELAY = 2e-6


class ObservedWedge(StudyFigure):
    """Cylindrical power spectra of measured data."""

    of = ("observed",)
    caption = (
        "Cylindrical power spectra of the measured data: as given, calibrated, the residual, and the power of their "
        "noise from the difference of the two halves; negative values in blue."
    )
    tolerances = ((r".*\.power", Drawn(half, "follows from fitted gains; half of it")),)

    def inputs(self, graph: MeasuredGraph) -> Mapping[str, Task]:
        """Return the averaged spectra."""
        return {"spectra": observed_spectra(graph)}

    def draw(self, job: Job) -> Drawing:
        """Draw a panel for each spectrum."""
        from calstudy.power.spectra import CylindricalSpectrum
        from calstudy.power.tables import load_spectrum

        folder = job.inputs["spectra"]
        found = {name: load_spectrum(folder / spectrum_file(name, "wedge"), CylindricalSpectrum) for name in TITLES}
        figure = draw_panels(found, TITLES, job.settings["wedge_buffer"], MAX_DELAY, job.settings["notes"])
        return Drawing(figure, found)
