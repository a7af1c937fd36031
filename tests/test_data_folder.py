"""The facts in data/ against what the package uses, so that the folder cannot go stale."""

from __future__ import annotations

import csv
import hashlib
import re
from importlib.metadata import distribution, version
from pathlib import Path

import numpy as np
import pytest

from calstudy.base.package_files import G4JY, MWA_FILES
from calstudy.instrument.array_layouts.observatories import MwaLayout
from calstudy.instrument.layouts import make_layout
from calstudy.sky import counts
from calstudy.sky.catalogue import read_gleam_table

ROOT = Path(__file__).parents[1]
DATA = ROOT / "data"


def rows_of(name):
    with (DATA / name).open(newline="") as table:
        return list(csv.DictReader(table))


INGREDIENTS = rows_of("ingredients.csv")
FILES = [row for row in INGREDIENTS if row["distribution"]]


def installed(row):
    return Path(str(distribution(row["distribution"]).locate_file(row["path"])))


def test_every_file_is_explained_and_every_explained_file_is_there():
    text = (DATA / "README.md").read_text()
    names = {path.name for path in DATA.iterdir()}
    assert names == {"README.md", *re.findall(r"^\| `([a-z_]+\.csv)` \|", text, re.MULTILINE)}


def test_source_counts_are_those_of_the_code():
    values = {row["quantity"]: float(row["value"]) for row in rows_of("source_counts.csv")}
    assert tuple(values.pop(f"a{power}") for power in range(6)) == counts.COEFFICIENTS
    assert values.pop("frequency") * 1e6 == counts.COUNTS_FREQUENCY
    assert values.pop("faintest") / 1e3 == counts.FAINTEST
    assert values.pop("brightest") == counts.BRIGHTEST
    assert values.pop("spectral_index") == counts.SPECTRAL_INDEX
    assert not values


def test_tiles_are_the_antennas_of_the_layouts():
    listed = {}
    for row in rows_of("mwa_tiles.csv"):
        listed.setdefault(row["layout"], []).append((int(row["index"]), int(row["number"]), row["tile"]))
    assert set(listed) == {"mwa-compact-minredundant", "mwa-compact-hex-east", "mwa-compact-hex-south"}
    for kind, tiles in listed.items():
        layout = make_layout(MwaLayout(kind=kind))
        assert tiles == list(zip(range(36), layout.numbers, layout.names, strict=True))


def test_the_excerpt_holds_the_brightest_sources_of_the_catalogue():
    catalogue = read_gleam_table(G4JY.find())
    brightest = catalogue[np.argsort(-catalogue.flux, kind="stable")[:20]]
    rows = rows_of("catalogue_excerpt.csv")
    assert [row["name"] for row in rows] == brightest.names.tolist()
    for column, expected, digits in (
        ("ra_deg", np.rad2deg(brightest.right_ascension), 5),
        ("dec_deg", np.rad2deg(brightest.declination), 5),
        ("flux_200MHz_Jy", brightest.flux, 4),
        ("spectral_index", brightest.spectral_index, 4),
    ):
        found = [float(row[column] or counts.SPECTRAL_INDEX) for row in rows]
        np.testing.assert_allclose(found, expected, rtol=0, atol=0.51 * 10.0**-digits)


@pytest.mark.parametrize("row", FILES, ids=[row["name"] for row in FILES])
def test_files_of_other_packages_are_the_ones_described(row):
    if version(row["distribution"]) != row["version"]:
        pytest.skip(f"{row['distribution']} {version(row['distribution'])} is installed, not {row['version']}")
    path = installed(row)
    assert path.stat().st_size == int(row["bytes"])
    with path.open("rb") as stream:
        assert hashlib.file_digest(stream, "sha256").hexdigest() == row["sha256"]


def test_versions_are_the_pinned_ones():
    pins = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())
    for row in FILES:
        assert pins[row["distribution"].replace("_", "-")] == row["version"]


def test_the_hashes_of_the_files_of_mwa_pb_are_those_in_the_code():
    listed = {Path(row["path"]).name: row["sha256"] for row in FILES if row["distribution"] == "mwa_pb"}
    assert listed == {file.name: file.sha256 for file in MWA_FILES.values()}


def test_every_ingredient_has_a_source_and_a_licence():
    assert all(row["used_for"] and row["source"] and row["licence"] for row in INGREDIENTS)
