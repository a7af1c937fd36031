"""Broken experiment files, many of them, the same in every run: what a hurried user, or a bad editor, may hand in."""

from __future__ import annotations

import copy
import itertools
import math
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from pyuvdata import ShortDipoleBeam, UVBeam
from tiny import tiny

from calstudy.experiment.files import override, validate

SEED = 20220422

NOTHING: list[Any] = [None, [], {}, "", "banana", math.nan, math.inf, True, -7, 3.14159, [[]], {"a": 1}, [None]]
QUANTITIES: list[Any] = [
    "5 banana",
    "3 kg",
    "nan",
    "inf Hz",
    "80",
    80,
    80.0,
    "ten MHz",
    "1e999 m",
    "-5 m",
    "0 s",
    "1 2 s",
]
NUMBERS: list[Any] = ["3", "three", "1e3 x", -1, -0.5, 1e300, 10**30, 0, 2.5]
CHOICES: list[Any] = ["nonsense", "Gauss-Newton", "none of these", 7, ["xx"], {"kind": "nonsense"}, {"kind": 3}]


@dataclass(frozen=True)
class Broken:
    """A file that must be refused, or that is harmless after all.

    Attributes
    ----------
    name
        What is wrong with it.
    text
        Its content, bytes.
    field
        What a refusal must name one of: the field or its block, or the file's own name; anything if empty.
    """

    name: str
    text: bytes
    field: tuple[str, ...]


def _leaves(block: dict[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, value in block.items():
        yield (*above, key), value
        if isinstance(value, dict):
            yield from _leaves(value, (*above, key))


def _with(data: dict[str, Any], path: tuple[str, ...], value: Any) -> dict[str, Any]:
    changed = copy.deepcopy(data)
    block = changed
    *parents, last = path
    for step in parents:
        block = block[step]
    block[last] = value
    return changed


def _pool(value: Any) -> list[Any]:
    if isinstance(value, str) and value[:1].isdigit():
        return QUANTITIES + NOTHING
    if isinstance(value, bool | int | float):
        return NUMBERS + NOTHING
    if isinstance(value, str):
        return CHOICES + NOTHING
    return NOTHING + CHOICES + NUMBERS


def resolved(folder: Path) -> dict[str, Any]:
    """Return the tiny experiment with every field filled in."""
    data = validate(tiny(folder), folder).model_dump(mode="json")
    return {key: value for key, value in data.items() if key not in ("scales", "sweep")}


def wrong_values(folder: Path, per_field: int = 1) -> Iterator[Broken]:
    """Yield the whole experiment with one field changed to something it is hardly meant to be."""
    data, rng = resolved(folder), random.Random(SEED)
    for path, value in _leaves(data):
        for index, wrong in enumerate(rng.sample(_pool(value), per_field)):
            text = yaml.safe_dump(_with(data, path, wrong), sort_keys=False).encode()
            yield Broken(f"{'.'.join(path)}={wrong!r}#{index}", text, path[-2:])


def unknown_keys(folder: Path) -> Iterator[Broken]:
    """Yield the experiment with a misspelt key in each of its blocks."""
    data = resolved(folder)
    for path, value in _leaves(data):
        if isinstance(value, dict):
            key = f"{next(iter(value), 'x')}x"
            text = yaml.safe_dump(_with(data, (*path, key), 1), sort_keys=False).encode()
            yield Broken(f"unknown {'.'.join(path)}.{key}", text, (key,))


def missing_files(folder: Path) -> Iterator[Broken]:
    """Yield experiments that name input files which are not there, or are folders."""
    data = override(tiny(folder), "instrument.location", "mwa")
    for path, block in (
        ("instrument.layout", {"kind": "csv"}),
        ("instrument.beam", {"kind": "beamfits"}),
        ("instrument.beam", {"kind": "mwa-embedded-element"}),
        ("sky.foregrounds", {"kind": "file"}),
        ("sky.foregrounds", {"kind": "gleam"}),
        ("corruption.effects", {"kind": "file-gains"}),
        ("calibration.initial_gains", {"kind": "file"}),
        ("calibration.weights", {"kind": "file"}),
    ):
        for file in ("no-such-file.dat", ".", "/dev/null/x", "~nobody-of-that-name/x", "a\x00b"):
            section, field = path.split(".")
            changed = copy.deepcopy(data)
            named = {**block, "path": file}
            changed.setdefault(section, {})[field] = [named] if field == "effects" else named
            text = yaml.safe_dump(changed, sort_keys=False).encode()
            yield Broken(f"{path}: {block['kind']} at {file!r}", text, (field,))


LAYOUTS = {
    "empty": "",
    "header alone": "east_m,north_m,up_m\n",
    "one antenna": "east_m,north_m,up_m\n0,0,0\n",
    "duplicate position": "east_m,north_m,up_m\n0,0,0\n0,0,0\n14,0,0\n28,0,0\n",
    "duplicate number": "east_m,north_m,up_m,number\n0,0,0,1\n14,0,0,1\n28,0,0,2\n",
    "duplicate name": "east_m,north_m,up_m,name\n0,0,0,a\n14,0,0,a\n28,0,0,b\n",
    "not a number": "east_m,north_m,up_m\n0,0,0\n14,x,0\n28,0,0\n",
    "nan": "east_m,north_m,up_m\n0,0,0\nnan,0,0\n28,0,0\n",
    "infinite": "east_m,north_m,up_m\n0,0,0\ninf,0,0\n28,0,0\n",
    "missing column": "east_m,north_m\n0,0\n14,0\n28,0\n",
    "short row": "east_m,north_m,up_m\n0,0,0\n14,0\n28,0,0\n",
    "long row": "east_m,north_m,up_m\n0,0,0\n14,0,0,7\n28,0,0\n",
    "far away": "east_m,north_m,up_m\n0,0,0\n1e9,0,0\n28,0,0\n",
    "negative number": "east_m,north_m,up_m,number\n0,0,0,-1\n14,0,0,1\n28,0,0,2\n",
    "fractional number": "east_m,north_m,up_m,number\n0,0,0,1.5\n14,0,0,1\n28,0,0,2\n",
    "not text": "\x00\x01\x02\xff",
    "decimal commas": "east_m;north_m;up_m\n0;0;0\n14,5;0;0\n",
}
"""Bad tables of antenna positions."""


def bad_layouts(folder: Path) -> Iterator[Broken]:
    """Yield experiments whose layout is a CSV file with a fault."""
    for index, (name, table) in enumerate(LAYOUTS.items()):
        path = folder / f"layout{index}.csv"
        path.write_bytes(table.encode("latin-1"))
        data = override(tiny(folder), "instrument.location", "mwa")
        data = override(data, "instrument.layout", {"kind": "csv", "path": str(path)})
        yield Broken(f"layout: {name}", yaml.safe_dump(data, sort_keys=False).encode(), (path.name, "longest baseline"))


IMPLAUSIBLE: list[tuple[str, Any, str]] = [
    ("instrument.channels.width", "80 mHz", "at least 100 Hz"),
    ("instrument.channels.width", "80 GHz", "at most 10 MHz"),
    ("instrument.channels.first", "170", "has no unit"),
    ("instrument.channels.first", "170 Hz", "at least 10 MHz"),
    ("instrument.channels.first", "167 kHz", "at least 10 MHz"),
    ("instrument.channels.first", "-170 MHz", "at least 10 MHz"),
    ("instrument.channels.first", "170 GHz", "21 cm line"),
    ("instrument.channels.count", 10**8, "at most 65536"),
    ("instrument.channels.count", 1, "at least 8"),
    ("instrument.times.integration", "5 d", "at most 3600 s"),
    ("instrument.times.integration", "2 fs", "at least 1 ms"),
    ("instrument.times.integration", "-2 s", "at least 1 ms"),
    ("instrument.times.count", 10**9, "at most 100000"),
    ("instrument.times", {"integration": "1 h", "count": 56}, "56 integrations of 3600 s are 56 h; a day"),
    ("instrument.times.start_lst", "25 h", "less than 24"),
    ("instrument.layout.side", 10**5, "at most 26"),
    ("instrument.layout.spacing", "1 nm", "at least 10 mm"),
    ("instrument.layout", {"kind": "linear", "count": 10**6}, "at most 2000"),
    ("instrument.layout", {"kind": "rectangular", "count": 10**6}, "at most 2000"),
    ("instrument.layout", {"kind": "rectangular", "max_baseline": "5 m"}, "must exceed the length of a row"),
    ("instrument.layout", {"kind": "hera-19", "count": 30}, "instrument.layout.count: 30 is more than the 19"),
    ("instrument.layout", {"kind": "golomb", "count": 100}, "at most 16"),
    ("instrument.location", "mars", "'mars' is not a choice"),
    ("instrument.location", {"latitude": "-91 deg", "longitude": "0 deg"}, "at least -90 deg"),
    ("instrument.beam", {"kind": "hera", "model": "nic-cst"}, "is not within the beam file's 100 to 145 MHz"),
    ("instrument.beam", {"kind": "airy", "diameter": "0 m"}, "diameter"),
    ("instrument.polarizations", ["xx", "xx"], "names a polarization twice"),
    ("instrument.polarizations", ["zz"], "not a choice (allowed: xx, yy)"),
    ("instrument.polarizations", "xx", "must be a list"),
    ("sky.eor.index", -2, "-2 has no effect with spectrum: flat"),
    ("sky.eor.nside", "64", "is a text; write it without quotes"),
    ("sky.eor.nside", 100, "allowed: 16, 32, 64, 128, 256"),
    ("sky.foregrounds.count", 10**12, "at most 100000000"),
    ("sky.foregrounds.flux_limit", "1e9 Jy", "at most 197 Jy"),
    ("sky.foregrounds.flux_limit", "200 Jy", "at most 197 Jy"),
    ("sky.foregrounds.flux_limit", "1 uJy", "at least 0.001 Jy"),
    ("sky.foregrounds.index_scatter", 0.2, "has no effect with spectrum: flat"),
    ("instrument.beam", {"kind": "airy", "diameter": "1e9 m"}, "at most 1 km"),
    ("instrument.beam", {"kind": "gaussian", "fwhm_deg": 1e-9}, "at least 0.01"),
    ("instrument.beam", {"kind": "gaussian", "reference_frequency": "1 Hz"}, "at least 10 MHz"),
    ("power.bins.width", "1e-9 h/Mpc", "8e+08 bins, and at most 10000"),
    ("power.bins", {"min": "2 h/Mpc", "max": "1 h/Mpc"}, "must be larger than min"),
    ("power.bins.max", "1e9 h/Mpc", "at most 1000"),
    ("power.length_bin", "1 nm", "at least 10 mm"),
    ("calibration.integrations_per_solve", 1000, "use at most 2"),
    ("calibration.basis.buffer", "1 s", "calibration.basis"),
    ("outputs.store", "/etc/passwd", "is a file; a folder is needed"),
    ("outputs.runs", "/etc/passwd", "is a file; a folder is needed"),
    # Where nobody can make a folder, not even root.
    ("outputs.store", "/proc/store", "cannot be written (No such file or directory); no folder can be made in /proc"),
    ("outputs.runs", "/proc/runs", "cannot be written (No such file or directory); no folder can be made in /proc"),
    ("outputs.store", "x" * 300, "cannot be written (File name too long)"),
    (
        "instrument",
        {"layout": {"kind": "csv", "path": "x" * 300}, "location": "mwa"},
        "cannot be read (File name too long",
    ),
    ("calibration.assumed", {"sky_model": "x" * 300}, "cannot be read (File name too long"),
    ("outputs.store", None, "outputs.store (empty): must be a path"),
    ("outputs.convergence.steps", ["a"], "must be a whole number"),
    ("scales", {"small": {"instrument.banana": 3}}, "scales.small: instrument.banana: unknown key"),
    ("scales", {"small": {"instrument.times.count": -3}}, "scales.small: instrument.times.count = -3"),
    ("scales", {"small": {"name.x": 3}}, "scales.small: "),
    ("scales", {"small": 3}, "scales.small = 3"),
    ("sweep", {"sky.eor.seed": list(range(300)), "corruption.noise.factor": list(range(1, 301))}, "90000 points"),
    ("sweep", {"sky.eor.seed": [1, 1]}, "names the value 1 twice"),
    ("realizations", {"draw": ["eor"], "count": 10**6}, "at most 1000"),
    ("realizations", {"draw": [], "count": 3}, "names nothing"),
    ("name", "my run", "'my run' cannot name a folder"),
    ("name", "x" * 65, "at most 64"),
]
"""A field, a value that no one means, and what the refusal says."""


def implausible(folder: Path) -> Iterator[Broken]:
    """Yield experiments with one value that is of the right kind, and cannot be meant."""
    for number, (path, value, told) in enumerate(IMPLAUSIBLE):
        text = yaml.safe_dump(override(tiny(folder), path, value), sort_keys=False).encode()
        yield Broken(f"{number}: {path} = {str(value)[:40]}", text, (told,))


def bad_beams(folder: Path) -> Iterator[Broken]:
    """Yield experiments whose beam file cannot serve; the files are made here."""
    for name, (kind, told) in write_beams(folder).items():
        data = override(tiny(folder), "instrument.beam", {"kind": kind, "path": str(folder / name)})
        yield Broken(f"beam: {name}", yaml.safe_dump(data, sort_keys=False).encode(), (told,))


def write_beams(folder: Path) -> dict[str, tuple[str, str]]:
    """Write beam files; return for each the kind of beam that it is given for, and what the refusal says."""
    (folder / "text.beamfits").write_text("not a beam\n" * 100)
    (folder / "text.h5").write_text("not a beam\n" * 100)
    (folder / "empty.beamfits").touch()
    with h5py.File(folder / "other.h5", "w") as file:
        file["x"] = 3.0
    table = make_beam()
    table.select(freq_chans=[0], inplace=False).write_beamfits(folder / "one_frequency.beamfits", clobber=True)
    table.select(freq_chans=[0, 1, 2], inplace=False).write_beamfits(folder / "short.beamfits", clobber=True)
    stokes = table.efield_to_pstokes(inplace=False)
    stokes.write_beamfits(folder / "stokes.beamfits", clobber=True)
    return {
        "text.beamfits": ("beamfits", "text.beamfits cannot be read as beamfits"),
        "empty.beamfits": ("beamfits", "empty.beamfits cannot be read as beamfits"),
        "one_frequency.beamfits": ("beamfits", "is not within the beam file's 160 to 160 MHz"),
        "short.beamfits": ("beamfits", "is not within the beam file's 160 to 180 MHz"),
        "stokes.beamfits": ("beamfits", "stokes.beamfits cannot be read as beamfits"),
        "text.h5": ("mwa-embedded-element", "text.h5 cannot be read as an MWA beam file"),
        "other.h5": ("mwa-embedded-element", "names no frequencies"),
    }


def make_beam() -> UVBeam:
    """Return a beam of short dipoles, tabulated every 10 MHz from 160 to 190 MHz."""
    dipole = ShortDipoleBeam(feed_array=["x", "y"])
    axes = {"axis1_array": np.radians(np.arange(0, 360, 10)), "axis2_array": np.radians(np.arange(0, 91, 10))}
    return dipole.to_uvbeam(freq_array=np.arange(160e6, 191e6, 10e6), beam_type="efield", **axes)


TEXTS = {
    "empty": b"",
    "comment": b"# nothing\n",
    "list": b"- name\n- instrument\n",
    "number": b"3\n",
    "text": b"quickstart\n",
    "tab": b"name: x\n\tinstrument: {}\n",
    "unclosed": b"name: {x\n",
    "duplicate key": b"name: x\nname: y\n",
    "number as key": b"name: x\n3: y\n",
    "list as key": b"? [a, b]\n: y\n",
    "null key": b"name: x\n~: y\n",
    "two documents": b"name: x\n---\nname: y\n",
    "latin-1": "name: é\n".encode("latin-1"),
    "control": b"name: \x07x\n",
    "binary": bytes(range(256)),
    "undefined alias": b"name: *x\n",
    "recursive alias": b"name: &x [*x]\n",
    "recursive block": b"name: x\ninstrument: &i {beam: *i}\n",
    "merge key": b"name: x\ninstrument: &i {beam: airy}\nsky: {<<: *i}\n",
    "deep": b"name: " + b"[" * 3000 + b"]" * 3000,
    "deep blocks": b"name: " + b"{a: " * 2000 + b"x" + b"}" * 2000,
    "system": b"name: !!python/object/apply:os.system ['touch pwned']\n",
    "object": b"name: !!python/object:calstudy.base.errors.InputError {}\n",
    "module": b"name: !!python/module:os\n",
    "python name": b"name: !!python/name:os.system\n",
    "python tuple": b"name: x\nsweep: !!python/tuple [1, 2]\n",
    "own tag": b"name: !experiment x\n",
    "binary tag": b"name: !!binary aGVsbG8=\n",
    "set tag": b"name: x\nvariants: !!set {a, b}\n",
    "timestamp": b"name: 2022-04-22\n",
    "bad timestamp": b"name: 2022-99-99\n",
    "bad int tag": b"name: !!int x\n",
    "bad float tag": b"name: !!float x\n",
    "sexagesimal": b"name: x\ninstrument: {times: {start_lst: 1:30:00}}\n",
    "octal": b"name: 0777\n",
    "octal count": b"name: x\nsky: {eor: {seed: 010}}\n",
    "negative octal": b"name: x\nsky: {eor: {seed: -017}}\n",
    "sexagesimal seed": b"name: x\nsky: {eor: {seed: 6:24}}\n",
    "sexagesimal fraction": b"name: x\nsky: {eor: {index: 1:30.5}}\n",
    "huge integer": b"name: x\nsky: {eor: {seed: " + b"9" * 5000 + b"}}\n",
    "collection of nothing": b"name: x\nexperiments: []\n",
    "collection without name": b"experiments: [x.yaml]\n",
    "collection of a missing file": b"name: x\nexperiments: [nowhere.yaml]\n",
    "collection of numbers": b"name: x\nexperiments: [3]\n",
    "collection of itself": b"name: x\nexperiments: [file.yaml]\n",
    "collection with a bad figure": b"name: x\nexperiments: [file.yaml]\nfigures: [banana]\n",
}
"""Texts that are not the YAML of a block of keys, or not safe to build."""


def bad_texts(folder: Path) -> Iterator[Broken]:
    """Yield files that are not the YAML of a block of keys, or not safe to build."""
    good = yaml.safe_dump(tiny(folder), sort_keys=False)
    laughs = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"{new}: &{new} [{', '.join(f'*{old}' for _ in range(9))}]\n" for old, new in itertools.pairwise("abcdefghi")
    )
    texts = {
        **TEXTS,
        "duplicate inner key": good.encode() + b"power: {taper: hann, taper: none}\n",
        "utf-16": good.encode("utf-16"),
        "nul": good.encode() + b"\x00",
        "billion laughs": laughs.encode(),
        "missing name": yaml.safe_dump({k: v for k, v in tiny(folder).items() if k != "name"}).encode(),
        "path as name": good.replace("name: tiny", "name: ../tiny").encode(),
        "absolute name": good.replace("name: tiny", "name: /tmp/tiny").encode(),
        "dots as name": good.replace("name: tiny", "name: ..").encode(),
        "escaping variant": good.encode() + b"variants: {../x: {components: [eor]}}\n",
        "empty variants": good.encode() + b"variants: {}\n",
        "bad sweep": good.encode() + b"sweep: {no.such.field: [1, 2]}\n",
        "empty sweep": good.encode() + b"sweep: {sky.eor.seed: []}\n",
        "sweep of a block": good.encode() + b"sweep: {sky.eor.seed.x: [1]}\n",
        "sweep of wrong values": good.encode() + b"sweep: {sky.eor.seed: [1, banana]}\n",
        "sweep with dots": good.encode() + b"sweep: {'..': [1]}\n",
        "same seeds": good.replace("factor: 2", "factor: 2\n    seeds: [3, 3]").encode(),
    }
    for name, text in texts.items():
        yield Broken(name, text, ())
