"""Antennas from a table of positions."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field

from calstudy.base.errors import InputError
from calstudy.instrument.layouts import SITES, ArrayLayout, Layout


class CsvLayout(ArrayLayout):
    """Positions from a CSV file with columns east_m, north_m, up_m and, optionally, name and number.

    It needs `instrument.location`: such a table does not say where the array is.
    """

    site: ClassVar[str | None] = None

    kind: str = "csv"
    path: Path = Field(strict=False, description="CSV file, relative to the experiment file or absolute.")

    @property
    def origin(self) -> str:
        """The field and the file."""
        return f"instrument.layout.path: {self.path}"

    def make(self) -> Layout:
        """Return the antennas of the file.

        Raises
        ------
        InputError
            If there is no such file, or it does not hold antenna positions.
        """
        if not self.path.is_file():
            raise InputError(f"instrument.layout.path: there is no file {self.path}")
        try:
            with self.path.open(newline="", encoding="utf-8-sig") as table:
                rows = list(csv.DictReader(table))
        except (UnicodeDecodeError, csv.Error) as error:
            raise InputError(f"instrument.layout.path: {self.path} is not a CSV file in UTF-8 ({error})") from None
        uneven = next((line for line, row in enumerate(rows, 2) if None in row or None in row.values()), None)
        if uneven is not None:
            raise InputError(
                f"instrument.layout.path: row {uneven} of {self.path} has more or fewer cells than the first"
            )
        columns = set(rows[0]) if rows else set()
        missing = {"east_m", "north_m", "up_m"} - columns
        if missing or len(rows) < 2:
            raise InputError(
                f"instrument.layout.path: {self.path} needs at least two rows with columns east_m, north_m, up_m"
                + (f"; missing: {', '.join(sorted(missing))}" if missing else "")
            )
        try:
            enu = np.array([[float(row[f"{axis}_m"]) for axis in ("east", "north", "up")] for row in rows])
            numbers = np.array([int(row["number"]) for row in rows]) if "number" in columns else np.arange(len(rows))
        except (TypeError, ValueError) as error:
            raise InputError(
                f"instrument.layout.path: {self.path} holds an entry that is not a number ({error})"
            ) from None
        names = tuple(row["name"] for row in rows) if "name" in columns else tuple(f"ant{n:03d}" for n in numbers)
        return Layout(self.path.stem, numbers, names, enu, SITES["mwa"])
