"""Recovered gains of two antennas against the truth (the paper's Fig. GAIN_RESID)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from calstudy.figures import Drawing, InspectedFigure, StudyFigure
from calstudy.instrument.layouts import make_layout
from calstudy.plotting import style
from calstudy.plotting.axes import TwoDomains, delay_panel, frequency_and_delay, in_two_domains
from calstudy.products import corruption
from calstudy.run.task import Job
from calstudy.verdicts.tolerances import Drawn, departure_from_mean, rms_of

ANTENNA_COLOURS = ((style.BLUE, "#003A5C"), (style.ORANGE, "#7A5300"))
"""Colours of true and of recovered gains, for each antenna."""
REFLECTIONS = (-1e-6, 4e-6)
"""Delays at which reflections are shown, s."""
RATIO_LOOK: dict[str, Any] = {"color": style.BLACK, "linestyle": ":"}


@dataclass(frozen=True)
class GainComparison:
    """Gains of two antennas at one integration: injected, as fitted, their difference, and that of aligned solutions.

    Spectra are (2, Nfreqs); the `correction`, (Nfreqs,), is g_a g_b* / (ĝ_a ĝ_b*) - 1 of their baseline, as fitted.
    """

    antennas: tuple[int, int]
    true: TwoDomains
    recovered: TwoDomains
    residual: TwoDomains
    aligned_residual: TwoDomains
    correction: TwoDomains


def compare_gains(
    antennas: tuple[int, int], frequency: np.ndarray, true: np.ndarray, recovered: np.ndarray, aligned: np.ndarray
) -> GainComparison:
    """Compare gains of two antennas, (2, Nfreqs) complex, on channels `frequency` (Nfreqs,) Hz.

    They are injected, as fitted, and fitted with the scale and the phase of each channel that come closest to the
    truth. Where there is no solution all are zero.
    """
    injected, fitted = (gains[0] * np.conj(gains[1]) for gains in (true, recovered))
    ratio = np.divide(injected, fitted, out=np.ones(frequency.size, complex), where=fitted != 0) - 1
    spectra = (true, recovered, true - recovered, true - aligned, ratio)
    return GainComparison(antennas, *(in_two_domains(frequency, values) for values in spectra))


def draw_gains(comparison: GainComparison) -> style.Figure:
    """Draw real parts against frequency (left) and transforms' amplitudes against delay (right)."""
    figure, (*gains, as_fitted, aligned), delays = frequency_and_delay(rows=4)
    shown = (comparison.true, comparison.recovered, comparison.residual, comparison.aligned_residual)
    for index, (axes, colours) in enumerate(zip(gains, ANTENNA_COLOURS, strict=True)):
        panels = (axes, axes, as_fitted, aligned)
        for panel, spectra, look in zip(panels, shown, _looks(*colours), strict=True):
            panel.plot(spectra.frequency / 1e6, spectra.real[index], **look)
            delays.plot(spectra.delay * 1e9, np.abs(spectra.transform[index]), **look)
        axes.set_ylabel(rf"Re $g_{{{comparison.antennas[index]}}}$")
    ratio = comparison.correction
    as_fitted.plot(ratio.frequency / 1e6, ratio.real, **RATIO_LOOK)
    delays.plot(ratio.delay * 1e9, np.abs(ratio.transform), **RATIO_LOOK)
    as_fitted.set_ylabel("Re residual,\nas fitted", linespacing=1.0)
    aligned.set_ylabel("Re residual,\naligned", linespacing=1.0)
    delay_panel(delays, comparison.true.delay, r"$|\widetilde{g}(\tau)|$")
    _add_legend(figure, comparison.antennas)
    return figure


def _looks(bright: str, dark: str) -> tuple[dict[str, Any], ...]:
    """Return how gains of an antenna look: true, recovered, and what is left as fitted and aligned."""
    return (
        {"color": bright, "linestyle": "-", "linewidth": 0.9},
        {"color": dark, "linestyle": "--", "linewidth": 0.7},
        {"color": bright, "linestyle": ":", "linewidth": 1.0},
        {"color": dark, "linestyle": "-", "linewidth": 0.5},
    )


def _add_legend(figure: style.Figure, antennas: tuple[int, int]) -> None:
    names = ("true", "recovered, as fitted", "residual as fitted", "residual aligned")
    handles = [
        style.entry(label=rf"$g_{{{number}}}$ {name}", **look)
        for number, colours in zip(antennas, ANTENNA_COLOURS, strict=True)
        for name, look in zip(names, _looks(*colours), strict=True)
    ]
    a, b = antennas
    ratio = rf"$g_{{{a}}}g_{{{b}}}^*/(\hat{{g}}_{{{a}}}\hat{{g}}_{{{b}}}^*)-1$, as fitted"
    handles.append(style.entry(label=ratio, **RATIO_LOOK))
    figure.legend(handles=handles, loc="outside upper center", ncols=5, columnspacing=1.1)


class Gains(InspectedFigure):
    """True and fitted gains of two antennas in one integration."""

    version: ClassVar[int] = 2

    kind: str = "gains"
    caption = (
        "Gains of two antennas: true, recovered, what is left as fitted and free of the phase of each channel and the "
        "scale, which no data determine (aligned), and their ratio."
    )
    variants = ("residual",)
    needs_calibration = True
    tolerances = (
        # The errors of the gains lie at small delays, far above their rms.
        (
            r"(recovered|residual|aligned_residual)\.transform",
            Drawn(rms_of("residual"), "the rms error of the gains", largest=12.0),
        ),
        (r"(recovered|residual|aligned_residual)\..*", Drawn(rms_of("residual"), "the rms error of the gains")),
        (r"correction\..*", Drawn(departure_from_mean, "the rms of the ratio about its mean")),
    )

    def draw(self, job: Job) -> Drawing:
        """Draw true and fitted gains of two antennas."""
        from calstudy.products.selection import read_aligned_gains, require_used

        numbers = make_layout(job.settings["layout"]).numbers[list(job.settings["antennas"])].tolist()
        gains = read_aligned_gains(job.inputs["gains"], job.inputs["calibration"], job.settings["integration"])
        rows = gains.rows(numbers)
        for row, number in zip(rows, numbers, strict=True):
            require_used(gains.fitted[row] != 0, [number], job.settings["integration"])
        shown = (values[rows] for values in (gains.true, gains.fitted, gains.aligned))
        comparison = compare_gains(tuple(numbers), gains.frequency, *shown)
        return Drawing(draw_gains(comparison), comparison)


def draw_reflections(gains: TwoDomains) -> style.Figure:
    """Draw the amplitude of the transform of every antenna's gain, (Nants, Nfreqs), and their median, in one column.

    Eq. REFGAIN has its peaks at positive delays.
    """
    amplitude = np.abs(gains.transform)
    figure = style.new_figure(style.ONE_COLUMN, 2.7)
    axes = figure.subplots()
    nanoseconds = gains.delay * 1e9
    lines = axes.plot(nanoseconds, amplitude.T, color=style.CYAN, linewidth=0.4, alpha=0.7)
    lines[0].set_label("each antenna")
    axes.plot(nanoseconds, np.median(amplitude, axis=0), color=style.BLACK, label="median")
    delay_panel(axes, gains.delay, r"$|\widetilde{g}(\tau)|$")
    shown = (gains.delay >= REFLECTIONS[0]) & (gains.delay <= REFLECTIONS[1])
    # The nulls between the taper's sidelobes would take half of the axis.
    axes.set_ylim(0.3 * np.quantile(amplitude[:, shown], 0.02), 3 * amplitude.max())
    axes.set_xlim(*nanoseconds[shown][[0, -1]])
    axes.legend(loc="upper right")
    return figure


class Reflections(StudyFigure):
    """The true gains against delay, in one integration."""

    kind: str = "reflections"

    caption = "Delay transform of the true gains."
    shows_sky = False
    reads: ClassVar = {"gains": corruption.gains}
    sections = ("outputs.inspect.integration",)

    def draw(self, job: Job) -> Drawing:
        """Draw the delay transforms of the true gains."""
        from calstudy.products.selection import read_gains

        gains = read_gains(job.inputs["gains"])
        shown = in_two_domains(gains.frequency, gains.at(job.settings["integration"], gains.numbers))
        return Drawing(draw_reflections(shown), shown)
