"""Degeneracies: directions that no residual constrains, fixed after the fit and left out of comparisons with the truth.

The likelihood (paper Eq. LOGLIKELIHOOD) does not change under two exact transformations:

- the phase of all gains, channel by channel: it cancels in g_a g_b*, and the model does not depend on it;
- one real scale: gains divided by sqrt(s), model multiplied by s. It is one number, not one per channel, because the
  model is smooth in frequency; a complex multiplier of the model is not among them, because g g* has no overall phase.

Gains multiplied by smooth functions, which the model compensates, are only nearly degenerate. They are left as fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calstudy.calibrate.problem import CalibrationProblem, gain_products

POL, FEED = "nn", "Jnn"
"""Names that hera_cal wants for the polarization, and for its feed; each polarization is calibrated by itself."""


def fix_phase(gains: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Rotate all gains by one phase per channel, to bring them closest to the reference in least squares.

    Both are complex, (Nants, Nfreqs); channels where the two are orthogonal stay as they are. With a reference of ones,
    the sum of the gains over antennas becomes real and positive.
    """
    overlap = np.sum(gains * np.conj(reference), axis=0)
    modulus = np.abs(overlap)
    return gains * np.where(modulus > 0, overlap.conj() / np.where(modulus > 0, modulus, 1), 1)


def model_scale(gains: np.ndarray, model: np.ndarray, problem: CalibrationProblem) -> float:
    """Return the real factor by which the model is multiplied, and g_a g_b* divided; one if the model is frozen.

    For the ``sum`` prior this is the exact minimum of the prior along the scale, so that the likelihood keeps its own
    minimum. For ``post-hoc`` it is the ratio of the moduli of the two sums (paper §Method). For ``gains`` it gives the
    gains the geometric mean of the initial ones. For ``sky-model`` it makes the slope of the calibrated data on the sky
    model one. For ``none`` it is one.

    Where a prior on the foregrounds is much wider than the noise, the fit finds g_a g_b* by a regression of the sky
    model on the data, and not of the data on the sky model. Foregrounds that the sky model lacks then make g_a g_b* too
    large, by the square of their relative rms. ``sky-model`` corrects that.

    Gains and model are as fitted, complex, (Nants, Nfreqs) and (Nbls, Nfreqs). Raises ValueError if no positive scale
    exists: the summed model vanishes or opposes the summed sky model, or the data are not correlated with it.
    """
    if problem.prior == "none" or problem.frozen:
        return 1.0
    if problem.prior == "gains":
        used = problem.antenna_weights > 0
        return float(np.exp(2 * np.mean(np.log(np.abs(gains[used] / problem.initial_gains[used])))))
    if problem.prior == "sky-model":
        slope, _ = sky_model_slope(gains, problem)
        if not slope > 0:
            raise ValueError("prior sky-model: the calibrated data are not correlated with the sky model")
        return 1 / slope
    total, target = complex(np.sum(problem.summing * model)), problem.prior_target
    if problem.prior == "sum":
        scale = (total.conjugate() * target).real / abs(total) ** 2 if total else 0.0
    else:
        scale = abs(target) / abs(total) if total else 0.0
    if not scale > 0:
        raise ValueError(
            f"prior {problem.prior}: the summed model {total:.3g} and the summed sky model {target:.3g} "
            "allow no positive scale between them"
        )
    return scale


def sky_model_slope(gains: np.ndarray, problem: CalibrationProblem) -> tuple[float, np.ndarray]:
    """Return the slope of the calibrated data on the sky model, and the slopes of single channels relative to it.

    The slope is the scale of g_a g_b*, and the slopes of channels are its band shape, which all antennas share. A fit
    of free foregrounds does not determine the first, and the second only where it is not smooth.

    It is sum w Re m* V / (g_a g_b*) over sum w |m|^2, with the sky model m; zero if that is zero where there are data.
    Slopes of channels are (Nfreqs,); NaN in channels without data, and in all if the slope is zero.
    """
    sky_model: Any = problem.sky_model
    calibrated = problem.visibilities / gain_products(gains, problem.structure.antennas)
    overlap = np.sum(problem.summing * (sky_model.conj() * calibrated).real, axis=0)
    power = np.sum(problem.summing * np.abs(sky_model) ** 2, axis=0)
    slope = float(overlap.sum() / power.sum()) if power.any() else 0.0
    return slope, np.divide(overlap, slope * power, out=np.full(power.shape, np.nan), where=slope * power != 0)


def fix_degeneracies(
    gains: np.ndarray, model: np.ndarray, problem: CalibrationProblem
) -> tuple[np.ndarray, np.ndarray]:
    """Return gains and model, as new arrays, with phase and scale fixed; g_a g_b* F is unchanged.

    The initial gains of the problem are the reference of the phase. Gains in a smooth basis stay in its span, and only
    one phase of them is fixed. Raises ValueError if no positive scale exists (see `model_scale`).
    """
    scale = model_scale(gains, model, problem)
    if problem.structure.gain_vectors is None:
        turned = fix_phase(gains, problem.initial_gains)
    else:
        # Gains without data are where they started.
        reference = np.where(problem.antenna_weights > 0, problem.initial_gains, 0)
        turned = fix_phase(gains.reshape(-1, 1), reference.reshape(-1, 1)).reshape(gains.shape)
    return turned / np.sqrt(scale), model * scale


def gradient_turns(
    reds: Sequence[Sequence[tuple[int, int, str]]], overlap: Mapping[tuple[int, int, str], np.ndarray]
) -> dict[tuple[int, str], np.ndarray]:
    """Return the phase factors of antennas with the phase gradient that brings redundant groups closest to a sky model.

    `overlap` are weighted calibrated data times the conjugate of the sky model, (Ntimes, Nfreqs), of each baseline, in
    the terms of hera_cal; all that the gradient depends on are the sums over each group.
    """
    from hera_cal.abscal import complex_phase_abscal
    from hera_cal.datacontainer import DataContainer

    sums = {group[0]: sum(overlap[key] for key in group) for group in reds}
    ones = {key: np.ones_like(values) for key, values in sums.items()}
    return complex_phase_abscal(DataContainer(sums), DataContainer(ones), reds, list(sums), list(sums))[1]


def align(gains: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, float]:
    """Rotate and scale fitted gains to bring them closest to a reference, in least squares over antennas and channels.

    The likelihood does not determine a phase per channel and a real scale, so that comparisons with the truth must not
    count them as errors. Near degeneracies between gains and smooth foregrounds are left as fitted. Both arrays are
    complex, (Nants, Nfreqs), and not changed.

    Return the gains, multiplied by one phase per channel and by a scale, and the scale, real and positive. A model
    fitted with these gains must be divided by its square, so that gains times model, the fitted quantity, is the same.
    """
    turned = fix_phase(gains, reference)
    scale = float(np.vdot(turned, reference).real / np.vdot(turned, turned).real)
    return scale * turned, scale
