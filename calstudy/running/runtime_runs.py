"""Run a run-time study: time the solvers on this machine, one array after the other, and draw what was found."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

from calstudy.errors import InputError
from calstudy.experiment.runtime import RuntimeStudy
from calstudy.graph.estimates import estimate
from calstudy.graph.runtimes import RuntimeGraph
from calstudy.report.page import write_report
from calstudy.resources import free_memory
from calstudy.running.capacity import parse_memory
from calstudy.running.execution import Crew
from calstudy.running.provenance import git_commit, machine, package_versions
from calstudy.running.runs import MANIFEST, Run, log_to, make, open_folder, product_entries, publish, write
from calstudy.running.store import Store, digest_json

TIMED_WITH = ("tensorflow", "numpy", "scipy")
"""Packages whose version may change a run time."""


def runtime_folder(study: RuntimeStudy) -> Path:
    """Return the folder of this study's runs: its name and a digest of what it says and of the machine."""
    content = {**study.model_dump(mode="json", exclude={"outputs", "scales"}), "machine": timed_machine(study)}
    return study.outputs.runs.expanduser().resolve() / f"{study.name}-{digest_json(content)[:8]}"


def timed_machine(study: RuntimeStudy) -> dict[str, Any]:
    """Return what run times depend on besides the study itself: processor, memory, system, packages, GPU.

    Raises
    ------
    InputError
        If the study wants a GPU and there is none.
    """
    versions = package_versions()
    found = {**machine(), **{name: versions[name] for name in TIMED_WITH}}
    return {**found, "gpu": _gpu()} if "gpu" in study.runtime.devices else found


def _gpu() -> str:
    from calstudy.quiet import load_tensorflow

    load_tensorflow()
    import tensorflow as tf

    devices = tf.config.list_physical_devices("GPU")
    if not devices:
        raise InputError("runtime.devices = [..., gpu]: TensorFlow finds no GPU on this machine; use [cpu]")
    return str(tf.config.experimental.get_device_details(devices[0]).get("device_name", "unnamed GPU"))


def fit_runtime(study: RuntimeStudy, workers: int | None, max_memory: str | None, scheduler: str | None) -> None:
    """Refuse what would spoil the measurements or does not fit into the memory; raises InputError."""
    if scheduler is not None or workers not in (None, 1):
        raise InputError(
            "--workers and --scheduler: run times are measured on this machine, one after the other; leave both out"
        )
    budget = free_memory() if max_memory is None else parse_memory(max_memory)
    tasks = RuntimeGraph(study, {}).timings.values()
    largest = max(tasks, key=lambda task: estimate(task).memory)
    if estimate(largest).memory > budget:
        raise InputError(
            f"run times of {largest.label}: the paper's solver needs about {estimate(largest).memory / 1e9:.1f} GB, "
            f"and there are {budget / 1e9:.1f} GB; name smaller arrays, or fewer channels"
        )


def run_runtime(study: RuntimeStudy, console: Console | None = None) -> Run:
    """Time what the study asks for, as far as it is not in the store for this machine; draw figures, check claims.

    Parameters
    ----------
    study
        Validated.
    console
        Where progress is written; nowhere if None.

    Raises
    ------
    InputError
        If the store or the run folder cannot be written, there is no such device, or a measurement fails.
    """
    graph, store, folder = RuntimeGraph(study, timed_machine(study)), Store(study.outputs.store), runtime_folder(study)
    store.prepare()
    open_folder(folder)
    with log_to(folder / "run.log"):
        products, made = make(graph.targets, store, Crew(1, folder / "run.log", None), console or Console(quiet=True))
        publish([products[task.key] for task in graph.figures], folder / "figures")
        publish([products[task.key] for task in graph.tables], folder / "tables")
        publish([products[graph.claims.key]], folder)
        text = yaml.safe_dump(study.model_dump(mode="json"), sort_keys=False, allow_unicode=True, width=100)
        write(folder / "experiment.yaml", text)
        manifest = {
            "name": study.name,
            "description": study.description,
            "kind": "runtime",
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "stand_ins": list(graph.footnotes),
            "git_commit": git_commit(),
            "versions": package_versions(),
            "machine": graph.machine,
            "products": product_entries(graph.tasks, products, {task.key for task in made}),
        }
        write(folder / MANIFEST, json.dumps(manifest, indent=1))
        write_report(folder)
    return Run(folder, products, made, tuple(graph.tasks))
