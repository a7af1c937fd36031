"""How exact must gains be? The rms at which their errors cause a bias of a tenth of the EoR, measured and by a law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import AfterValidator, Field

from calstudy.base.constants import SIGMAS_95
from calstudy.base.schema import Section
from calstudy.base.units import Fraction
from calstudy.figures import Drawing, StudyFigure
from calstudy.plotting import style
from calstudy.power.gain_bias import GainBias, tolerated_sigma
from calstudy.power.tables import load_spectrum
from calstudy.products.comparison import case_name, read_cases
from calstudy.products.gain_bias import GAIN_BIAS, gain_bias
from calstudy.products.score import score
from calstudy.run.task import Job
from calstudy.verdicts.standing import LIMIT, SIGMAS, upper_limit
from calstudy.verdicts.tolerances import Arrays, Drawn

HEIGHT = 3.6
LOWEST, HIGHEST = 3e-4, 100.0
"""Limits of the rms, %."""
WHITE = 0.4
"""Where errors without correlation are drawn, over the shortest correlation length of the law."""


APART = 0.035
"""Least distance of two names of published tolerances, over the height of a panel."""


def _not_empty(text: str) -> str:
    if not text.strip():
        raise ValueError("is empty, and a published tolerance needs name, rms, source and reason")
    return text


Words = Annotated[str, AfterValidator(_not_empty)]


class PublishedTolerance(Section):
    """A published tolerance, which is drawn as a dotted line."""

    name: Words = Field(description="What the line is called.", examples=["Tripathi et al. 2025"])
    rms: Fraction = Field(gt=0, lt=1, description="Tolerated error of gains.", examples=["0.001 %"])
    source: Words = Field(description="Where it was read.", examples=["arXiv:2502.20962, abstract"])
    reason: Words = Field(description="What it is needed for.", examples=["unbiased astrophysical parameters"])


@dataclass(frozen=True)
class Tolerated:
    """The law of a world, the measured bias, and the rms, `sigma`, that causes a bias of `LIMIT`, in Nk bands of k.

    The error of the rms is NaN where the bias is not significant, and the rms a lower limit.
    """

    law: GainBias
    bias: np.ndarray
    bias_error: np.ndarray
    sigma: np.ndarray
    sigma_error: np.ndarray


def tolerated(law: GainBias, bias: np.ndarray, error: np.ndarray) -> Tolerated:
    """Return the rms that is tolerated, from the bias that was measured and its standard deviation, (Nk,) each."""
    known = bias > SIGMAS * error
    limits = np.array([upper_limit(*pair) for pair in zip(bias, error, strict=True)])
    # The two terms of the law keep their ratio; without a law, the bias goes with the variance.
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(law.bias > 0, law.terms / law.bias, [[law.sigma**-2], [0.0]])
        sigma = tolerated_sigma(shares * np.where(known, bias, limits), LIMIT)
        spread = np.where(known, sigma * error / (2 * np.abs(bias)), np.nan)
    return Tolerated(law, bias, error, sigma, spread)


def draw_gain_tolerance(
    worlds: Mapping[str, Tolerated],
    eor_level: float | None = None,
    published: Sequence[PublishedTolerance] = (),
) -> style.Figure:
    """Draw the tolerated rms against the correlation length, a panel for each band of k: points on lines of the law.

    Dashed lines are an exponential correlation, open symbols errors that antennas have in common in part, arrows lower
    limits, dotted lines published tolerances. `eor_level` is in dB, None if not known.
    """
    edges = next(iter(worlds.values())).law.bin_edges
    figure = style.new_figure(style.TWO_COLUMNS, HEIGHT)
    panels = figure.subplots(1, edges.size - 1, squeeze=False, sharex=True, sharey=True)[0]
    found = list(worlds.values())
    kinds = list(dict.fromkeys(_kind(one.law) for one in found))
    for band, axes in enumerate(panels):
        for number, kind in enumerate(kinds):
            _draw_kind(axes, [one for one in found if _kind(one.law) == kind], band, number)
        for line in published:
            axes.axhline(100 * line.rms, color=style.GREY, linewidth=0.7, linestyle=":", zorder=0)
        _scale(axes, found)
        axes.set_title(style.band_name(*edges[band : band + 2]))
    _name(published, panels[-1])
    level = "" if eor_level is None else rf", EoR at ${eor_level:g}$ dB"
    panels[0].set_ylabel(f"rms (%) for a bias of {LIMIT:g}{level}")
    handles = [style.entry(**_look(kind, number), label=_title(kind)) for number, kind in enumerate(kinds)]
    figure.legend(handles=handles, loc="outside upper center", ncols=min(len(handles), 4))
    return figure


Kind = tuple[float | None, str, float]


def _kind(law: GainBias) -> Kind:
    """Return correlation time, form and common part, which tell the lines apart."""
    return None if np.isnan(law.time) else law.time, law.form, law.common


def _title(kind: Kind) -> str:
    time, form, common = kind
    words = ["constant" if time is None else f"{time:g} s"]
    words += ["exponential"] if form == "exponential" else []
    words += [f"{100 * common:g} % common"] if common else []
    return ", ".join(words)


def _look(kind: Kind, number: int) -> dict[str, Any]:
    _, form, common = kind
    marker, colour = style.SERIES[number % len(style.SERIES)]
    return {
        "color": colour,
        "marker": marker,
        "markerfacecolor": "white" if common else colour,
        "linestyle": "--" if form == "exponential" else "-",
        "linewidth": 0.8,
    }


def _draw_kind(axes: style.Axes, members: Sequence[Tolerated], band: int, number: int) -> None:
    law = members[0].law
    look = _look(_kind(law), number)
    curve = 100 * tolerated_sigma(law.terms_at[:, :, band].T, LIMIT)
    # Lines that coincide show the first.
    line = {"color": look["color"], "linewidth": 0.8, "zorder": 1 - 0.01 * number}
    axes.plot(law.lengths / 1e6, curve, linestyle=look["linestyle"], **line)
    for found in members:
        at = _place(found.law)
        expected = 100 * float(tolerated_sigma(found.law.terms[:, band], LIMIT))
        if found.law.length == 0:
            axes.plot(np.array([0.8, 1.25]) * at, [expected] * 2, **line)
        point = look | {"linestyle": "", "zorder": 2}
        sigma, error = 100 * found.sigma[band], 100 * found.sigma_error[band]
        known = np.isfinite(error)
        size, bar = (sigma, SIGMAS_95 * error) if known else (min(sigma, HIGHEST), 0.4 * sigma)
        axes.errorbar(at, size, yerr=bar, lolims=not known, elinewidth=0.6, **point)


def _place(law: GainBias) -> float:
    """Return the place of a correlation length on the axis, MHz."""
    return (law.length or WHITE * float(law.lengths[0])) / 1e6


def _scale(axes: style.Axes, worlds: Sequence[Tolerated]) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    smallest = min(float(np.nanmin(100 * found.sigma, initial=HIGHEST)) for found in worlds)
    axes.set_ylim(min(LOWEST, smallest / 2), HIGHEST)
    ticks = sorted({_place(found.law): found.law.length / 1e6 for found in worlds}.items())
    axes.set_xticks([place for place, _ in ticks], [f"{length:g}" for _, length in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("correlation length (MHz)")


def _name(published: Sequence[PublishedTolerance], axes: style.Axes) -> None:
    """Name the dotted lines on the right of a panel, from below; names that would overlap move up."""
    lowest, highest = np.log10(axes.get_ylim())
    above = -np.inf
    for line in sorted(published, key=lambda line: line.rms):
        at = (np.log10(100 * line.rms) - lowest) / (highest - lowest)
        if not 0 <= at <= 1:
            continue
        above = max(at, above + APART)
        text = f"{line.name}: {100 * line.rms:g} %"
        look: dict[str, Any] = {"size": style.NOTE_SIZE, "color": style.GREY, "va": "center"}
        axes.annotate(text, (1, above), (3, 0), xycoords="axes fraction", textcoords="offset points", **look)


def _rounding(arrays: Arrays, name: str) -> np.ndarray:
    """Return a thousandth of a law or its terms in sigma^2 and sigma^4, and of the EoR.

    Bands of one law differ by ten orders of magnitude. Below the EoR they are lost in the rounding of the foregrounds.
    """
    power = np.array([2, 4])[:, None] if "terms" in name else 0
    eor = arrays[f"{name.rpartition('.')[0]}.sigma"] ** -np.asarray(power, float)
    return np.asarray(1e-3 * (np.abs(arrays[name]) + eor))


class GainTolerance(StudyFigure):
    """The rms of gain errors at which the bias is a tenth of the EoR, against their correlation in frequency."""

    # Published tolerances are settings since 2.
    version: ClassVar[int] = 3
    kind: str = "gain-tolerance"
    published: tuple[PublishedTolerance, ...] = Field(
        (), description="Tolerances to compare with, drawn as dotted lines."
    )

    of = ("comparison",)
    reads: ClassVar = {"": score, "law": gain_bias}
    caption = (
        "The rms of the real part of gain errors at which their bias is a tenth of the EoR, if nothing is calibrated: "
        "measured (points, 95 % bars; arrows: lower limits) and by the law (lines)."
    )
    sections = ("corruption.eor_level",)
    tolerances = ((r".*\.law\.(bias|terms|terms_at)", Drawn(_rounding, "a thousandth of it and of the EoR")),)

    def captioned(self) -> str:
        """Return the caption with the sources and reasons of the published tolerances."""
        lines = [f"{line.name} ({line.source}): {line.reason}" for line in self.published]
        return f"{self.caption} Dotted lines: {'; '.join(lines)}." if lines else self.caption

    def draw(self, job: Job) -> Drawing:
        """Draw the first calibrator, which must not change the data, in all worlds."""
        first, *_ = job.settings["calibrators"]
        worlds = {}
        for row, (world, found) in enumerate(read_cases([first], job.settings["worlds"], job.inputs).items()):
            bands = found[first].bands
            law = load_spectrum(job.inputs[f"law:{case_name(row, 0)}"] / GAIN_BIAS, GainBias)
            worlds[world] = tolerated(law, bands.bias, bands.bias_error)
        return Drawing(draw_gain_tolerance(worlds, job.settings.get("eor_level"), self.published), worlds)
