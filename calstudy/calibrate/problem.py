"""One calibration problem, of one integration and polarization: data, weights, and the structure of its unknowns."""

from __future__ import annotations

import hashlib
import math
import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.observation import Frame
from calstudy.calibrate.basis import WHOLE_BAND, Bucket, ForegroundBasis, gain_vectors, make_basis
from calstudy.calibrate.settings import MODELS_AT_ONCE, ForegroundFit, GainFit
from calstudy.instrument.layouts import RedundantGroups, redundant_groups

NOTHING_WEIGHTED = "every sample is flagged or has no weight"
LARGEST_WEIGHT = 100.0
"""Of weights from gains, over that of the median of |g_a g_b|^2."""
Level = Literal["none", "own", "shared", "both"]
Prior = Literal["sum", "post-hoc", "gains", "sky-model", "none"]


@dataclass(frozen=True, eq=False)
class FitStructure:
    """The antennas of each baseline, and the baselines of each foreground model.

    Solvers compile once per structure: instances with the same content are equal, and have the same hash.

    Antennas are indices (a, b), (Nbls, 2), each in 0 ... n_antennas - 1. `groups` are the indices of the baselines'
    foreground models, (Nbls,): ``arange(Nbls)`` for per-baseline modelling (paper Eq. LOGLIKELIHOOD), the redundant
    groups otherwise (Eq. LOGLIKELIHOODREDUNDANT). Baselines that are `conjugated`, bool, (Nbls,), have the opposite
    direction, and the conjugate of their model. `gain_vectors` are orthonormal real functions of frequency whose span
    contains the gains, (Nfreqs, Ngain), float64; None for gains without restriction.

    `prior` says which coefficients have a finite one: ``own``, ``shared`` (those of a model that baselines have in
    common), or ``both``, where every baseline has its own coefficients besides the shared ones; ``none`` if they are
    free. With a prior, the vectors of the basis are a root of its covariance for a variance of one per channel.
    """

    antennas: np.ndarray
    n_antennas: int
    basis: ForegroundBasis
    groups: np.ndarray
    conjugated: np.ndarray
    gain_vectors: np.ndarray | None = None
    models_at_once: int = MODELS_AT_ONCE
    prior: Level = "none"

    @cached_property
    def _content(self) -> str:
        digest = hashlib.sha256(f"{self.models_at_once} {self.prior}".encode())
        arrays = [self.antennas, self.groups, self.conjugated.astype(np.int64), self.gain_vectors]
        arrays += [array for bucket in self.basis.buckets for array in (bucket.members, bucket.vectors)]
        for array in (array for array in arrays if array is not None):
            digest.update(repr((array.shape, self.n_antennas)).encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FitStructure) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)

    @classmethod
    def per_baseline(cls, antennas: np.ndarray, n_antennas: int, basis: ForegroundBasis) -> FitStructure:
        """Return the structure with one foreground model for every baseline (paper Eq. LOGLIKELIHOOD).

        `antennas` are the antenna indices (a, b) of each baseline, (Nbls, 2); the basis has Nbls models.
        """
        n_baselines = len(antennas)
        return cls(antennas, n_antennas, basis, np.arange(n_baselines), np.zeros(n_baselines, bool))

    @property
    def n_baselines(self) -> int:
        """Number of baselines."""
        return len(self.antennas)

    @property
    def n_frequencies(self) -> int:
        """Number of channels."""
        return self.basis.n_frequencies


@dataclass(frozen=True, eq=False)
class CalibrationProblem:
    """Data and weights of one integration and polarization.

    Raises ValueError for weights that are negative or not finite, data that are not finite where the weight is not
    zero, data that are zero everywhere, or initial gains that are zero or not finite.

    Attributes
    ----------
    visibilities : (Nbls, Nfreqs), in the unit of the data (Jy). Values with zero weight, NaN included, are set to zero.
    weights : w of the likelihood, (Nbls, Nfreqs), float64; zero where flagged. For the paper's see `flag_weights`.
    initial_gains : start of the solver, and reference for the phase of the solution, (Nants, Nfreqs)
    sky_model
        Visibilities m whose weighted sum fixes the overall scale, (Nbls, Nfreqs); None for the measured ones divided by
        the initial gains.
    prior
        How the overall scale is fixed: in the loss and after it (``sum``), only after (``post-hoc``, by the sums of the
        models, ``gains``, by the size of the gains, or ``sky-model``, by regression of the calibrated data on the sky
        model), or not.
    frozen : whether the foregrounds are the sky model. The scale is then known, and `prior` not used.
    deviations
        Standard deviation per channel of the foregrounds about the sky model, in the unit of the data: of each baseline
        by itself, and common to those that share a model. Those of the structure's prior apply; weights must then be
        inverse variances.
    scale_weights : of the sums that fix the overall scale, which do not follow the gains; None for `weights`
    """

    structure: FitStructure
    visibilities: np.ndarray
    weights: np.ndarray
    initial_gains: np.ndarray
    sky_model: np.ndarray | None = None
    prior: Prior = "sum"
    frozen: bool = False
    deviations: tuple[float, float] = (math.inf, math.inf)
    scale_weights: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.frozen and self.sky_model is None:
            raise ValueError("sky_model: is needed where the foregrounds are frozen")
        if self.structure.prior != "none" and (self.sky_model is None or not self._deviations_are_finite()):
            raise ValueError("sky_model and finite positive deviations: are needed where foregrounds have a prior")
        if np.iscomplexobj(self.weights) or not np.isfinite(self.weights).all() or (self.weights < 0).any():
            raise ValueError("weights: must be real, finite and not negative")
        if not np.isfinite(self.initial_gains).all() or (self.initial_gains == 0).any():
            raise ValueError("initial_gains: must be finite and not zero")
        self._blank("visibilities")
        if not self.visibilities.any():
            raise ValueError("visibilities: zero wherever the weight is not, so that there is nothing to calibrate")
        if self.sky_model is not None:
            self._blank("sky_model")

    def _deviations_are_finite(self) -> bool:
        needed = {"own": self.deviations[:1], "shared": self.deviations[1:], "both": self.deviations}
        return all(0 < value < math.inf for value in needed.get(self.structure.prior, ()))

    def _blank(self, name: str) -> None:
        """Set a cube to zero where its weight is zero, as complex128, and require finite values elsewhere."""
        values = np.where(self.weights > 0, getattr(self, name), 0).astype(np.complex128)
        if not np.isfinite(values).all():
            raise ValueError(f"{name}: not finite where the weight is not zero; flag those samples")
        object.__setattr__(self, name, values)

    @property
    def mean(self) -> np.ndarray | None:
        """The sky model if the foregrounds are frozen to it, or have a finite prior about it; None if they are free."""
        return self.sky_model if self.frozen or self.structure.prior != "none" else None

    def weighted_by(self, gains: np.ndarray) -> CalibrationProblem:
        """Divide the weights by |g_a g_b|^2 of gains (Nants, Nfreqs), and keep their sum."""
        weights = gain_weights(self.weights, gain_products(gains, self.structure.antennas))
        return replace(self, weights=weights, scale_weights=self.summing)

    @property
    def _sky_rms(self) -> float:
        return 0.0 if self.sky_model is None else model_rms(self.sky_model, self.weights)

    @property
    def fractions(self) -> tuple[float, float]:
        """The deviations over the rms of the sky model, as users give them."""
        own, shared = self.deviations
        return own / self._sky_rms, shared / self._sky_rms

    def with_fractions(self, fractions: tuple[float, float]) -> CalibrationProblem:
        """Return the problem with deviations that are given over the rms of the sky model."""
        own, shared = fractions
        return replace(self, deviations=(own * self._sky_rms, shared * self._sky_rms))

    @property
    def summing(self) -> np.ndarray:
        """The weights of the sums that fix the overall scale, (Nbls, Nfreqs)."""
        return self.weights if self.scale_weights is None else self.scale_weights

    @property
    def antenna_weights(self) -> np.ndarray:
        """Summed weights of the baselines of each antenna, shape (Nants, Nfreqs)."""
        return sum_by_antenna(self.weights, self.structure.antennas, self.structure.n_antennas)

    @property
    def prior_target(self) -> complex:
        """The weighted sum of the sky model, in the unit of the data: sum over baselines and channels of w m."""
        sky_model = self.sky_model
        if sky_model is None:
            sky_model = self.visibilities / gain_products(self.initial_gains, self.structure.antennas)
        return complex(np.sum(self.summing * sky_model))


def model_rms(model: np.ndarray, weights: np.ndarray) -> float:
    """Return the rms of a model over samples with weight."""
    return float(np.sqrt(np.mean(np.abs(model[weights > 0]) ** 2)))


def fitted_baselines(frame: Frame, autos: bool) -> np.ndarray:
    """Return the mask of calibrated baselines, bool, shape (Nbls,): all, or all but the autocorrelations.

    Raises InputError if there are none; a message about a setting starts with its path.
    """
    if autos and not frame.autos.any():
        raise InputError("autos: is true, but the data hold no autocorrelations")
    if not autos and frame.autos.all():
        raise InputError("the data hold no cross-correlations, so that there is nothing to calibrate")
    return np.ones(frame.n_baselines, bool) if autos else ~frame.autos


def flag_weights(flags: np.ndarray) -> np.ndarray:
    """Return the paper's weights 1 / (Nbls Nfreqs), zero where flagged; flags are (Nbls, Nfreqs)."""
    return np.where(flags, 0.0, 1.0 / flags.size)


def gain_weights(weights: np.ndarray, products: np.ndarray) -> np.ndarray:
    """Return weights over |g_a g_b|^2, with the same mean over baselines and channels.

    |g_a g_b|^2 has a floor at a hundredth of its median: otherwise a sample whose gains a fit brings close to zero
    would have all the weight, and keep them there. The weights of unity gains are (..., Nbls, Nfreqs); products g_a
    g_b* have the same shape, and are not zero where the weight is not.
    """
    used = weights > 0
    power = np.where(used, np.abs(products) ** 2, np.nan)
    with warnings.catch_warnings():
        # Of all samples without weight there is no median.
        warnings.simplefilter("ignore", RuntimeWarning)
        least = np.nanmedian(power, axis=(-2, -1), keepdims=True) / LARGEST_WEIGHT
    found = np.where(used, weights, 0) / np.where(used, np.maximum(power, least), 1)
    before, after = (np.sum(values, axis=(-2, -1), keepdims=True) for values in (weights, found))
    return found * (before / np.where(after > 0, after, 1))


def weight_change(weights: np.ndarray, before: np.ndarray) -> float:
    """Return the relative rms change of weights in neighbouring channels against each other.

    Smooth changes in frequency are ignored: they carry no error of the foregrounds to other delays, and persist while a
    fit moves along gains that foregrounds can nearly follow. Weights are (..., Nfreqs); zeros are left out.
    """
    used = (before > 0) & (weights > 0)
    ratio = np.divide(weights, before, out=np.ones_like(weights), where=used)
    both = used[..., 1:] & used[..., :-1]
    steps = np.diff(ratio, axis=-1)[both]
    return float(np.sqrt(np.mean(steps**2) / 2)) if steps.size else 0.0


def gain_products(gains: np.ndarray, antennas: np.ndarray) -> np.ndarray:
    """Return g_a g_b* of baselines, (..., Nbls, Nfreqs), from gains (..., Nants, Nfreqs) and antennas (Nbls, 2)."""
    first, second = antennas.T
    return gains[..., first, :] * gains[..., second, :].conj()


def sum_by_antenna(values: np.ndarray, antennas: np.ndarray, n_antennas: int) -> np.ndarray:
    """Return the sums of real values, (Nbls, Nfreqs), over the baselines of each antenna, (Nants, Nfreqs)."""
    total = np.zeros((n_antennas, values.shape[1]))
    for ends in antennas.T:
        np.add.at(total, ends, values)
    return total


def make_structure(frame: Frame, settings: GainFit, band: slice = WHOLE_BAND) -> FitStructure:
    """Return the structure of the fit of one integration; its antennas are those of the frame.

    A redundant group is modelled with the basis of its longest baseline. The band has the data: free foregrounds are
    modelled in it, and restricted gains are smooth in it. Raises InputError if the basis does not fit into the channels
    of the band (see `calstudy.calibrate.basis.make_basis`).
    """
    if isinstance(settings, ForegroundFit) and not settings.frozen:
        # A finite prior is the same in a part of the band.
        structure = _foregrounds(frame, settings, WHOLE_BAND if settings.foreground_prior.finite else band)
    else:
        # A placeholder, a constant: frozen foregrounds have no coefficients to fit.
        bucket = Bucket(0.0, np.arange(frame.n_baselines), np.full((frame.n_channels, 1), frame.n_channels**-0.5))
        basis = ForegroundBasis((bucket,), frame.n_baselines, frame.n_channels)
        structure = FitStructure.per_baseline(frame.antennas, frame.n_antennas, basis)
    if settings.gain_delay is not None:
        vectors = gain_vectors(frame.frequencies, settings.gain_delay, band)
        structure = replace(structure, gain_vectors=vectors)
    return replace(structure, models_at_once=settings.models_at_once)


def _foregrounds(frame: Frame, settings: ForegroundFit, band: slice) -> FitStructure:
    prior = settings.foreground_prior
    tied = prior.shared_deviation != 0
    kind: Level = "none"
    if prior.finite:
        kind = "own" if not tied else "shared" if prior.deviation == 0 else "both"
    groups = RedundantGroups(np.arange(frame.n_baselines), np.zeros(frame.n_baselines, bool))
    if tied:
        groups = redundant_groups(frame.vectors, settings.redundancy_tolerance)
    longest = np.zeros(groups.index.max() + 1)
    np.maximum.at(longest, groups.index, frame.lengths)
    basis = make_basis(longest, frame.frequencies, settings.basis, prior.finite, band)
    return FitStructure(frame.antennas, frame.n_antennas, basis, groups.index, groups.conjugated, prior=kind)


def repeat_structure(structure: FitStructure, count: int) -> FitStructure:
    """Return the structure of `count` integrations that share their gains, and have their own foregrounds each.

    Baselines and models of the first integration come first, then those of the second, and so on.
    """
    if count == 1:
        return structure
    n_models = structure.basis.n_models
    offsets = n_models * np.arange(count)[:, None]
    buckets = [replace(bucket, members=(bucket.members + offsets).ravel()) for bucket in structure.basis.buckets]
    return replace(
        structure,
        antennas=np.tile(structure.antennas, (count, 1)),
        basis=ForegroundBasis(tuple(buckets), count * n_models, structure.n_frequencies),
        groups=(structure.groups + offsets).ravel(),
        conjugated=np.tile(structure.conjugated, count),
    )
