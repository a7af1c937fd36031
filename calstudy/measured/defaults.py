"""Defaults of calibrators that differ for measured data."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calstudy.base.errors import InputError
from calstudy.calibrate.interface import CALIBRATORS

DEFAULT = "calamity"
# Real data of few baselines have directions that converge slowly, at next to no cost.
PATIENT = {"name": "gauss-newton", "max_steps": 500}


def defaults(has_sky_model: bool) -> dict[str, Any]:
    """Return default fields for measured data, which apply where a calibrator has them and the user does not set them.

    Without a model of the sky the scale is not known; visibilities of any phase may sum to zero.
    """
    return {"solver": PATIENT} if has_sky_model else {"solver": PATIENT, "prior": "gains"}


def with_defaults(content: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the content of a file about measured data with the defaults in its section `calibration`.

    Relative paths start at `folder`. Invalid content is returned unchanged, because validation reports the error.
    """
    section, observed = content.get("calibration") or {}, content.get("observed")
    block = {CALIBRATORS.tag: section} if isinstance(section, str) else section
    if not isinstance(block, Mapping) or not isinstance(observed, Mapping):
        return dict(content)
    try:
        found, _ = CALIBRATORS.class_of(block, DEFAULT, folder)
    except InputError:
        return dict(content)
    own = defaults(observed.get("sky_model") is not None)
    return {**content, "calibration": {**{k: v for k, v in own.items() if k in found.model_fields}, **block}}
