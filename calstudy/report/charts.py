"""The arrays of figures as interactive charts of the report."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

# Series in the order of the legend: field, label, and name of the colour in page.css.
SERIES = {
    "eor": ("EoR, P^S", "grey"),
    "uncorrupted": ("perfect gains, P^(S+F+N)", "black"),
    "uncalibrated": ("uncalibrated, P^V", "red"),
    "residual": ("residual, P^R", "orange"),
    "residual_without_eor": ("residual without EoR", "cyan"),
    "noise": ("noise, P^N", "magenta"),
    "outside": ("outside the wedge", "orange"),
    "inside": ("inside the wedge", "cyan"),
}
POWER = "P [mK² h⁻³ Mpc³]"


@dataclass(frozen=True)
class Chart:
    """Curves over k, or maps over k_perp and k_parallel.

    `data` is the input of the page's script: `kind`, labels and series, ready for JSON.
    """

    title: str
    data: Mapping[str, Any]


def read_charts(path: Path) -> list[Chart]:
    """Return the charts of the arrays of a figure (``NAME.npz`` from `calstudy.plotting.save`); none for other arrays.

    An entry ``GROUP.FIELD`` is a field of a spectrum: `power` over `k`, a transfer function over `k`, or either over
    `k_perp` and `k_parallel`.
    """
    groups: dict[str, dict[str, np.ndarray]] = {}
    with np.load(path, allow_pickle=False) as arrays:
        for name in arrays.files:
            group, _, field = name.rpartition(".")
            groups.setdefault(group, {})[field] = arrays[name]
    return [chart for chart in (*_spectra(groups), _transfer(groups), _maps(groups)) if chart is not None]


def _spectra(groups: Mapping[str, Mapping[str, np.ndarray]]) -> list[Chart]:
    """Return a chart for each column of spherical power spectra."""
    columns: dict[str, dict[str, Any]] = {}
    for name, fields in groups.items():
        column, _, series = name.rpartition(".")
        if {"k", "power", "noise_error", "sample_error"} <= fields.keys():
            error = np.hypot(fields["noise_error"], fields["sample_error"])
            columns.setdefault(column, {})[series] = (fields["k"], fields["power"].real, error)
    charts = []
    for column, found in columns.items():
        title = str(groups.get(column, {}).get("title", np.array("")))
        charts.append(_curves(f"Power spectra, {title}" if title else "Power spectra", POWER, True, found))
    return charts


def _transfer(groups: Mapping[str, Mapping[str, np.ndarray]]) -> Chart | None:
    """Return the chart of transfer functions, free of the flux scale."""
    found = {
        name: (fields["k"], fields["scale_free_transfer"], fields["scale_free_transfer_error"])
        for name, fields in groups.items()
        if {"k", "scale_free_transfer", "scale_free_transfer_error"} <= fields.keys()
    }
    return _curves("T, free of the flux scale", "T", False, found) if found else None


def _curves(title: str, label: str, logarithmic: bool, found: Mapping[str, tuple[np.ndarray, ...]]) -> Chart:
    ordered = [name for name in SERIES if name in found] + [name for name in found if name not in SERIES]
    series = []
    for name in ordered:
        k, value, error = found[name]
        kept = np.isfinite(value)
        text, colour = SERIES.get(name, (name.replace("_", " "), "grey"))
        rounded = {key: _rounded(array[kept]) for key, array in (("x", k), ("y", value), ("error", error))}
        series.append({"label": text, "colour": colour, **rounded})
    data = {"kind": "curves", "x": "k [h/Mpc]", "y": label, "logarithmic": logarithmic, "series": series}
    return Chart(title, data)


def _maps(groups: Mapping[str, Mapping[str, np.ndarray]]) -> Chart | None:
    """Return the chart of cylindrical spectra, or of a cylindrical transfer function."""
    series: list[dict[str, Any]] = []
    logarithmic, label = True, POWER
    for name in [*SERIES, *(name for name in groups if name not in SERIES)]:
        fields = groups.get(name, {})
        quantity = "power" if "power" in fields else "transfer"
        if not {"k_perp", "k_parallel", "horizon_delay", "delay", quantity} <= fields.keys():
            continue
        values = np.asarray(fields[quantity].real, "<f4")
        if quantity == "transfer":
            logarithmic, label = False, "T"
        axes = {key: _rounded(fields[key]) for key in ("k_perp", "k_parallel", "baseline_length")}
        axes["horizon"] = _rounded(fields["horizon_delay"] / fields["delay"][-1])
        encoded = base64.b64encode(values.tobytes()).decode("ascii")
        series.append({"label": SERIES.get(name, (name,))[0], "values": encoded, **axes})
    if not series:
        return None
    kind = {"kind": "maps", "value": label, "logarithmic": logarithmic, "series": series}
    return Chart("Cylindrical power spectra" if logarithmic else "Cylindrical T", kind)


def _rounded(values: np.ndarray) -> list[float | None]:
    """Return numbers with five digits, None where they are not finite."""
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in np.asarray(values, float)]
