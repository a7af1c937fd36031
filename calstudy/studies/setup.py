"""What a study calibrates, in one line: array, band, times, gains, noise and calibrator."""

from __future__ import annotations

from calstudy.corrupt.noise import NoiseRelativeToEor, NoiseRelativeToForegrounds, NoNoise, RadiometerNoise
from calstudy.experiment.model import Experiment
from calstudy.studies.preflight import frame_of


def describe_setup(experiment: Experiment) -> str:
    """Return the data of an experiment and how they are calibrated."""
    calibrated = any(variant.calibrate for variant in experiment.variants.values())
    return f"{describe_data(experiment)}; {experiment.calibration.label if calibrated else 'not calibrated'}"


def describe_data(experiment: Experiment) -> str:
    """Return the array, the band, the times, the gains and the noise of an experiment."""
    instrument = experiment.instrument
    frame, channels, times = frame_of(instrument), instrument.channels, instrument.times
    effects = ", ".join(effect.label for effect in experiment.corruption.effects)
    return "; ".join(
        (
            f"{frame.n_antennas} antennas ({instrument.layout.label}), baselines to {frame.lengths.max():.3g} m, "
            f"beam {instrument.beam.label}",
            f"{channels.count} channels of {channels.width / 1e3:g} kHz from {channels.first / 1e6:g} MHz",
            f"{times.count} integrations of {times.integration:g} s",
            effects or "no gains",
            _noise(experiment),
        )
    )


def _noise(experiment: Experiment) -> str:
    noise = experiment.corruption.noise
    match noise:
        case NoiseRelativeToEor():
            return f"noise {noise.factor:g} times the EoR"
        case NoiseRelativeToForegrounds():
            return f"noise {noise.factor:g} times the foregrounds"
        case RadiometerNoise():
            return f"thermal noise of {noise.nights} night{'s' if noise.nights > 1 else ''}"
        case NoNoise():
            return "no noise"
