"""What realizations measure where the answer is known."""

from dataclasses import fields

import numpy as np

from calstudy.power.realizations import Design, Sample
from calstudy.power.spectra import SphericalSpectrum
from calstudy.power.transfer import TransferFunction

BINS = 20
INPUT = 5000.0
NOISE, SAMPLE = 0.06, 0.04
"""sigma_N and sigma_S of a bin, in units of the input power."""
LOSS = np.linspace(0.6, 0.95, BINS)
MODES = 100
"""Of a bin, over which the product of noise and EoR is averaged."""


def design_of(*blocks: tuple[tuple[str, ...], int]) -> Design:
    """Return a design of blocks of parts and counts, the first realization in all of them."""
    draws, members = [{"eor": 0, "gains": 0, "noise": 0}], []
    for parts, count in blocks:
        places = [0]
        for number in range(1, count):
            places.append(len(draws))
            draws.append({part: number if part in parts else 0 for part in draws[0]})
        members.append((parts, places))
    return Design(draws, members)


def spectrum(power: np.ndarray, noise: float = 0.0, sample: float = 0.0) -> SphericalSpectrum:
    known = {
        "k": 0.04 * np.arange(BINS) + 0.02,
        "bin_edges": 0.04 * np.arange(BINS + 1),
        "power": power + 0j,
        "noise_error": np.full(BINS, noise),
        "sample_error": np.full(BINS, sample),
        "sample_modes": np.full(BINS, SAMPLE**-2),
        "cross_modes": np.full(BINS, 1 / SAMPLE),
        "wedge_excluded": True,
    }
    return SphericalSpectrum(**{item.name: known.get(item.name, np.ones(BINS)) for item in fields(SphericalSpectrum)})


def transfer_function(values: np.ndarray, error: float) -> TransferFunction:
    """Return T and C with the same errors; C = T, as of a projection."""
    known = {"transfer": values, "cross_transfer": values, "bin_edges": 0.04 * np.arange(BINS + 1)}
    return TransferFunction(
        **{
            item.name: known.get(item.name, np.full(BINS, error) if item.name.endswith("_error") else np.ones(BINS))
            for item in fields(TransferFunction)
        }
    )


def draw(design: Design, random: np.random.Generator, loss: np.ndarray = LOSS, scatter: float = 0.01) -> list[Sample]:
    """Draw what realizations measure: T with a part of its scatter from the sky, a part from gains and noise.

    Noise and its product with the EoR pass through the calibration like the EoR, and lose a factor T. The product is
    the mean over modes of noise times EoR, another one for every pair of draws.
    """
    cross = np.sqrt(np.sqrt(2) * NOISE * SAMPLE / MODES)
    noises: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    skies: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    modes: dict[tuple[str, int], np.ndarray] = {}
    samples = []
    for draws in design.draws:
        product = np.prod(
            [modes.setdefault((part, draws[part]), random.standard_normal((MODES, BINS))) for part in ("eor", "noise")],
            axis=0,
        ).sum(axis=0)
        noise = noises.setdefault(draws["noise"], tuple(random.standard_normal((2, BINS))))
        sky = skies.setdefault(draws["eor"], tuple(random.standard_normal((2, BINS))))
        eor = INPUT * (1 + SAMPLE * sky[0])
        transfer = loss * (1 + scatter * (sky[1] + noise[1]))
        residual = transfer * (eor + INPUT * (NOISE * noise[0] + cross * product))
        samples.append(
            Sample(
                residual=spectrum(residual, NOISE * INPUT, SAMPLE * INPUT),
                without_eor=spectrum(transfer * INPUT * NOISE * noise[0], NOISE * INPUT),
                eor=spectrum(eor, 0.0, SAMPLE * INPUT),
                put_in=np.full(BINS, INPUT),
                transfer=transfer_function(transfer, 1.4 * scatter),
            )
        )
    return samples
