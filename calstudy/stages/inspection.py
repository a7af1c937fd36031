"""What the figures of single gains and baselines show, read from products."""

from __future__ import annotations

import numpy as np

from calstudy.figures.baselines import BaselineSpectra
from calstudy.figures.comparison import Visibilities, VisibilityComparison, compare_visibilities
from calstudy.figures.domains import TAPER
from calstudy.figures.gains import GainComparison, compare_gains
from calstudy.power.delay import channel_width, delay_transform, delays
from calstudy.stages.registry import Job
from calstudy.stages.selection import (
    AlignedGains,
    baseline,
    layout_of,
    read_aligned_gains,
    read_gains,
    read_spectra,
    spread_in_length,
)

SHOWN_BASELINES = 4
"""Baselines in the figure of several, where the experiment names none."""


def _aligned(job: Job) -> AlignedGains:
    return read_aligned_gains(job.inputs["gains"], job.inputs["calibration"], job.settings["integration"])


def inspect_gains(job: Job) -> GainComparison:
    """Compare true and fitted gains of two antennas (paper Fig. GAIN_RESID)."""
    numbers = layout_of(job.settings).numbers[job.settings["antennas"]].tolist()
    gains = _aligned(job)
    rows = gains.rows(numbers)
    return compare_gains(tuple(numbers), gains.frequency, gains.true[rows], gains.fitted[rows])


def inspect_model(job: Job) -> VisibilityComparison:
    """Compare the true foregrounds of a baseline with the fitted ones, on the scale of the true gains (MODEL_RESID)."""
    pair, length = baseline(layout_of(job.settings), job.settings["antennas"])
    gains, integration = _aligned(job), job.settings["integration"]
    foregrounds, model, noise = (
        read_spectra(path, [pair])[0, integration]
        for path in (
            job.inputs["foregrounds"] / "visibilities.uvh5",
            job.inputs["calibration"] / "model.uvh5",
            job.inputs["noise"] / "data.uvh5",
        )
    )
    return compare_visibilities(pair, length, gains.frequency, Visibilities(foregrounds, model / gains.scale**2, noise))


def inspect_data(job: Job) -> VisibilityComparison:
    """Compare the data of a baseline with fitted gains times model, and with the noise in them (CALIBRATED_RESID)."""
    pair, length = baseline(layout_of(job.settings), job.settings["antennas"])
    integration = job.settings["integration"]
    data, model, noise = (
        read_spectra(path, [pair])[0, integration]
        for path in (
            job.inputs["data"] / "data.uvh5",
            job.inputs["calibration"] / "model.uvh5",
            job.inputs["noise"] / "data.uvh5",
        )
    )
    true, fitted = read_gains(job.inputs["gains"]), read_gains(job.inputs["calibration"])
    corruption, correction = (gains[0] * gains[1].conj() for gains in (true.of(pair)[0], fitted.of(pair)[integration]))
    visibilities = Visibilities(data, correction * model, corruption * noise)
    return compare_visibilities(pair, length, fitted.frequency, visibilities)


def inspect_baselines(job: Job) -> list[BaselineSpectra]:
    """Return the RMS over time of delay transforms of some baselines (INSPECT_BLS)."""
    layout = layout_of(job.settings)
    places = job.settings["baselines"] or spread_in_length(layout, SHOWN_BASELINES)
    pairs, lengths = zip(*(baseline(layout, place) for place in places), strict=True)
    gains = read_gains(job.inputs["calibration"])
    first, second = (np.moveaxis(gains.of([pair[side] for pair in pairs]), 1, 0) for side in (0, 1))
    residual = read_spectra(job.inputs["calibration"] / "residual.uvh5", pairs)
    model = first * second.conj() * read_spectra(job.inputs["calibration"] / "model.uvh5", pairs)
    spectra = {"residual": residual, "model": model}
    measured = [name for name in ("data", "noise", "uncorrupted") if name in job.inputs]
    spectra |= {name: read_spectra(job.inputs[name] / "data.uvh5", pairs) for name in measured}
    shown = {name: rms_over_time(values, gains.frequency) for name, values in spectra.items()}
    delay = delays(gains.frequency.size, channel_width(gains.frequency))
    return [
        BaselineSpectra(pair, length, delay, **{name: values[index] for name, values in shown.items()})
        for index, (pair, length) in enumerate(zip(pairs, lengths, strict=True))
    ]


def rms_over_time(spectra: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """Return the rms over integrations of the Blackman-Harris delay transforms of spectra.

    Parameters
    ----------
    spectra
        Visibilities in Jy, (..., Ntimes, Nfreqs).
    frequency
        Channel centres, Hz, (Nfreqs,).

    Returns
    -------
    Real, (..., Ndelays), Jy Hz.
    """
    return np.sqrt(np.mean(np.abs(delay_transform(spectra, frequency, TAPER)) ** 2, axis=-2))
