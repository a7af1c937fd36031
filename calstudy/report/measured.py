"""Tables of a report on measured data: chi^2 of the fits, and the level of the noise."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calstudy.base.table import Table
from calstudy.products.files import read_json

QUALITY, NOISE = "quality.json", "noise.json"
FIT_TITLE, NOISE_TITLE = "Fit to the measured data", "Noise of the measured data"
FIT_NOTE = (
    "chi^2 is the mean of |V - g g* F|^2 / sigma^2, with sigma by the radiometer equation from the autocorrelations: "
    "per sample, per degree of freedom (complex unknowns subtracted), and of integrations that were not fitted, from "
    "the solutions of the integrations before and after, with what noise alone would make of it."
)
NOISE_NOTE = (
    "P_N, the mean over baselines of the power of the noise, in mK2 h-3 Mpc3: from the difference of the two halves, "
    "outside the wedge, and from the autocorrelations. The residual has less noise by what the fit absorbs; the "
    "difference of the data as given also has what the sky changes from one half to the other, times their gains."
)


def tables(folder: Path) -> list[Table]:
    """Return the tables of a run of measured data; none for other runs."""
    found = (
        Table(FIT_COLUMNS, _fits(folder), FIT_TITLE, FIT_NOTE),
        Table(NOISE_COLUMNS, _noise(folder), NOISE_TITLE, NOISE_NOTE),
    )
    return [table for table in found if table.rows]


def _fits(folder: Path) -> list[tuple[str, ...]]:
    """Return chi^2 of both halves of measured data; empty for other runs, and without autocorrelations."""
    path = folder / "tables" / QUALITY
    if not path.is_file():
        return []
    found = read_json(path)
    return [_fit(parity, part) for parity, part in found.items() if part.get("samples")]


FIT_COLUMNS = ("half", "samples", "complex unknowns", "per sample", "per degree of freedom", "not fitted", "expected")


def _fit(parity: str, part: Mapping[str, Any]) -> tuple[str, ...]:
    held = part.get("held_out", {})
    numbers = (part["per_sample"], part["per_degree_of_freedom"], held.get("per_sample"), held.get("expected"))
    unknowns = "" if part["unknowns"] is None else f"{part['unknowns']:g}"
    return (parity, str(part["samples"]), unknowns, *("" if item is None else f"{item:.3f}" for item in numbers))


NOISE_COLUMNS = ("of", "from the difference", "from the autocorrelations", "ratio, mean over baselines")


def _noise(folder: Path) -> list[tuple[str, ...]]:
    """Return the noise levels of measured data; empty for other runs."""
    path = folder / "tables" / NOISE
    if not path.is_file():
        return []
    rows = []
    for what, levels in read_json(path).items():
        ratio = levels.get("difference_over_autos")
        powers = ("" if levels[source] is None else f"{levels[source]:.3g}" for source in ("difference", "autos"))
        name = "data as given" if what == "data" else what
        rows.append((name, *powers, "" if ratio is None else f"{ratio['mean']:.3f} ± {ratio['error']:.3f}"))
    return rows
