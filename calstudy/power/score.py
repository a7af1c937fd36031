"""Scores of a calibration in bins of k: the signal that it leaves, the power that it adds, and the recovered power.

Of the calibrated residual R of data with the EoR, and R0 of data without it, the scores are

- the transfer function T of the signal, free of the flux scale (`calstudy.power.transfer`);
- the bias s^2 P^R0 / P^S, the power that is present without any EoR: foregrounds that are left, in units of the EoR. It
  is free of the flux scale s as well, so that a calibration that makes everything smaller does not look better;
- the recovered power P^R / P^S, as measured.

A fit that stops before its minimum leaves a part of the signal that depends on where it started and stopped. The linear
response of the fit (`calstudy.calibrate.expected_loss`) does not depend on these. Scores have it beside T, whose error
does not include their difference.

Noise is in the errors of the last two, and not in their means, because spectra are crossed between two realizations of
the noise. Errors are found by leaving out antennas (`calstudy.power.clusters`).

Two calibrations of the same data have the same sky, gains and noise. Most of what makes their scores scatter is common
to both, so that the error of a difference is found by leaving out the same antennas in both.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import ArrayLike

from calstudy.power.clusters import clusters_in_k, linear_error
from calstudy.power.spectra import DelaySpectra, of_common_units
from calstudy.power.transfer import Injection

BANDS = (0.1, 0.2, 0.5, 1.0)
"""Edges in h/Mpc of the bands in which calibrations are compared."""
HEADLINE_BAND = (0.2, 0.5)
"""The band of headlines and tolerances: beyond the wedge of short baselines, where sensitivity is highest."""


@dataclass(frozen=True)
class CalibratedSpectra(Injection):
    """Delay spectra of the same units and delays.

    `signal` is of the EoR alone, `response` of the change of the residual by the EoR, and `cross` of the EoR times this
    change; `residual` and `residual_without_eor` are of the calibrated residual of data with and without the EoR.
    """

    residual: DelaySpectra
    residual_without_eor: DelaySpectra


SPECTRA = tuple(item.name for item in fields(CalibratedSpectra))


@dataclass(frozen=True)
class Score:
    """Scores of a calibration in Nk bins of |k|, outside the wedge. Bins without signal hold NaN.

    Attributes
    ----------
    k, bin_edges : bin centres (Nk,) and edges (Nk + 1,), h/Mpc
    transfer, transfer_error : T s^2, free of the flux scale s, and its standard deviation, (Nk,); NaN if s is not known
    cross_transfer
        C s, the coefficient of the regression of the response on the EoR, (Nk,); NaN if s is not known. At the minimum
        of a fit with free foregrounds and the weights of the spectra it equals T s^2; with a finite prior it is larger.
    bias, bias_error : s^2 P^R0 / P^S, free of the flux scale, and its standard deviation, (Nk,); NaN if s is not known
    recovered, recovered_error : P^R / P^S, (Nk,)
    flux_scale : s: fitted gain products over the true ones; NaN if not known
    """

    k: np.ndarray = field(metadata={"unit": "h/Mpc"})
    bin_edges: np.ndarray = field(metadata={"unit": "h/Mpc"})
    transfer: np.ndarray = field(metadata={"unit": ""})
    transfer_error: np.ndarray = field(metadata={"unit": ""})
    bias: np.ndarray = field(metadata={"unit": ""})
    bias_error: np.ndarray = field(metadata={"unit": ""})
    recovered: np.ndarray = field(metadata={"unit": ""})
    recovered_error: np.ndarray = field(metadata={"unit": ""})
    flux_scale: float = field(metadata={"unit": ""})
    # Tables of results from before it was measured have none.
    cross_transfer: np.ndarray = field(default_factory=lambda: np.array(np.nan), metadata={"unit": ""})


def score(spectra: CalibratedSpectra, edges: ArrayLike, buffer: float, flux_scale: float) -> Score:
    """Return the scores in bins of |k| outside the wedge; `edges` and `buffer` are as in `clusters_in_k`.

    `flux_scale` is s of the calibration; NaN if not known.
    """
    limits, signal = np.asarray(edges, dtype=float), spectra.signal
    clusters = clusters_in_k(signal, limits, buffer, inside=False)
    of_signal = clusters.powers(signal)
    (transfer, transfer_error), (bias, bias_error), (recovered, recovered_error) = (
        clusters.powers(part).ratio(of_signal)
        for part in (spectra.response, spectra.residual_without_eor, spectra.residual)
    )
    cross_transfer, _ = clusters.powers(spectra.cross).ratio(of_signal)
    return Score(
        k=(limits[1:] + limits[:-1]) / 2,
        bin_edges=limits,
        transfer=transfer * flux_scale**2,
        transfer_error=transfer_error * flux_scale**2,
        cross_transfer=cross_transfer * flux_scale,
        bias=bias * flux_scale**2,
        bias_error=bias_error * flux_scale**2,
        recovered=recovered,
        recovered_error=recovered_error,
        flux_scale=flux_scale,
    )


def difference(
    calibrations: tuple[CalibratedSpectra, CalibratedSpectra],
    edges: ArrayLike,
    buffer: float,
    flux_scales: tuple[float, float],
) -> dict[str, np.ndarray]:
    """Return how the scores of two calibrations of the same data differ, of the units that both have.

    ``transfer`` is T s^2 of the first less that of the second, ``bias`` the same of s^2 P^R0 / P^S, outside the wedge;
    ``transfer_error`` and ``bias_error`` are their standard deviations, (Nk,) each. `edges` and `buffer` are as for
    `score`; `flux_scales` are s of both, NaN if not known. Raises InputError if they have no unit in common.
    """
    limits = np.asarray(edges, dtype=float)
    common = of_common_units(
        {f"{name} {place}": getattr(one, name) for place, one in enumerate(calibrations) for name in SPECTRA}
    )
    clusters = clusters_in_k(common["signal 0"], limits, buffer, inside=False)
    sums = {name: clusters.powers(one) for name, one in common.items()}
    found: dict[str, np.ndarray] = {}
    for key, name in (("transfer", "response"), ("bias", "residual_without_eor")):
        powers, signals, values = [], [], []
        for place, factor in enumerate((flux_scales[0] ** 2, -(flux_scales[1] ** 2))):
            power, signal = sums[f"{name} {place}"], sums[f"signal {place}"]
            with np.errstate(divide="ignore", invalid="ignore"):
                value = factor * power.total / signal.total
                powers.append((factor / signal.total, power))
                # As for a ratio, deviations are those from the mean ratio, which add up to zero.
                signals.append((-value / signal.total, signal))
            values.append(value)
        found |= {key: values[0] + values[1], f"{key}_error": linear_error((*powers, *signals))}
    return found
