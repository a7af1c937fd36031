"""Quantities: units are demanded, converted, and survive a round trip."""

import math

import pytest
from astropy import units
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from calstudy.base.units import (
    Angle,
    Decibel,
    Delay,
    Fraction,
    Frequency,
    HourAngle,
    Length,
    PowerDensity,
    Temperature,
    Wavenumber,
)


@pytest.mark.parametrize(
    ("kind", "text", "value"),
    [
        (Frequency, "80 kHz", 80e3),
        (Frequency, "0.167075GHz", 167.075e6),
        (Delay, "100 ns", 1e-7),
        (Length, "1400 cm", 14.0),
        (HourAngle, "1.8 h", 1.8),
        (HourAngle, "27 deg", 1.8),
        (Decibel, "-40 dB", -40.0),
        (Wavenumber, "0.2 h/Mpc", 0.2),
        (PowerDensity, "12482.356 K2 Mpc3", 12482.356),
        (PowerDensity, "1e6 mK2 Mpc3", 1.0),
        (Frequency, 2 * units.MHz, 2e6),
        (Frequency, 2 * units.Unit("3 MHz"), 6e6),
        (Angle, "10 arcsec", 10 / 3600),
        (Temperature, "180 K", 180.0),
        (Fraction, "5 %", 0.05),
        (Fraction, 0.05, 0.05),
    ],
)
def test_quantities_are_converted_to_si(kind, text, value):
    assert TypeAdapter(kind).validate_python(text) == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize(
    ("kind", "value", "reason"),
    [
        (Frequency, 167, "has no unit"),
        (Frequency, "167", "has no unit"),
        (Frequency, "167 m", "cannot be converted to Hz"),
        (Frequency, "167 kHZ", "cannot be converted to Hz"),
        (Frequency, "80 2 kHz", "cannot be converted to Hz"),
        (Delay, "1 200 ns", "cannot be converted to s"),
        (Length, "1.5.2 m", "cannot be converted to m"),
        (Length, "5 +3 m", "cannot be converted to m"),
        (Length, "10 dB(m)", "cannot be converted to m"),
        (Frequency, "fast", "is not a quantity"),
        (Frequency, "1e999 Hz", "is not finite"),
        (Decibel, "-40", "decibel"),
        (Decibel, -40, "decibel"),
        (Wavenumber, "0.2 1/Mpc", "h/Mpc"),
        (Fraction, "5 m", "not a fraction"),
        (Fraction, True, "not a fraction"),
        (Temperature, "180", "has no unit"),
    ],
)
def test_anything_else_is_refused_with_the_reason(kind, value, reason):
    with pytest.raises(ValidationError, match=reason):
        TypeAdapter(kind).validate_python(value)


@given(st.floats(min_value=1e-12, max_value=1e12))
def test_a_dumped_quantity_reads_back_the_same(value):
    adapter = TypeAdapter(Delay)
    once = adapter.validate_python(f"{value!r} s")
    assert adapter.validate_python(adapter.dump_python(once)) == once


@given(st.sampled_from([("kHz", 1e3), ("MHz", 1e6), ("GHz", 1e9)]), st.integers(1, 10**6))
def test_the_same_quantity_in_another_unit_is_the_same_number(unit, count):
    name, factor = unit
    adapter = TypeAdapter(Frequency)
    assert adapter.validate_python(f"{count} {name}") == adapter.validate_python(f"{count * factor:.0f} Hz")
    assert math.isfinite(adapter.validate_python(f"{count} {name}"))
