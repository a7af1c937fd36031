"""Products of other code or other versions: they are announced, and made again if that is wanted."""

from pathlib import Path

import pytest
from rich.console import Console

from calstudy.run import provenance
from calstudy.run.execution import Workers, execute, schedule
from calstudy.run.source import Source
from calstudy.run.store import RECORD, Store, products
from calstudy.run.task import Input, Task
from calstudy.studies.study import make


class First(Task, stage="first"):
    name: str

    def make(self, output: Path) -> dict:
        (output / "number").write_text("1")
        return {}


class Last(Task, stage="last"):
    data: Input

    def make(self, output: Path) -> dict:
        (output / "number").write_text(self.data.name)
        return {}


DATA, OTHER = (First(name, name=name) for name in ("data", "other"))
RESULT = Last("result", data=DATA)
TARGETS = [RESULT, OTHER]


@pytest.fixture
def store(tmp_path) -> Store:
    return Store(tmp_path / "store")


def run(store: Store, capsys, strict: bool = False) -> tuple[set[str], str]:
    """Return what a run makes, and what it tells."""
    made = make(TARGETS, store, Workers(1, store.root.parent / "run.log"), Console(soft_wrap=True), strict)
    return {task.label for task in made.tasks}, capsys.readouterr().out


def other_source(monkeypatch, changed: object, digest: str = "other") -> None:
    """Let a stage have other source."""
    source_of = provenance.source_of

    def found(made: object, settings: object) -> Source:
        return Source(digest, frozenset({"numpy"}), frozenset()) if made is changed else source_of(made, settings)

    monkeypatch.setattr(provenance, "source_of", found)


def test_products_of_the_same_code_are_used_without_a_word(store, capsys):
    assert run(store, capsys)[0] == {"data", "result", "other"}
    made, told = run(store, capsys, strict=True)
    assert (made, "--strict" in told) == (set(), False)


def test_products_of_other_code_are_used_and_announced_with_what_was_made_from_them(store, capsys, monkeypatch):
    run(store, capsys)
    other_source(monkeypatch, First)
    made, told = run(store, capsys)
    assert made == set()
    assert "3 products in the store are of other code" in told
    assert "(first 2, last 1); 'calstudy run --strict' makes them again" in told


def test_a_strict_run_makes_them_again_and_nothing_else(store, capsys, monkeypatch):
    run(store, capsys)
    other_source(monkeypatch, Last)
    made, told = run(store, capsys, strict=True)
    assert (made, "of other code" in told) == ({"result"}, False)
    other_source(monkeypatch, First)
    assert run(store, capsys, strict=True)[0] == {"data", "result", "other"}
    assert run(store, capsys, strict=True)[0] == set()


def test_what_another_strict_run_has_made_meanwhile_is_not_made_twice(store, capsys, monkeypatch):
    """Others may be reading it. Both runs have planned before either has made anything."""
    run(store, capsys)
    other_source(monkeypatch, First)
    planned = schedule(TARGETS, store, strict=True)
    run(store, capsys, strict=True)
    records = {product.path: (product.path / RECORD).stat().st_mtime_ns for product in products(store)}
    made = execute(planned.todo, store, Workers(1, store.root.parent / "run.log"), again=planned.again)
    assert {product.path for product in made.values()} <= set(records)
    assert {path: (path / RECORD).stat().st_mtime_ns for path in records} == records


def test_a_strict_run_makes_a_store_that_is_not_there(store, capsys):
    assert not store.root.exists()
    assert run(store, capsys, strict=True)[0] == {"data", "result", "other"}


def test_what_a_dropped_product_was_made_with_is_not_forgotten(store, capsys, monkeypatch):
    run(store, capsys)
    store.discard("first", DATA.key)
    other_source(monkeypatch, First)
    assert "(last 1, first 1)" in run(store, capsys)[1]


def test_another_version_of_a_package_that_a_stage_uses_is_other_code(store, capsys, monkeypatch):
    other_source(monkeypatch, First)
    run(store, capsys)
    version = provenance._version
    monkeypatch.setattr(provenance, "_version", lambda name: "0.1" if name == "numpy" else version(name))
    assert "3 products" in run(store, capsys)[1]
    monkeypatch.setattr(provenance, "_version", lambda name: "0.1" if name == "scipy" else version(name))
    assert "3 products" not in run(store, capsys)[1]


def test_a_record_says_with_what_a_product_was_made(store, capsys, monkeypatch):
    other_source(monkeypatch, First, "digest")
    run(store, capsys)
    record = store.verify("first", DATA.key).record
    assert record["made_with"] == {"source": "digest", "versions": {"numpy": provenance._version("numpy")}, "files": {}}
    assert record["git_commit"] == provenance.git_commit()
    assert record["processor"] == provenance.processor()
    assert any("blas" in library for library in record["libraries"])


def test_a_checkout_is_not_needed(monkeypatch):
    provenance.git_commit.cache_clear()
    monkeypatch.setenv("PATH", str(Path("nowhere")))
    assert provenance.git_commit() is None
    provenance.git_commit.cache_clear()
