"""The source of a product: all that runs while it is made, and nothing else changes it."""

import sys
from importlib import import_module
from pathlib import Path

import pytest
from tiny import of_the_paper

from calstudy.base.user_code import load_file
from calstudy.experiment.files import validate
from calstudy.run import execution as performing
from calstudy.run.execution import WorkOrder, perform
from calstudy.run.source import reached, source_of
from calstudy.run.store import Store
from calstudy.studies.kinds.experiment import ExperimentStudy

RUNNER = ("calstudy.run.execution", "calstudy.run.task", "calstudy.base.resources")
CODE = '''
"""A module."""
import numpy as np

from calstudy.base.constants import SPEED_OF_LIGHT

LIMIT = 3


def unused(value):
    return value


def helper(value: int) -> int:
    """Return more."""
    return value + LIMIT  # a comment


def make(job):
    from calstudy.base.files import sha256

    return {"sum": helper(np.sum([1, 2])) * SPEED_OF_LIGHT, "digest": sha256(job.output)}
'''


def source(folder: Path, code: str):
    path = folder / "stage.py"
    path.write_text(code)
    return source_of(load_file(path).make, {})


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("# a comment", "# another one"),
        ('"""Return more."""', '"""Return even more."""'),
        ("value: int) -> int", "value: float) -> float"),
        ("return value\n", "return 2 * value\n"),
        ("LIMIT = 3\n", "\n"),
    ],
    ids=["comment", "docstring", "annotations", "what is not used", "order"],
)
def test_a_source_is_the_same_where_results_are(tmp_path, old, new):
    changed = CODE.replace(old, new)
    if "LIMIT = 3" not in changed:
        changed += "\n\nLIMIT = 3\n"
    assert changed != CODE
    assert source(tmp_path, changed) == source(tmp_path, CODE)


@pytest.mark.parametrize(
    ("old", "new"),
    [("LIMIT = 3", "LIMIT = 4"), ("value + LIMIT", "value - LIMIT"), ("([1, 2])", "([1, 3])")],
    ids=["constant", "function", "stage"],
)
def test_a_source_changes_with_all_that_is_used(tmp_path, old, new):
    assert source(tmp_path, CODE.replace(old, new)).digest != source(tmp_path, CODE).digest


def test_a_source_names_packages_and_their_data_files():
    study = ExperimentStudy(validate({"name": "paper"}, Path()))
    task = next(task for task in study.tasks if task.stage.name == "simulate")
    found = source_of(type(task), task.settings)
    assert {"numpy", "astropy", "pyuvdata", "finufft"} <= found.packages
    assert "tensorflow" not in found.packages
    assert ("mwa_pb", "data/mwa_full_embedded_element_pattern.h5") in found.files


@pytest.mark.slow
def test_all_that_runs_while_products_are_made_is_in_their_source(tmp_path, monkeypatch):
    """Every product of a small study is made under a profiler, once all that it imports is imported."""
    store = Store(tmp_path / "store")
    store.prepare()
    tasks = ExperimentStudy(validate(of_the_paper(tmp_path), tmp_path)).tasks
    sources = {task.key: set(reached(type(task), task.settings)) for task in tasks}
    for module in {module for found in sources.values() for module, _ in found}:
        import_module(module)
    ran: set[tuple[str, str]] = set()

    def note(frame, event, argument):
        module, name = frame.f_globals.get("__name__", ""), frame.f_code.co_qualname.partition(".")[0]
        # Methods that dataclasses write have no source of their own.
        if event == "call" and module.startswith("calstudy.") and not name.startswith(("<", "__create_fn__")):
            ran.add((module, name))

    class Profiled(performing.Usage):
        def __enter__(self):
            sys.setprofile(note)
            return super().__enter__()

        def __exit__(self, *error):
            sys.setprofile(None)
            return super().__exit__(*error)

    monkeypatch.setattr(performing, "Usage", Profiled)
    missed = []
    for task in tasks:
        ran.clear()
        perform(WorkOrder.of(task, store))
        # What measures and calls it is none of it.
        lost = {found for found in ran - sources[task.key] if found[0] not in RUNNER}
        missed += [f"{task.stage.name}: {module}.{name}" for module, name in sorted(lost)]
    assert sorted(set(missed)) == []
