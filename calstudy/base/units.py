"""Physical quantities in experiment files: strings with units in the file, SI floats in the program.

Each type below is a field type for `calstudy.base.schema.Section`: it accepts a string such as ``"80 kHz"`` (or an
astropy `Quantity`), refuses a bare number, and yields a float in the type's own unit. It serializes back to a string
with that unit, so that a resolved experiment file can be read again.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import lru_cache
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, PlainSerializer
from pydantic_core import PydanticCustomError

LARGEST_DECIBEL = 200
NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*$")


@lru_cache(maxsize=256)
def _factor(unit: str, target: str, plain: bool) -> float:
    """Return the factor from `unit` to `target`; raises ValueError if the dimensions differ.

    A `plain` unit has no number of its own.
    """
    from astropy import units

    found = units.Unit(unit)
    # "80 2 kHz" would have the unit "2 kHz", and "10 dB(m)" has a logarithmic one.
    if not isinstance(found, units.UnitBase) or (plain and found.scale != 1):
        raise ValueError(unit)
    try:
        return float(found.to(units.Unit(target)))
    except units.UnitConversionError:
        raise ValueError(unit) from None


def _fail(value: Any, reason: str) -> PydanticCustomError:
    return PydanticCustomError("quantity", "{value} {reason}", {"value": repr(value), "reason": reason})


def _split(value: Any) -> tuple[float, str | None]:
    """Return the number and the unit of a text; the unit is None for anything else."""
    match = NUMBER.match(value) if isinstance(value, str) else None
    return (math.nan, None) if match is None else (float(match[1]), match[2])


def parse_quantity(value: Any, target: str, example: str) -> float:
    """Convert ``"80 kHz"`` or an astropy quantity to a float in the unit `target`.

    `example` is a valid value for error messages. Raises PydanticCustomError if the value has no unit, an unknown unit,
    or a unit of another dimension, or is not finite.
    """
    hint = f'write a number with a unit, such as "{example}"'
    if hasattr(value, "unit"):
        number, unit = float(value.value), value.unit.to_string()
    else:
        number, unit = _split(value)
    if unit is None and isinstance(value, str):
        raise _fail(value, f"is not a quantity: {hint}")
    if not unit:
        raise _fail(value, f"has no unit: {hint}")
    if not math.isfinite(number):
        raise _fail(value, f"is not finite: {hint}")
    try:
        factor = _factor(unit, target, isinstance(value, str))
    except (ValueError, TypeError):
        raise _fail(value, f"has a unit that cannot be converted to {target}: {hint}") from None
    # Rounding removes binary errors: numbers are easier to read, and equal quantities in any unit have equal hashes.
    return float(f"{number * factor:.15g}")


def parse_decibel(value: Any) -> float:
    """Convert ``"-40 dB"`` to the float -40.0; raises PydanticCustomError for anything else."""
    number, unit = _split(value)
    if unit != "dB":
        raise _fail(value, 'is not a level in decibel: write for example "-40 dB"')
    if abs(number) > LARGEST_DECIBEL:
        raise _fail(value, f"is beyond {LARGEST_DECIBEL} dB either way")
    return number


def parse_hour_angle(value: Any) -> float:
    """Convert ``"1.8 h"`` or an angle (``"27 deg"``) to a float in hours of right ascension."""
    number, unit = _split(value)
    return number if unit in ("h", "hr", "hour") else parse_quantity(value, "hourangle", "1.8 h")


def parse_wavenumber(value: Any) -> float:
    """Convert ``"0.2 h/Mpc"`` to a float in h/Mpc; other units are refused, because h depends on the cosmology."""
    number, unit = _split(value)
    if (unit or "").replace(" ", "") not in ("h/Mpc", "hMpc-1", "hMpc^-1"):
        raise _fail(value, 'is not a wavenumber: write for example "0.2 h/Mpc"')
    return number


def parse_fraction(value: Any) -> float:
    """Convert ``"15 %"`` or the number 0.15 to the float 0.15; raises PydanticCustomError for anything else."""
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    number, unit = (value, "") if plain else _split(value)
    if unit not in ("", "%"):
        raise _fail(value, 'is not a fraction: write for example "15 %" or 0.15')
    if plain and not math.isfinite(number):
        raise _fail(value, "is not finite")
    return float(f"{number / (100 if unit else 1):.15g}")


def _field(validate: Callable[[Any], float], unit: str, example: str) -> Any:
    return Annotated[
        float,
        BeforeValidator(validate, json_schema_input_type=str),
        PlainSerializer(lambda value: f"{value!r} {unit}", return_type=str),
        Field(json_schema_extra={"unit": unit, "example": example}),
    ]


def _quantity(target: str, example: str) -> Any:
    return _field(lambda value: parse_quantity(value, target, example), target, example)


Frequency = _quantity("Hz", "80 kHz")
Time = _quantity("s", "2 s")
Delay = _quantity("s", "100 ns")
Length = _quantity("m", "14 m")
FluxDensity = _quantity("Jy", "50 mJy")
PowerDensity = _quantity("K2 Mpc3", "12482.356 K2 Mpc3")
Angle = _quantity("deg", "0.5 deg")
Area = _quantity("m2", "21.5 m2")
Phase = _quantity("rad", "0.01 rad")
HourAngle = _field(parse_hour_angle, "h", "1.8 h")
Temperature = _quantity("K", "180 K")
Wavenumber = _field(parse_wavenumber, "h/Mpc", "0.2 h/Mpc")
Fraction = Annotated[float, BeforeValidator(parse_fraction, json_schema_input_type=float | str)]
Decibel = _field(parse_decibel, "dB", "-40 dB")
