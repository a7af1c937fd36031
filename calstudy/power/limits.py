"""Published upper limits of the power spectrum: tables of Delta^2(k) = k^3 P(k) / (2 pi^2) by redshift."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.package_files import published

COLUMNS = ("name", "reference", "z", "k", "delta2")
WITHIN = 0.5
"""Largest difference in redshift of limits that are compared with a spectrum."""


@dataclass(frozen=True, eq=False)
class Limits:
    """The upper limits of a publication at one redshift, that of the middle of their band.

    k is ascending, h/Mpc, (Nk,), and `delta2` are upper limits of Delta^2, mK^2, (Nk,).
    """

    name: str
    reference: str
    redshift: float
    k: np.ndarray
    delta2: np.ndarray

    @property
    def power(self) -> np.ndarray:
        """The upper limits of P(k), mK^2 h^-3 Mpc^3, (Nk,)."""
        return self.delta2 * 2 * np.pi**2 / self.k**3


def published_limits() -> Path:
    """Return the table of published limits that comes with calstudy."""
    return published("experiments") / "published-limits.csv"


def read_limits(path: Path) -> list[Limits]:
    """Read a CSV with the columns of `COLUMNS`: k in h/Mpc, delta2 in mK^2; a row for each k.

    Raises InputError if the file is no such table, or has a number that is not positive.
    """
    found: dict[tuple[str, str, float], list[tuple[float, float]]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            table = csv.DictReader(file)
            if missing := [name for name in COLUMNS if name not in (table.fieldnames or ())]:
                raise InputError(f"{path}: has no column {', '.join(missing)}; it needs {', '.join(COLUMNS)}")
            for row in table:
                z, k, delta2 = (_positive(row[name], name, path, table.line_num) for name in COLUMNS[2:])
                found.setdefault((row["name"], row["reference"], z), []).append((k, delta2))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as a table of limits ({error})") from None
    return [Limits(*key, *np.array(sorted(points)).T) for key, points in found.items()]


def _positive(text: str | None, name: str, path: Path, line: int) -> float:
    try:
        number = float(text or "")
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise InputError(f"{path}, line {line}: {name} = {text!r} is not a positive number")
    return number


def limits_near(found: Sequence[Limits], redshift: float) -> list[Limits]:
    """Return the limits of each name at its redshift closest to the given one, of those within `WITHIN`."""
    closest: dict[str, Limits] = {}
    for limits in sorted(found, key=lambda limits: abs(limits.redshift - redshift)):
        if abs(limits.redshift - redshift) <= WITHIN:
            closest.setdefault(limits.name, limits)
    return list(closest.values())
