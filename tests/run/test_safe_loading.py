"""Nothing that is read is run, but code that an experiment names as such; nothing in the store reaches out of it."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from calstudy.base.errors import InputError
from calstudy.experiment.files import parse_yaml
from calstudy.run.store import RECORD, Store

KEY = "0" * 32
SOURCES = sorted((Path(__file__).parents[2] / "calstudy").rglob("*.py"))
FORBIDDEN = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}


def calls(tree: ast.AST) -> list[tuple[str, ast.Call]]:
    return [(ast.unparse(node.func), node) for node in ast.walk(tree) if isinstance(node, ast.Call)]


def keyword(call: ast.Call, name: str) -> str | None:
    return next((ast.unparse(item.value) for item in call.keywords if item.arg == name), None)


def test_there_are_sources_to_look_at():
    assert len(SOURCES) > 100


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_the_source_loads_nothing_unsafe(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            assert not {alias.name.partition(".")[0] for alias in node.names} & FORBIDDEN
        if isinstance(node, ast.ImportFrom):
            assert (node.module or "").partition(".")[0] not in FORBIDDEN
    for name, call in calls(tree):
        assert name not in ("eval", "exec", "os.system", "tarfile.open", "zipfile.ZipFile", "shutil.unpack_archive")
        if name in ("np.load", "numpy.load"):
            assert keyword(call, "allow_pickle") == "False", path
        if name == "np.save" or name.startswith("np.savez"):
            assert keyword(call, "allow_pickle") == "False", path
        if name == "yaml.load":
            # The safe loader, made stricter.
            assert keyword(call, "Loader") == "_Loader", path
        assert name not in ("yaml.unsafe_load", "yaml.full_load", "yaml.load_all"), path
        assert keyword(call, "shell") != "True", path
        if name == "pooch.retrieve":
            assert keyword(call, "known_hash") is not None, path


@pytest.mark.parametrize(
    "tag",
    [
        "!!python/object/apply:os.system ['true']",
        "!!python/object/new:os.system ['true']",
        "!!python/object:calstudy.base.errors.InputError {}",
        "!!python/name:os.system",
        "!!python/module:os",
        "!!python/tuple [1]",
        "!!python/complex 1j",
        "!anything x",
        "!<tag:example.org,2000:x> x",
    ],
)
def test_object_tags_are_refused_by_a_sentence(tag):
    with pytest.raises(InputError, match=r"file: line 1: the tag .* is refused: only texts, numbers"):
        parse_yaml(f"name: {tag}\n", "file")


def test_what_is_written_is_read_back_without_tags():
    assert "!!" not in yaml.safe_dump({"a": [1, 2.5, None, "x"]})


@given(name=st.sampled_from(["..", "../x", "/etc", "a/b", "", ".", "a\0b", ".hidden", "a..b/../c", "\\\\x"]))
def test_no_stage_or_key_leads_out_of_the_store(name):
    store = Store(Path("store"))
    for stage, key in ((name, KEY), ("stage", name)):
        with pytest.raises(ValueError, match="plain names"):
            store.folder(stage, key)


@pytest.mark.parametrize("name", ["../../secret", "/etc/hostname", "a/../../../secret"])
def test_a_record_that_names_files_elsewhere_is_no_product(name, tmp_path):
    store = Store(tmp_path / "store")
    store.prepare()
    secret = tmp_path / "store" / "secret"
    secret.write_text("x")
    with store.lock("stage", KEY), store.building("stage", KEY) as folder:
        (folder / "data.bin").write_bytes(b"x")
        product = store.seal(folder, {"stage": "stage", "key": KEY, "notes": {}})
    assert store.verify("stage", KEY) is not None
    (product.path / "a").mkdir()
    record = json.loads((product.path / RECORD).read_text())
    entry = record["files"]["data.bin"]
    target = product.path / name
    if target.exists():
        entry = {**entry, "bytes": target.stat().st_size}
    record["files"][name] = entry
    (product.path / RECORD).write_text(json.dumps(record))
    assert store.find("stage", KEY) is None
    assert store.verify("stage", KEY) is None
