"""``calstudy runs`` and ``store``: contents of the folders of runs and products; nothing is deleted unasked."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from calstudy.base.errors import InputError

if TYPE_CHECKING:
    from calstudy.run.store import Leftover, Product, Store

RunsFolder = Annotated[Path, typer.Argument(help="Folder of run folders.")]
StoreFolder = Annotated[Path, typer.Argument(help="Folder of products.")]
OlderThan = Annotated[str | None, typer.Option(metavar="AGE", help="Only products made longer ago: 30d or 12h.")]
LargerThan = Annotated[str | None, typer.Option(metavar="SIZE", help="Only products of this size or more: '100 MB'.")]
Unreferenced = Annotated[
    bool, typer.Option("--unreferenced", help="Only products that no run in the folder --runs refers to.")
]
Runs = Annotated[Path, typer.Option(help="Folder of runs, for --unreferenced.")]
Verify = Annotated[
    bool, typer.Option("--verify", help="Read all products, and list those that are damaged; exit status 1 if any is.")
]
Delete = Annotated[bool, typer.Option("--delete", help="List the products that are chosen, and delete them.")]
EXIT_DAMAGED = 1
SECONDS = {"h": 3600.0, "d": 86_400.0}


def runs(folder: RunsFolder = Path("runs")) -> None:
    """List finished runs: time, size, and number of products."""
    from calstudy.base.table import Table
    from calstudy.results.reader import find_runs

    rows = [
        (
            run.path.relative_to(folder).as_posix(),
            run.finished.strftime("%Y-%m-%d %H:%M"),
            _size(run.size),
            f"{len(run.keys)}",
        )
        for run in find_runs(folder)
    ]
    Table(("folder", "finished (UTC)", "size", "products"), rows, f"runs in {folder}").show(Console(highlight=False))


def store(
    folder: StoreFolder = Path("store"),
    older_than: OlderThan = None,
    larger_than: LargerThan = None,
    unreferenced: Unreferenced = False,
    runs: Runs = Path("runs"),
    verify: Verify = False,
    delete: Delete = False,
) -> None:
    """Show what is in a store by stage, or delete chosen products, but those that a run needs at this time.

    A deleted product is made again by the next run that needs it. Folders left by killed runs are listed too, and
    deleted with --older-than. Without --delete nothing is changed; with it, at least one of --older-than,
    --larger-than, --unreferenced and --verify must choose the products.
    """
    from calstudy.results.reader import keys_of_runs
    from calstudy.run.store import Store, age_of, leftovers, products
    from calstudy.run.store import unreferenced as without_run

    if not folder.is_dir():
        raise InputError(f"{folder}: no such store")
    if verify:
        if older_than is not None or larger_than is not None or unreferenced:
            raise InputError("--verify: reads the whole store; leave out the options that choose products")
        _verify(Store(folder), delete)
        return
    oldest, smallest = _age(older_than), _bytes(larger_than)
    if delete and older_than is None and larger_than is None and not unreferenced:
        raise InputError("--delete: say which products by --older-than, --larger-than, --unreferenced or --verify")
    where, chosen = Store(folder), list(products(Store(folder)))
    if unreferenced:
        chosen = without_run(chosen, keys_of_runs(runs))
    chosen = [product for product in chosen if age_of(product) >= oldest and product.size >= smallest]
    console = Console(highlight=False)
    _show(chosen, folder, console)
    left = [item for item in leftovers(where) if item.age >= oldest and item.size >= smallest]
    for item in left:
        age = f"{item.age / SECONDS['d']:.1f} d"
        console.print(f"leftover of a run: {item.path}, {_size(item.size)}, {age}", markup=False)
    if not delete:
        return
    _delete(chosen, left if older_than is not None else [], where, console)


def _delete(chosen: list[Product], left: list[Leftover], store: Store, console: Console) -> None:
    from calstudy.run.store import LEASE_LOCK, needed_by_runs

    with store.lock(*LEASE_LOCK):
        needed = needed_by_runs(store)
        for item in left:
            if item.key not in needed:
                shutil.rmtree(item.path, ignore_errors=True)
            done = "kept, for a run may be filling it" if item.key in needed else "deleted"
            console.print(f"{done}: {item.path}", markup=False)
        for product in chosen:
            stage, key = str(product.record["stage"]), str(product.record["key"])
            if key not in needed:
                with store.lock(stage, key):
                    store.remove(stage, key)
            done = "kept, for a run needs it" if key in needed else "deleted"
            console.print(f"{done}: {stage} ({product.record['label']}), {_size(product.size)}, {key}", markup=False)


def _verify(store: Store, delete: bool) -> None:
    """Compare all products with their records; name damaged ones, and delete them on request."""
    console, addresses = Console(highlight=False, soft_wrap=True), store.addresses()
    damaged = [address for address in addresses if _is_damaged(store, *address)]
    for stage, key in damaged:
        done = _discarded(store, stage, key) if delete else "damaged"
        console.print(f"{done}: {stage} {key}", markup=False)
    console.print(f"{len(addresses)} products in {store.root}: {len(damaged)} damaged", markup=False)
    if damaged:
        raise typer.Exit(EXIT_DAMAGED)


def _is_damaged(store: Store, stage: str, key: str) -> bool:
    """Return whether a product differs from its record, and was not removed by a run in the meantime."""
    return store.verify(stage, key) is None and store.exists(stage, key)


def _discarded(store: Store, stage: str, key: str) -> str:
    """Remove a product if it is still damaged and no run needs it; say in words what was done."""
    from calstudy.run.store import LEASE_LOCK, needed_by_runs

    with store.lock(*LEASE_LOCK):
        if key in needed_by_runs(store):
            return "kept, for a run needs it"
        with store.lock(stage, key):
            if not _is_damaged(store, stage, key):
                return "no longer damaged"
            store.discard(stage, key)
    return "deleted"


def _show(chosen: list[Product], folder: Path, console: Console) -> None:
    from calstudy.base.table import Table
    from calstudy.run.store import age_of

    rows = []
    for stage in sorted({str(product.record["stage"]) for product in chosen}):
        found = [product for product in chosen if product.record["stage"] == stage]
        ages = [age_of(product) / SECONDS["d"] for product in found]
        size = _size(sum(product.size for product in found))
        rows.append((stage, f"{len(found)}", size, f"{min(ages):.1f} d", f"{max(ages):.1f} d"))
    total = _size(sum(product.size for product in chosen))
    title = f"{len(chosen)} products in {folder}, {total}"
    Table(("stage", "products", "size", "youngest", "oldest"), rows, title).show(console)


def _size(count: float) -> str:
    return f"{count / 1e9:.2f} GB" if count >= 1e9 else f"{count / 1e6:.2f} MB"


def _age(text: str | None) -> float:
    if text is None:
        return 0.0
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([hd])", text)
    if found is None:
        raise InputError(f"--older-than {text}: write a number of hours or days, such as 12h or 30d")
    return float(found[1]) * SECONDS[found[2]]


def _bytes(text: str | None) -> float:
    from calstudy.base.resources import parse_memory

    try:
        return 0.0 if text is None else parse_memory(text)
    except InputError:
        raise InputError(f"--larger-than {text}: write a positive number and a unit (MB, GB or TB)") from None
