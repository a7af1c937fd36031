"""Blind challenges: a recipe with secret seeds, and the commitment to it that is published first."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from calstudy.base.errors import InputError
from calstudy.base.files import sha256
from calstudy.experiment.model import Experiment
from calstudy.studies.kinds.comparison import Comparison

SEEDS = ("seed", "seeds", "seeds_without_eor")
DRAWN = ("sky.foregrounds", "sky.eor", "sky.diffuse", "corruption.noise")
"""Blocks that always get new seeds; of others, those that differ from their defaults."""
BITS = 128


def write_recipe(worlds: Comparison, path: Path) -> str:
    """Write a comparison with secret seeds and a secret salt, for its owner alone; return the SHA-256 of the file.

    Data with the EoR and without have separate noise. Only the seeds of the comparison are replaced; `export` and
    `score` accept the new YAML file in its place.

    Raises
    ------
    InputError
        If the file exists already, or cannot be written.
    """
    experiments = {case.world: case.experiment for case in worlds.cases}
    drawn = {
        world: {**worlds.resolved["worlds"].get(world, {}), **_drawn(experiment)}
        for world, experiment in experiments.items()
    }
    recipe = {**worlds.resolved, "worlds": drawn, "salt": secrets.token_hex(BITS // 8)}
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
            yaml.safe_dump(recipe, file, sort_keys=False, allow_unicode=True, width=100)
    except FileExistsError:
        raise InputError(
            f"--blind {path}: is there already; export it as it is with 'calstudy export {path}', or use another name"
        ) from None
    except OSError as error:
        raise InputError(f"--blind {path}: cannot be written ({error.strerror})") from None
    return sha256(path)


def _drawn(experiment: Experiment) -> dict[str, Any]:
    """Return new seeds of all random draws of an experiment, by dotted path."""
    full = experiment.model_dump(mode="json", include={"instrument", "sky", "corruption"})
    other = experiment.model_dump(mode="json", include=set(full), exclude_defaults=True)
    changed = {block for block, _ in _walk(other, "")}
    found: dict[str, Any] = {}
    for block, content in _walk(full, ""):
        if block in DRAWN or block in changed:
            for name in SEEDS:
                if name in content:
                    two = [secrets.randbits(BITS) for _ in range(2)]
                    found[f"{block}.{name}"] = two[0] if name == "seed" else two
    return found


def _walk(value: Any, path: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield all blocks in nested settings, with their dotted paths."""
    if isinstance(value, Mapping):
        yield path, value
    pairs = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
    for key, item in pairs:
        yield from _walk(item, f"{path}.{key}" if path else str(key))
