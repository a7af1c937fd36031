"""Spherical power spectra outside the wedge alone (the paper's Fig. SPHERICAL_LOW_SNR)."""

from __future__ import annotations

from calstudy.figures import Drawing
from calstudy.figures.spherical import Spherical, draw_spherical
from calstudy.run.task import Job


class SphericalExcised(Spherical):
    """Spherical power spectra outside the wedge."""

    caption = "Spherical power spectra outside the wedge with 95 % bars; open where negative."

    def draw(self, job: Job) -> Drawing:
        """Draw one column."""
        column = self.excised(job)
        return Drawing(draw_spherical([column], stand_ins=job.settings["notes"]), {"excised": column})
