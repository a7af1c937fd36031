"""An array of jobs on one store: members are killed and started again, and end as if they had run alone."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tiny import tiny

from calstudy.results.reader import find_runs
from calstudy.run.store import Store, leftovers, products

MEMBERS, TOGETHER = 20, 4
UNDISTURBED = (0, MEMBERS - 1)
KILLED = 0.5
"""Part of the jobs that are killed."""


def experiment(folder: Path) -> dict[str, Any]:
    """Return an experiment that takes half a minute: with one figure, and all that scores need."""
    content = tiny(folder)
    return {**content, "outputs": {**content["outputs"], "figures": ["spherical"]}}


def start(member: int, folder: Path, log: Path) -> subprocess.Popen:
    seeds = f"corruption.noise.seeds=[{1000 + member}, {2000 + member}]"
    command = [sys.executable, "-m", "calstudy", "run", "tiny.yaml", "--workers", "1"]
    changes = ["--set", seeds, "--set", f"name=member-{member}"]
    with log.open("a") as told:
        # A session of its own: the kill reaches its processes as well.
        return subprocess.Popen(
            [*command, *changes], cwd=folder, stdout=told, stderr=subprocess.STDOUT, start_new_session=True
        )


def arrays_of(folder: Path) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    return {run.name: run.arrays() for run in find_runs(folder / "runs")}


def run_to_its_end(member: int, folder: Path, chance: random.Random, longest: float) -> int:
    """Start a member again until nobody kills it, which happens within some seconds; return how often it was killed."""
    log = folder / f"{member}.log"
    for kills in range(MEMBERS):
        job = start(member, folder, log)
        try:
            job.wait(chance.uniform(0, longest) if chance.random() < KILLED else None)
        except subprocess.TimeoutExpired:
            os.killpg(job.pid, signal.SIGKILL)
            job.wait()
            continue
        assert job.returncode == 0, log.read_text()
        return kills
    raise AssertionError(f"member {member} was killed {MEMBERS} times")


@pytest.mark.slow
def test_killed_members_of_an_array_end_with_the_products_of_undisturbed_runs(tmp_path):
    folders = {name: tmp_path / name for name in ("array", "alone")}
    for folder in folders.values():
        folder.mkdir()
        (folder / "tiny.yaml").write_text(yaml.safe_dump(experiment(folder)))
    began = time.monotonic()
    for member in UNDISTURBED:
        assert start(member, folders["alone"], tmp_path / "alone.log").wait() == 0
    # Among others a member takes longer than alone, but has less to make: kills come at any stage.
    longest = (time.monotonic() - began) / len(UNDISTURBED)
    with ThreadPoolExecutor(TOGETHER) as pool:
        jobs = [pool.submit(run_to_its_end, n, folders["array"], random.Random(n), longest) for n in range(MEMBERS)]
        kills = sum(job.result() for job in jobs)
    assert kills > MEMBERS / 4
    store = Store(folders["array"] / "store")
    assert [product.record["label"] for product in products(store) if product.record["temporary"]] == []
    assert [item.path.name for item in leftovers(store) if item.path.name.startswith(".building")] == []
    assert list((store.root / ".runs").iterdir()) == []
    array, alone = (arrays_of(folder) for folder in folders.values())
    assert len(array) == MEMBERS
    for name, figures in alone.items():
        for figure, expected in figures.items():
            for key, values in expected.items():
                np.testing.assert_array_equal(array[name][figure][key], values, err_msg=f"{name} {figure} {key}")
