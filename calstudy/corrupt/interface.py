"""The interface of effects on the data: an effect draws its truth, which is saved, and applies it to visibilities."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from calstudy.base.errors import InputError
from calstudy.base.plugins import Plugin, Registry, guarded, refusal_of
from calstudy.base.resources import Cost
from calstudy.base.schema import fault
from calstudy.corrupt.drift import Drift, refusal_of_antennas

if TYPE_CHECKING:
    from calstudy.base.observation import Observation
    from calstudy.instrument.settings import Size

Truth = Mapping[str, np.ndarray]
"""Arrays of numbers, by name."""


class Effect(Plugin, ABC):
    """An effect on the data between the sky and the calibration.

    Fields of a subclass are its settings. One that draws random numbers declares ``seed: int``. The `Observation` that
    `draw` and `apply` receive has no data: only antennas, baselines, channels, times and polarizations.
    `uses_positions` is true if anything depends on the positions of antennas, which then are those as built.
    """

    registry: ClassVar[Registry[Effect]] = Registry(
        "effect", "calstudy.corrupt.effects", "calstudy.corrupt.interface:Effect", families=True
    )

    inherited_with: ClassVar = {"can_flag": "flags"}
    uses_positions: ClassVar[bool] = True

    kind: str = Field("", description="Name of an effect, or a file.py.")

    @model_validator(mode="after")
    def _does_something(self) -> Self:
        if type(self).apply is Effect.apply and not self.can_flag:
            raise fault("", f"{type(self).__name__} defines neither apply nor flags, so that it would do nothing")
        return self

    def refusal(self, size: Size) -> str | None:
        """Return in one sentence why the effect cannot be applied to data of this size, or None if it can.

        Plans ask before there are data. A sentence about a setting starts with its path and a colon, such as
        ``count: must be ...``.
        """
        del size
        return None

    def draw(self, observation: Observation, random: np.random.Generator) -> Truth:
        """Return the truth that the effect draws or reads, as arrays of numbers by name; by default none.

        `random` is ``numpy.random.default_rng(seed)``.
        """
        del observation, random
        return {}

    def apply(self, visibilities: np.ndarray, observation: Observation, truth: Truth) -> np.ndarray:
        """Return the visibilities after the effect, complex, of the same shape; by default unchanged.

        Those before the effect are complex128 in Jy, (Ntimes, Nbls, Nfreqs, Npols), and may be changed in place. The
        truth is from `draw`.
        """
        del observation, truth
        return visibilities

    def flags(self, observation: Observation, truth: Truth) -> np.ndarray | None:
        """Return the flagged samples, bool, of a shape that broadcasts with the visibilities, or None for none."""
        del observation, truth
        return None

    @property
    def can_flag(self) -> bool:
        """True if the effect defines flags."""
        return type(self).flags is not Effect.flags

    @property
    def drawn_seeds(self) -> dict[str, int | tuple[int, int]]:
        """What seeds the generators that are used, by field; equal ones draw the same numbers."""
        own, drift = getattr(self, "seed", None), getattr(self, "drift", None)
        found = {} if own is None else {"seed": own}
        return found if drift is None else {**found, "drift.seed": drift.stream(own)}

    def cost(self, size: Size) -> Cost:
        """Return the cost of `apply` besides a pass over the data; by default nothing."""
        del size
        return Cost(0.0, memory=0.0)


class GainEffect(Effect):
    """Gains of the antennas: V_ab becomes g_a g_b* V_ab (paper Eq. GENERALMODEL).

    The product of all gain effects is the true gains, with which a calibration is compared.
    """

    uses_positions: ClassVar[bool] = False

    drift: Drift | None = Field(None, description="How the gains change during the run; null: they are constant.")

    def refusal(self, size: Size) -> str | None:
        """Refuse a drift of antennas that do not exist."""
        reason = None if self.drift is None else refusal_of_antennas(self.drift.antennas, size.antennas)
        return None if reason is None else f"drift.antennas: {reason}"

    @property
    def varies(self) -> bool:
        """True if the gains change during the run; a subclass whose own gains do says so, for the plan."""
        return self.drift is not None

    @abstractmethod
    def gains(self, observation: Observation, random: np.random.Generator) -> np.ndarray:
        """Return the gains, complex, shape (Nants, Nfreqs, 1 or Ntimes, Npols), without the drift.

        A single time applies to all. Antennas are in the order of ``observation.numbers``, to which
        ``observation.antennas`` of the baselines refer.
        """

    def draw(self, observation: Observation, random: np.random.Generator) -> Truth:
        """Return the gains, drift included, complex128, (Nants, Nfreqs, 1 or Ntimes, Npols), by the name "gains".

        Raise InputError if they are not an array of the right shape, or are zero or not finite somewhere.
        """
        gains = np.asarray(self.gains(observation, random))
        sizes = observation.n_antennas, observation.n_channels, observation.n_times, observation.n_polarizations
        if gains.shape not in (sizes, (*sizes[:2], 1, sizes[3])) or gains.dtype.kind not in "fc":
            raise InputError(
                f"effect {self.label!r}: its gains are {gains.dtype} of shape {gains.shape}, expected complex of shape "
                f"{sizes} (antennas, channels, times, polarizations), or of one time for constant ones"
            )
        if self.drift is not None:
            gains = gains * self.drift.factors(observation, getattr(self, "seed", None))
        if not np.isfinite(gains).all() or (gains == 0).any():
            raise InputError(f"effect {self.label!r}: its gains are zero or not finite somewhere")
        return {"gains": gains.astype(np.complex128)}

    def apply(self, visibilities: np.ndarray, observation: Observation, truth: Truth) -> np.ndarray:
        """Return g_a(nu, t) g_b*(nu, t) V_ab(nu, t), shape (Ntimes, Nbls, Nfreqs, Npols)."""
        first, second = observation.antennas.T
        gains = np.moveaxis(truth["gains"], 2, 0)
        # One integration after the other: products of all would be as large as the data.
        for time in range(observation.n_times):
            if time < len(gains):
                products = gains[time, first] * gains[time, second].conj()
            visibilities[time] *= products
        return visibilities


def require_usable(effects: Sequence[Effect], size: Size) -> None:
    """Raise InputError, with the effect's own sentence, if one of `corruption.effects` refuses data of a size."""
    for place, effect in enumerate(effects):
        if (reason := refusal_of(effect, size)) is not None:
            named = "." if effect.is_about_field(reason) else f" = {effect.label!r}: "
            raise InputError(f"corruption.effects.{place}{named}{reason}")


def draw_truth(effect: Effect, observation: Observation) -> dict[str, np.ndarray]:
    """Return the truth of an effect for an observation, checked; the same settings and observation give the same bits.

    Raise InputError if the effect refuses, fails, or returns anything but arrays of numbers by name, the same ones at
    every call.
    """
    arrays = _drawn(effect, observation)
    if not effect.is_built_in:
        first, second = (
            {name: array.tobytes() for name, array in drawn.items()} for drawn in (arrays, _drawn(effect, observation))
        )
        if first != second:
            raise InputError(
                f"effect {effect.label!r}: it draws different arrays at every call, so that no run can be repeated; "
                "draw with the generator 'random' that it receives, and declare 'seed: int'"
            )
    return arrays


def _drawn(effect: Effect, observation: Observation) -> dict[str, np.ndarray]:
    random = np.random.default_rng(getattr(effect, "seed", 0))
    with guarded(effect):
        truth = effect.draw(observation, random)
    if not isinstance(truth, Mapping):
        raise InputError(f"effect {effect.label!r}: draw returned {_described(truth)}, expected arrays by name")
    arrays = {str(name): np.asarray(value) for name, value in truth.items()}
    for name, array in arrays.items():
        if array.dtype.kind not in "biufc" or "/" in name:
            raise InputError(
                f"effect {effect.label!r}: {name!r} of its truth is {_described(array)}; expected arrays of numbers "
                "by names without '/'"
            )
    return arrays


def apply_effect(effect: Effect, visibilities: np.ndarray, observation: Observation, truth: Truth) -> np.ndarray:
    """Return visibilities after an effect, complex128, (Ntimes, Nbls, Nfreqs, Npols), checked.

    The visibilities, complex128 in Jy, may be changed in place. Raise InputError if the effect refuses, fails, or
    returns visibilities of another shape or that are not finite.
    """
    shape = visibilities.shape
    with guarded(effect):
        changed = effect.apply(visibilities, observation, truth)
    if not isinstance(changed, np.ndarray) or changed.shape != shape or changed.dtype.kind != "c":
        raise InputError(
            f"effect {effect.label!r}: apply returned {_described(changed)}, expected complex of shape {shape}"
        )
    if not np.isfinite(changed).all():
        raise InputError(f"effect {effect.label!r}: apply returned visibilities that are not finite")
    return changed.astype(np.complex128, copy=False)


def draw_flags(effect: Effect, observation: Observation, truth: Truth) -> np.ndarray | None:
    """Return the flags of an effect, bool, of a shape that broadcasts with the visibilities, checked; None for none.

    Raise InputError if the effect fails, or returns flags of another type or shape.
    """
    with guarded(effect):
        flags = effect.flags(observation, truth)
    if flags is None:
        return None
    shape = observation.shape
    fits = isinstance(flags, np.ndarray) and flags.dtype == bool and flags.ndim == len(shape)
    if not fits or any(size not in (1, whole) for size, whole in zip(flags.shape, shape, strict=True)):
        raise InputError(
            f"effect {effect.label!r}: flags returned {_described(flags)}, expected bool of shape {shape}, or 1 along "
            "an axis"
        )
    return flags


def _described(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype} of shape {value.shape}"
    return f"a {type(value).__name__}"
