"""Export: the data and assumptions of an experiment for other programs, without the truth, and blind challenges."""

from __future__ import annotations

import os
import re
import secrets
import shutil
from collections.abc import Mapping
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

import yaml
from rich.console import Console

from calstudy import __version__
from calstudy.base.errors import InputError
from calstudy.base.files import sha256, write_text
from calstudy.base.gain_files import CASACORE
from calstudy.base.paths import leaves
from calstudy.base.visibilities import flag_cube, from_cube, to_cube
from calstudy.calibrate.calibrators.given_gains import (
    GAINS_SUFFIXES,
    MANIFEST,
    MODEL_SUFFIXES,
    DataSet,
    Manifest,
    read_manifest,
    salted,
)
from calstudy.calibrate.records import PARALLEL_HANDS
from calstudy.experiment.assumed import assumed_world
from calstudy.experiment.model import Experiment
from calstudy.products.corruption import read_noise
from calstudy.products.files import DATA, VISIBILITIES, read_visibilities, write_visibilities
from calstudy.run.execution import Budget, Workers
from calstudy.run.store import Product, Store, require_writable
from calstudy.studies.capacity import fit
from calstudy.studies.folder import folder_of_runs, log_to
from calstudy.studies.kinds.comparison import Comparison, WorldData, load_worlds
from calstudy.studies.preflight import require_possible
from calstudy.studies.study import make

if TYPE_CHECKING:
    from pyuvdata import UVData


FORMATS = ("uvh5", "uvfits", "ms")
README, LOG = "README.md", "export.log"
SKY_MODEL = "sky-model"
OWN = re.compile(rf"(data-\d+|{SKY_MODEL})\.({'|'.join(FORMATS)})")
"""Names of data and sky models that an export writes."""
RETURNED = (*GAINS_SUFFIXES, *MODEL_SUFFIXES)
CARRIER = {"none": "none"}
"""Calibrator of exported worlds, on which data and assumptions do not depend."""
TEXT = Path(__file__).with_suffix(".md")
"""Template of the README of exported data."""


def export(
    worlds: Comparison, folder: Path, file_format: str, overwrite: bool, budget: Budget, console: Console
) -> list[Path]:
    """Write the data of every world, make products that are missing in the store, and return the folders.

    The worlds are from `load_worlds`, with the calibrator `CARRIER`. Raises InputError as `folders_of` does, or if the
    data cannot be made.
    """
    folders = folders_of(worlds, folder, file_format, overwrite)
    require_worlds(worlds)
    fits = [fit(case.experiment, budget, lambda wanted: WorldData.of(wanted).tasks) for case in worlds.cases]
    contents = [WorldData.of(experiment, worlds.file.salt) for experiment, _ in fits]
    runs = folder_of_runs(worlds.outputs)
    with log_to(runs / LOG):
        workers = Workers(min(count for _, count in fits), runs / LOG, budget.scheduler)
        targets = [task for content in contents for task in content.tasks]
        products = make(targets, Store(worlds.outputs.store), workers, console).products
        for content, place in zip(contents, folders, strict=True):
            place.mkdir(parents=True, exist_ok=True)
            _write_world(content, products, place, file_format)
    return folders


def require_worlds(worlds: Comparison) -> None:
    """Raise InputError unless the data of all worlds can be made, as a run of them requires."""
    for case in worlds.cases:
        require_possible(case.experiment)


def folders_of(worlds: Comparison, folder: Path, file_format: str, overwrite: bool) -> list[Path]:
    """Return the folder of each world, ``world-1`` and so on of several.

    Raises InputError if there is no such format, files would be replaced without `overwrite`, or cannot be written, or
    gains would be taken for those of other data.
    """
    if file_format not in FORMATS:
        raise InputError(f"--format {file_format}: not a format of visibilities (allowed: {', '.join(FORMATS)})")
    if file_format == "ms" and find_spec("casacore") is None:
        raise InputError(f"--format ms: takes {CASACORE}")
    several = len(worlds.cases) > 1
    if several and (folder / MANIFEST).exists():
        raise InputError(
            f"--output {folder}: has the {MANIFEST} of a single world, and those of {len(worlds.cases)} worlds would "
            "not be found below it; use another folder"
        )
    folders = [folder / f"world-{place + 1}" if several else folder for place in range(len(worlds.cases))]
    for case, place in zip(worlds.cases, folders, strict=True):
        require_writable(place, f"--output {place}")
        if not overwrite and place.is_dir() and any(place.iterdir()):
            raise InputError(f"--output {place}: holds files already; use --overwrite or another folder")
        found = [path.name for suffix in RETURNED for path in sorted(place.glob(f"data-*{suffix}"))]
        if found and _earlier(place).digest != WorldData.of(case.experiment, worlds.file.salt).digest:
            raise InputError(
                f"--output {place}: holds what was returned for other data, {', '.join(found)}; move these files away, "
                "or use another folder"
            )
    return folders


def _earlier(folder: Path) -> Manifest:
    """Return the manifest of an earlier export; an empty one if there is none that can be read."""
    with suppress(InputError):
        return read_manifest(folder / MANIFEST)
    return Manifest(calstudy="", digest="", data=())


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)


def _write_world(content: WorldData, products: Mapping[str, Product], folder: Path, file_format: str) -> None:
    from calstudy.instrument.telescope import make_template

    # Their names end otherwise in other formats.
    earlier = _earlier(folder)
    for name in (*(item.file for item in earlier.data), earlier.sky_model):
        if name is not None and OWN.fullmatch(name):
            _remove(folder / name)
    template = make_template(assumed_world(content.experiment).instrument, as_built=True)
    # A layout may be named after a file.
    template.telescope.name = template.telescope.instrument = "calstudy"
    template.history = "calstudy export"
    sets = []
    for number, task in enumerate(content.data, start=1):
        file = f"data-{number}.{file_format}"
        _write(_at(template, read_visibilities(products[task.key].path / DATA)), folder / file, single=True)
        sets.append(DataSet(name=f"data-{number}", file=file, digest=salted(task.key, content.salt)))
    model, model_file = content.sky_model, f"{SKY_MODEL}.{file_format}"
    if model is not None:
        sky = read_visibilities(products[model.key].path / VISIBILITIES)
        _write(_at(template, sky), folder / model_file, single=False)
    level = content.noise_level
    manifest = Manifest(
        calstudy=__version__,
        digest=content.digest,
        data=tuple(sets),
        sky_model=None if model is None else model_file,
        sky_model_digest=None if model is None else salted(model.key, content.salt),
        noise=None if level is None else read_noise(products[level.key].path),
    )
    write_text(folder / README, _readme(manifest, template, file_format))
    write_text(folder / MANIFEST, manifest.model_dump_json(indent=1) + "\n")


def _at(template: UVData, uvd: UVData) -> UVData:
    """Return visibilities and flags with the metadata of the template only."""
    found = from_cube(template, to_cube(uvd))
    flag_cube(found)[:] = flag_cube(uvd)
    return found


def _write(uvd: UVData, path: Path, single: bool) -> None:
    """Write visibilities in the format of the path's suffix; `single` stores complex64, as uvfits and ms always do."""
    _remove(path)
    if path.suffix == ".uvh5":
        write_visibilities(uvd, path, single)
        return
    uvd.phase_to_time(uvd.time_array[0])
    if path.suffix == ".uvfits":
        uvd.write_uvfits(path)
    else:
        uvd.write_ms(str(path))


def _readme(manifest: Manifest, template: UVData, file_format: str) -> str:
    names = [item.name for item in manifest.data]
    conjugates = (
        f" Visibilities are as pyuvdata reads them: {file_format} files hold their complex conjugates, so that "
        "gains found from the columns of the files must be conjugated in CalH5 or calfits files, but not in those of "
        "DP3, hyperdrive and calibrate."
    )
    rows = [f"| `{item.file}` | data to be calibrated, with flags |" for item in manifest.data]
    phased = f"Data are phased to the zenith of the first integration, as {file_format} wants them."
    if manifest.sky_model is not None:
        rows.append(f"| `{manifest.sky_model}` | visibilities of the foregrounds as far as they are known |")
    return Template(TEXT.read_text(encoding="utf-8")).substitute(
        version=manifest.calstudy,
        antennas=template.Nants_data,
        channels=template.Nfreqs,
        first=f"{template.freq_array.min() / 1e6:.3f}",
        last=f"{template.freq_array.max() / 1e6:.3f}",
        times=template.Ntimes,
        integration=f"{template.integration_time[0]:g}",
        plural="s" if template.Npols > 1 else "",
        polarizations=", ".join(PARALLEL_HANDS[int(number)] for number in template.polarization_array),
        rows="\n".join(rows),
        manifest=MANIFEST,
        returned=", ".join(f"`{name}.calh5`" for name in names),
        models=f"`{names[0]}.model.uvh5`",
        default="the gains cannot be scored, for nothing is assumed of the sky"
        if manifest.sky_model is None
        else f"`{manifest.sky_model}` is subtracted from the calibrated data",
        conjugates="" if file_format == "uvh5" else conjugates,
        phase="The telescope drifts: data are not phased." if file_format == "uvh5" else phased,
        noise="The data have no noise."
        if manifest.noise is None
        else f"The standard deviation of the complex noise of a measurement is {manifest.noise:.6g} Jy; where gains "
        "make samples differ, its inverse square is the mean of their inverse variances.",
    )


SEEDS = ("seed", "seeds", "seeds_without_eor")
DRAWN = ("sky.foregrounds", "sky.eor", "sky.diffuse", "corruption.noise")
EFFECTS, AS_BUILT = "corruption.effects", "instrument.as_built"
"""Blocks that always get new seeds, and so does all below effects and, if antennas differ, below the array as built.

Of others, those get new seeds that differ from their defaults.
"""
BITS = 128


def write_recipe(worlds: Comparison, path: Path) -> str:
    """Write a comparison with secret seeds and a secret salt, for its owner alone; return the SHA-256 of the file.

    Only the seeds of the comparison are replaced; `export` and `score` accept the new YAML file in its place. Raises
    InputError if the file exists already, cannot be written, or cannot be read back.
    """
    changes = {}
    for world, experiment in {case.world: case.experiment for case in worlds.cases}.items():
        drawn = _drawn(experiment)
        # They come last: a seed that is set otherwise would come back.
        given = worlds.resolved["worlds"].get(world, {})
        changes[world] = {**{path: value for path, value in given.items() if path not in drawn}, **drawn}
    recipe = {**worlds.resolved, "worlds": changes, "salt": secrets.token_hex(BITS // 8)}
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
            yaml.safe_dump(recipe, file, sort_keys=False, allow_unicode=True, width=100)
    except FileExistsError:
        raise InputError(
            f"--blind {path}: is there already; export it as it is with 'calstudy export {path}', or use another name"
        ) from None
    except OSError as error:
        raise InputError(f"--blind {path}: cannot be written ({error.strerror})") from None
    try:
        load_worlds(path, None, (), None)
    except InputError as error:
        path.unlink()
        raise InputError(f"--blind {path}: the recipe of this file cannot be read back ({error})") from None
    return sha256(path)


def _drawn(experiment: Experiment) -> dict[str, Any]:
    """Return new seeds of all random draws of an experiment, by dotted path."""
    full = experiment.model_dump(mode="json", include={"instrument", "sky", "corruption"})
    other = experiment.model_dump(mode="json", include=set(full), exclude_defaults=True)
    changed = [f"{path}." for path, _ in leaves(other)]
    # Effects may all be the default, whose seed is public.
    above = (f"{EFFECTS}.", f"{AS_BUILT}.") if experiment.instrument.as_built.note else (f"{EFFECTS}.",)
    found: dict[str, Any] = {}
    for path, _ in leaves(full):
        block, _, name = path.rpartition(".")
        differs = block in DRAWN or path.startswith(above) or any(one.startswith(f"{block}.") for one in changed)
        if name in SEEDS and differs:
            found[path] = secrets.randbits(BITS) if name == "seed" else [secrets.randbits(BITS) for _ in range(2)]
    return found
