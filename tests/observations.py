"""Observations that are small enough for tests."""

from __future__ import annotations

from calstudy.instrument.settings import InstrumentSettings


def small_instrument(**changes: object) -> InstrumentSettings:
    """Return a five-antenna, 16-channel, 3-integration observation, with sections replaced by `changes`."""
    sections = {
        "layout": {"kind": "hex", "side": 2, "spacing": "14 m"},
        "beam": "gaussian",
        "channels": {"count": 16, "width": "240 kHz"},
        "times": {"count": 3},
        **changes,
    }
    return InstrumentSettings.model_validate(sections)
