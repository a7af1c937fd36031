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
    """Return fields that have these values for measured data, where a calibrator has them and a user does not say.

    Without a model of the sky nothing knows the scale; visibilities of any phase may sum to nothing.
    """
    return {"solver": PATIENT} if has_sky_model else {"solver": PATIENT, "prior": "gains"}


def with_defaults(content: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the content of a file about measured data with the defaults in its section `calibration`.

    Content that is not valid is returned as it is, for validation says what is wrong.

    Parameters
    ----------
    content
        Of the file.
    folder
        Where relative paths start.
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
