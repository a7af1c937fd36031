"""Directions that no residual can see, fixed on purpose once the fit is done.

The likelihood (paper Eq. LOGLIKELIHOOD) does not change under two exact transformations:

- the phase of all gains, channel by channel: it cancels in g_a g_b* and the model does not know of it;
- one real scale: gains divided by sqrt(s), model multiplied by s. It is one number, not one per channel, because the
  model is smooth in frequency; a complex multiplier of the model is not among them, because g g* has no overall phase.

Gains times smooth functions against the model are nearly degenerate as well, but only nearly, and are left as fitted.
"""

from __future__ import annotations

import numpy as np

from calstudy.calibrate.problem import CalibrationProblem


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
    """Return the real factor by which the model is multiplied, and the gains' products divided; one if it is frozen.

    For the ``sum`` prior this is the exact minimum of the prior along the scale, so that the likelihood keeps its own
    minimum; for ``post-hoc`` the ratio of the moduli of the two sums (paper §Method); for ``gains`` what gives the
    gains the geometric mean of the initial ones; for ``none`` one.

    Raises
    ------
    ValueError
        If the summed model vanishes, or opposes the summed sky model, so that no positive scale exists.
    """
    if problem.prior == "none" or problem.frozen:
        return 1.0
    if problem.prior == "gains":
        used = problem.antenna_weights > 0
        return float(np.exp(2 * np.mean(np.log(np.abs(gains[used] / problem.initial_gains[used])))))
    total, target = complex(np.sum(problem.weights * model)), problem.prior_target
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


def fix_degeneracies(
    gains: np.ndarray, model: np.ndarray, problem: CalibrationProblem
) -> tuple[np.ndarray, np.ndarray]:
    """Return gains (Nants, Nfreqs) and model (Nbls, Nfreqs) with phase and scale fixed; g g* F is unchanged.

    Gains in a smooth basis keep to it, and have but one phase fixed.
    """
    scale = model_scale(gains, model, problem)
    if problem.structure.gain_vectors is None:
        turned = fix_phase(gains, problem.initial_gains)
    else:
        turned = fix_phase(gains.reshape(-1, 1), problem.initial_gains.reshape(-1, 1)).reshape(gains.shape)
    return turned / np.sqrt(scale), model * scale
