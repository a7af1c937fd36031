"""Degeneracies: directions that no residual can see, fixed after the fit, and left out of comparisons with the truth.

The likelihood (paper Eq. LOGLIKELIHOOD) does not change under two exact transformations:

- the phase of all gains, channel by channel: it cancels in g_a g_b* and the model does not know of it;
- one real scale: gains divided by sqrt(s), model multiplied by s. It is one number, not one per channel, because the
  model is smooth in frequency; a complex multiplier of the model is not among them, because g g* has no overall phase.

Gains times smooth functions against the model are nearly degenerate as well, but only nearly, and are left as fitted.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from calstudy.calibrate.problem import CalibrationProblem, gain_products


def fix_phase(gains: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Turn all gains by one phase per channel so that they come closest to the reference in least squares.

    With a reference of ones this makes the sum of the gains over antennas real and positive.

    Parameters
    ----------
    gains, reference
        Shape (Nants, Nfreqs), complex. Channels where the two are orthogonal are left as they are.
    """
    overlap = np.sum(gains * np.conj(reference), axis=0)
    modulus = np.abs(overlap)
    return gains * np.where(modulus > 0, overlap.conj() / np.where(modulus > 0, modulus, 1), 1)


def model_scale(gains: np.ndarray, model: np.ndarray, problem: CalibrationProblem) -> float:
    """Return the real factor by which the model is multiplied, and g_a g_b* divided; one if the model is frozen.

    For the ``sum`` prior this is the exact minimum of the prior along the scale, so that the likelihood keeps its own
    minimum; for ``post-hoc`` the ratio of the moduli of the two sums (paper §Method); for ``gains`` what gives the
    gains the geometric mean of the initial ones; for ``sky-model`` what makes the calibrated data regress on the sky
    model with a slope of one; for ``none`` one.

    Where a prior on the foregrounds is much wider than the noise, the fit finds g_a g_b* by a regression of the sky
    model on the data, and not of the data on the sky model, and what the sky model lacks makes it too large, by the
    square of its relative rms. ``sky-model`` corrects that.

    Parameters
    ----------
    gains
        As fitted, (Nants, Nfreqs), complex.
    model
        Intrinsic visibilities as fitted, (Nbls, Nfreqs), complex, in the unit of the data.
    problem
        What was fitted, and its prior.

    Raises
    ------
    ValueError
        If the summed model vanishes, or opposes the summed sky model, or the data are not correlated with the sky
        model, so that no positive scale exists.
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
    """Return the slope of the calibrated data on the sky model, and the slopes of single channels over it.

    What they tell of a fit: the scale of g_a g_b*, and its band shape, which all antennas share. A fit of free
    foregrounds determines the first not at all, and the second only where it is not smooth.

    Parameters
    ----------
    gains
        (Nants, Nfreqs), complex.
    problem
        What was fitted, with a sky model.

    Returns
    -------
    slope
        sum w Re m* V / (g_a g_b*) over sum w |m|^2, with the sky model m; zero if that is zero where there are data.
    shape
        The same of each channel, over `slope`, (Nfreqs,); NaN in channels without data, and in all if `slope` is zero.
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
    """Return gains and model with phase and scale fixed; g_a g_b* F is unchanged.

    Gains in a smooth basis stay in its span, and have only one phase fixed.

    Parameters
    ----------
    gains
        As fitted, (Nants, Nfreqs), complex. Not mutated.
    model
        Intrinsic visibilities as fitted, (Nbls, Nfreqs), complex, in the unit of the data. Not mutated.
    problem
        What was fitted: its prior, and the initial gains as the reference of the phase.

    Raises
    ------
    ValueError
        If no positive scale exists (see `model_scale`).
    """
    scale = model_scale(gains, model, problem)
    if problem.structure.gain_vectors is None:
        turned = fix_phase(gains, problem.initial_gains)
    else:
        turned = fix_phase(gains.reshape(-1, 1), problem.initial_gains.reshape(-1, 1)).reshape(gains.shape)
    return turned / np.sqrt(scale), model * scale


def align(gains: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, float]:
    """Turn and scale fitted gains to come closest to a reference, in least squares over all antennas and channels.

    A comparison with the truth must not charge a fit with a phase per channel or a real scale, which the likelihood
    does not determine. All else, near degeneracies between gains and smooth foregrounds included, is left as fitted.

    Parameters
    ----------
    gains, reference
        Complex, (Nants, Nfreqs). Not mutated.

    Returns
    -------
    aligned
        The gains, multiplied by one phase per channel and by `scale`, (Nants, Nfreqs).
    scale
        Real and positive. A model fitted with these gains must be divided by its square, so that the product of gains
        and model, which is what was fitted, stays the same.
    """
    turned = fix_phase(gains, reference)
    scale = float(np.vdot(turned, reference).real / np.vdot(turned, turned).real)
    return scale * turned, scale
