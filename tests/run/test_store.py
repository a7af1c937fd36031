"""The store: products are whole or absent, damage is seen, and nobody makes a product twice."""

import json
import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calstudy.base.errors import InputError
from calstudy.base.files import digest_json
from calstudy.run.store import Store

KEY = "0" * 32


def make_product(store: Store, content: bytes = b"visibilities", key: str = KEY) -> None:
    store.prepare()
    with store.lock("stage", key), store.building("stage", key) as folder:
        (folder / "data.bin").write_bytes(content)
        store.seal(folder, {"stage": "stage", "key": key, "notes": {}})


def change_record(path: Path, **fields: object) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))


@pytest.fixture
def store(tmp_path) -> Store:
    found = Store(tmp_path / "store")
    found.prepare()
    return found


def test_a_sealed_product_is_found_and_verified(store):
    make_product(store)
    product = store.verify("stage", KEY)
    assert product is not None
    assert (product.path / "data.bin").read_bytes() == b"visibilities"
    assert product.size == len(b"visibilities")


def test_a_link_that_leads_nowhere_is_replaced_by_the_product(store, tmp_path):
    """Products may be kept on a disk that is emptied."""
    make_product(store)
    store.folder("stage", KEY).rename(tmp_path / "elsewhere")
    store.folder("stage", KEY).symlink_to(tmp_path / "elsewhere")
    assert store.verify("stage", KEY) is not None
    (tmp_path / "elsewhere").rename(tmp_path / "gone")
    make_product(store)
    assert store.verify("stage", KEY) is not None
    assert not store.folder("stage", KEY).is_symlink()


def test_a_product_does_not_exist_before_it_is_sealed(store):
    with store.lock("stage", KEY), store.building("stage", KEY) as folder:
        (folder / "data.bin").write_bytes(b"half")
        assert not store.exists("stage", KEY)
    assert store.find("stage", KEY) is None
    assert list((store.root / "stage").iterdir()) == []


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(b"visibilitiez"),
        lambda path: path.write_bytes(b"vis"),
        lambda path: path.unlink(),
        lambda path: (path.parent / "product.json").write_text("{"),
        lambda path: (path.parent / "product.json").unlink(),
        lambda path: (path.parent / "product.json").write_text("[]"),
        lambda path: change_record(path.parent / "product.json", notes={"status": "converged"}),
        lambda path: change_record(path.parent / "product.json", digest="0" * 32),
    ],
    ids=["bit flip", "truncated", "missing", "broken record", "no record", "strange record", "notes", "digest"],
)
def test_a_damaged_product_is_not_verified_and_is_replaced(store, damage):
    make_product(store)
    damage(store.folder("stage", KEY) / "data.bin")
    assert store.verify("stage", KEY) is None
    assert store.exists("stage", KEY)
    make_product(store)
    assert store.verify("stage", KEY) is not None


def _die_while_building(root: Path) -> None:
    store = Store(root)
    with store.lock("stage", KEY), store.building("stage", KEY) as folder:
        (folder / "data.bin").write_bytes(b"half")
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_run_leaves_no_product_and_no_lock(store):
    process = multiprocessing.get_context("spawn").Process(target=_die_while_building, args=(store.root,))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert store.find("stage", KEY) is None
    make_product(store)
    assert [path.name for path in (store.root / "stage").iterdir()] == [KEY]


def _make_slowly(root: Path, log: Path) -> None:
    store = Store(root)
    with store.lock("stage", KEY):
        if store.verify("stage", KEY) is None:
            with log.open("a") as file:
                file.write("made\n")
            time.sleep(0.3)
            with store.building("stage", KEY) as folder:
                (folder / "data.bin").write_bytes(b"visibilities")
                store.seal(folder, {"stage": "stage", "key": KEY, "notes": {}})


def test_of_several_runs_one_makes_the_product_and_the_others_wait_for_it(store, tmp_path):
    context, log = multiprocessing.get_context("spawn"), tmp_path / "log"
    processes = [context.Process(target=_make_slowly, args=(store.root, log)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0, 0]
    assert log.read_text() == "made\n"


def test_a_store_that_cannot_be_made_is_told_in_a_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"outputs\.store = .*cannot be written"):
        Store(tmp_path / "file" / "store").prepare()


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


@given(st.dictionaries(st.text(), values, min_size=2))
def test_keys_do_not_depend_on_order(settings):
    assert digest_json(settings) == digest_json(dict(reversed(settings.items())))
