"""Tolerances of the arrays of a figure against a reference, by figure and array, each with its reason.

A result made again with the same seeds and the same code is equal to rounding. It changes when a library draws other
random numbers, a solver stops elsewhere, or a model changes. Arrays that depend on draws or on the end of a solver
may change by their error bars, as another draw would; all others may not change at all.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

Arrays = Mapping[str, np.ndarray]
ROUNDING = 1e-6
"""Fraction of an array's largest magnitude that counts as rounding: products are stored in single precision."""


@dataclass(frozen=True)
class Fixed:
    """Equal in every run: integers and texts exactly, all other values to rounding."""

    why: str

    def __str__(self) -> str:
        return f"{ROUNDING:g} of the largest"


@dataclass(frozen=True)
class Drawn:
    """May change to another draw: compared in units of the error of a difference of two draws, √2 σ.

    `error` returns σ of each element (of the real part, if they are complex), in a shape that broadcasts, for the
    reference arrays and the array's name, and `why` describes it. An element whose error is zero or NaN may move by
    one percent (`calstudy.regression.WITHOUT_ERROR`), one whose error is infinite by anything. The limits are those of
    the `largest` deviation of an element, of the `rms` of all, σ, and of the mean deviation in its own standard errors,
    as if the elements were independent: a common `shift` of the whole array shows there first.
    """

    error: Callable[[Arrays, str], np.ndarray]
    why: str
    largest: float = 6.0
    rms: float = 2.0
    shift: float = 6.0

    def __str__(self) -> str:
        return f"largest {self.largest:g} σ, rms {self.rms:g} σ, mean {self.shift:g} σ"


@dataclass(frozen=True)
class Measured:
    """Depends on the machine: changes are reported, but are never a failure."""

    why: str

    def __str__(self) -> str:
        return "any"


Tolerance = Fixed | Drawn | Measured
Rules = tuple[tuple[str, Tolerance], ...]
"""Patterns of array names with their tolerance; the first that matches is used."""


def _parent(name: str) -> str:
    return name.rpartition(".")[0]


def _root_mean_square(values: np.ndarray) -> np.ndarray:
    """Return the rms over the last axis, of the real part alone if the values are complex."""
    rms = np.sqrt(np.mean(np.abs(values) ** 2, axis=-1, keepdims=True))
    return rms / np.sqrt(2) if np.iscomplexobj(values) else rms


def rms_of(sibling: str) -> Callable[[Arrays, str], np.ndarray]:
    """Return an error function: the rms of another array in the same domain, such as ``noise.values``."""

    def error(arrays: Arrays, name: str) -> np.ndarray:
        return _root_mean_square(arrays[f"{sibling}.{name.rpartition('.')[2]}"])

    return error


def departure_from_mean(arrays: Arrays, name: str) -> np.ndarray:
    """Return the rms over the last axis of the departure from its mean."""
    values = arrays[name] - arrays[name].mean(axis=-1, keepdims=True)
    return _root_mean_square(values)


def scatter_of_noise(arrays: Arrays, name: str) -> np.ndarray:
    """Return the error of an rms over time of delay transforms, that of noise with a flat expectation in delay."""
    return np.asarray(np.std(arrays[f"{_parent(name)}.noise"]))


def spherical_error(arrays: Arrays, name: str) -> np.ndarray:
    """Return σ_N + σ_S plus the error from the noise's cross power with all other components of the spectrum."""
    series = _parent(name)
    noise, sample = arrays[f"{series}.noise_error"], arrays[f"{series}.sample_error"]
    modes = arrays[f"{series}.noise_modes"]
    # In a mean of M modes σ_N = P_N / √(2 M), and the cross terms have variance P P_N / M = √2 P σ_N / √M.
    cross = np.sqrt(np.sqrt(2) * np.abs(arrays[name].real) * noise / np.sqrt(np.maximum(modes, 1)))
    return noise + sample + cross


def cylindrical_error(arrays: Arrays, name: str) -> np.ndarray:
    """Return the same for cells of a wedge, from the panels of noise and EoR, which are flat in delay."""
    noise = _root_mean_square(arrays["noise.power"].real)
    sample = np.mean(np.abs(arrays["eor.power"].real), axis=-1, keepdims=True)
    pairs = arrays["noise.n_pairs"][:, None]
    cross = np.sqrt(np.sqrt(2) * np.abs(arrays[name].real) * noise / np.sqrt(pairs))
    with_signal = 0 if name.startswith("noise") else sample
    return noise + with_signal + cross if not name.startswith("eor") else sample + 0 * noise


def own_error(arrays: Arrays, name: str) -> np.ndarray:
    """Return the error array that belongs to this array by its name."""
    return arrays[f"{name}_error"]


def spread_of_scale(arrays: Arrays, name: str) -> np.ndarray:
    """Return the scatter of the flux scale of one sky and array between noise realizations, 0.3 %."""
    return np.full(np.shape(arrays[name]), 3e-3)


def typical_error(arrays: Arrays, name: str) -> np.ndarray:
    """Return the error bars of a map, or their median over delays where that is larger.

    The error bars of a bin with a single baseline come from two samples, and are often far too small by chance.
    """
    errors = arrays[f"{name.removesuffix('_error')}_error"]
    counted = np.where(np.isfinite(errors), errors, np.nan)
    return np.fmax(errors, np.nanmedian(counted, axis=-1, keepdims=True))


def half(arrays: Arrays, name: str) -> np.ndarray:
    """Return half the absolute value."""
    return 0.5 * np.abs(arrays[name])


def power_over_samples(arrays: Arrays, name: str) -> np.ndarray:
    """Return the absolute value over the root of the number of samples, at least one."""
    return np.abs(arrays[name]) / np.sqrt(np.maximum(arrays[f"{_parent(name)}.n_samples"], 1))


ERROR_OF_ERROR = Drawn(half, "an error bar is an estimate itself; half of it")
BY_OWN_ERROR = Drawn(own_error, "its error bar")
SPHERICAL_RULES: Rules = (
    (r".*\.power", Drawn(spherical_error, "noise + sample variance, and noise x foregrounds")),
    (r".*\.(noise|sample)_error", ERROR_OF_ERROR),
)
"""Tolerances for figures of spherical power spectra."""
COORDINATES = re.compile(
    r"(.*\.)?(delay|frequency|k|k_perp|k_parallel|bin_edges|baseline_length|horizon_delay|antennas|numbers|enu|highlight)"
)
FIXED_COORDINATE = Fixed("what is plotted against")
FIXED = Fixed("follows from the experiment alone")
MACHINE = Measured("times depend on the machine")


def tolerance(rules: Rules, name: str, reference: Arrays) -> Tolerance:
    """Return the tolerance of an array of a figure, by the figure's rules and all its reference arrays."""
    if any(rule is MACHINE for _, rule in rules):
        return MACHINE
    if COORDINATES.fullmatch(name):
        return FIXED_COORDINATE
    if reference[name].dtype.kind not in "fc":
        return FIXED
    for pattern, rule in rules:
        if re.fullmatch(pattern, name):
            return rule
    if f"{name}_error" in reference:
        return BY_OWN_ERROR
    return ERROR_OF_ERROR if name.endswith("_error") else FIXED
