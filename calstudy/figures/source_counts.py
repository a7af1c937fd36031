"""Check of the sky: differential source counts of the foregrounds, compared with published counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calstudy.figures import Drawing, StudyFigure
from calstudy.plotting import style
from calstudy.run.task import Job
from calstudy.sky.counts import FREQUENCY, differential_counts

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pyradiosky import SkyModel

BINS = 12
POINTS_PER_BIN = 50
AREA_NSIDE = 128
TOLERANCE = 0.05


@dataclass(frozen=True)
class SourceCounts:
    """Differential counts at 200 MHz south of +30 degrees and more than 10 degrees from the Galactic plane.

    `edges` (Nbins + 1,) are flux densities in Jy, and `area` is in sr. `expected` is the number of sources in each bin
    (Nbins,) according to Franzen et al. (2019).
    """

    edges: np.ndarray
    number: np.ndarray
    expected: np.ndarray
    area: float

    @property
    def flux(self) -> np.ndarray:
        """Geometric centres of the bins, (Nbins,), Jy."""
        return np.sqrt(self.edges[:-1] * self.edges[1:])

    @property
    def density(self) -> np.ndarray:
        """dN/dS, (Nbins,), 1/(Jy sr)."""
        return self.number / (self.area * np.diff(self.edges))

    @property
    def ratio(self) -> np.ndarray:
        """Number over expected number, (Nbins,)."""
        return self.number / self.expected

    @property
    def error(self) -> np.ndarray:
        """Poisson error of `ratio`, (Nbins,)."""
        return np.sqrt(self.expected) / self.expected


def count_sources(sky: SkyModel, faint: float = 0.1, bright: float = 4.0) -> SourceCounts:
    """Count the point sources between two flux densities (Jy at 200 MHz), in bins of equal logarithmic width.

    Flat spectra are counted at their constant flux density.
    """
    from astropy import units

    from calstudy.sky.foregrounds import in_complete_area

    if sky.spectral_type != "flat":
        sky = sky.at_frequencies(np.array([FREQUENCY]) * units.Hz, inplace=False, run_check=False)
    flux = sky.stokes[0, 0].to_value("Jy")
    inside = in_complete_area(sky.skycoord)
    edges = np.geomspace(faint, bright, BINS + 1)
    fine = np.geomspace(faint, bright, BINS * POINTS_PER_BIN + 1)
    density = differential_counts(fine)
    steps = np.diff(fine) * (density[:-1] + density[1:]) / 2
    area = _area()
    return SourceCounts(
        edges=edges,
        number=np.histogram(flux[inside], edges)[0],
        expected=area * steps.reshape(BINS, -1).sum(axis=1),
        area=area,
    )


def _area() -> float:
    import healpy
    from astropy.coordinates import SkyCoord

    from calstudy.sky.foregrounds import in_complete_area

    longitude, latitude = healpy.pix2ang(AREA_NSIDE, np.arange(healpy.nside2npix(AREA_NSIDE)), lonlat=True)
    pixels = SkyCoord(longitude, latitude, unit="deg", frame="icrs")
    return float(4 * np.pi * in_complete_area(pixels).mean())


@style.journal_style()
def draw_counts(counts: SourceCounts) -> Figure:
    """Draw Euclidean-normalized counts above, and their ratio to Franzen et al. (2019) with a band of 5 % below."""
    figure = style.new_figure(style.ONE_COLUMN, 3.6)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    curve = np.geomspace(counts.edges[0], counts.edges[-1], 200)
    scale = counts.flux**2.5
    error = counts.error * counts.expected / (counts.area * np.diff(counts.edges))
    upper.plot(curve, curve**2.5 * differential_counts(curve), color=style.BLACK, label="Franzen et al. (2019)")
    upper.errorbar(
        counts.flux, scale * counts.density, scale * error, fmt="o", color=style.BLUE, label="sources of this sky"
    )
    upper.set(xscale="log", yscale="log", ylabel=r"$S^{5/2}\,dN/dS$ (Jy$^{3/2}$ sr$^{-1}$)")
    upper.legend(loc="lower right")
    lower.axhspan(1 - TOLERANCE, 1 + TOLERANCE, color=style.BAND, linewidth=0)
    lower.axhline(1, color=style.BLACK, linewidth=0.7)
    lower.errorbar(counts.flux, counts.ratio, counts.error, fmt="o", color=style.BLUE)
    largest = max(2 * TOLERANCE, 1.1 * float(np.abs(counts.ratio - 1).max() + counts.error.max()))
    lower.set(xlabel="flux density at 200 MHz (Jy)", ylabel="ratio", ylim=(1 - largest, 1 + largest))
    return figure


class SourceCountsFigure(StudyFigure):
    """The differential source counts of the foreground sky, over those of Franzen et al. (2019)."""

    kind: str = "source-counts"

    caption = "Differential source counts at 200 MHz, and their ratio to those of Franzen et al. (2019)."
    needs_foregrounds = True
    needs_products = False
    sections = ("sky", "instrument")

    def draw(self, job: Job) -> Drawing:
        """Count the sources."""
        from calstudy.instrument.telescope import make_template
        from calstudy.sky.foregrounds import make_foregrounds

        frequencies = make_template(job.settings["instrument"]).freq_array
        counts = count_sources(make_foregrounds(job.settings["sky"].foregrounds, frequencies).sky)
        notes = {"largest_deviation": float(np.abs(counts.ratio - 1).max())}
        return Drawing(draw_counts(counts), counts, notes)
