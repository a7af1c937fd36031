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
Unreferenced = Annotated[
    bool, typer.Option("--unreferenced", help="Only products that no run in the folder --runs refers to.")
]
Runs = Annotated[Path, typer.Option(help="Folder of runs, for --unreferenced.")]
Delete = Annotated[bool, typer.Option("--delete", help="List the products that are chosen, and delete them.")]
SECONDS = {"h": 3600.0, "d": 86_400.0}


def runs(folder: RunsFolder = Path("runs")) -> None:
    """List finished runs: time, size, and number of products."""
    from calstudy.base.table import Table
    from calstudy.results.reader import find_runs

    rows = [
        (f"{run.path.relative_to(folder)}", f"{run.finished:%Y-%m-%d %H:%M}", _size(run.size), f"{len(run.keys)}")
        for run in find_runs(folder)
    ]
    Table(("folder", "finished (UTC)", "size", "products"), rows, f"runs in {folder}").show(Console(highlight=False))


def store(
    folder: StoreFolder = Path("store"),
    older_than: OlderThan = None,
    unreferenced: Unreferenced = False,
    runs: Runs = Path("runs"),
    delete: Delete = False,
) -> None:
    """Show what is in a store by stage, or delete chosen products, but those that a run needs at this time.

    A deleted product is made again by the next run that needs it. Folders left by killed runs are listed too, and
    deleted with --older-than. Without --delete nothing is changed; with it, --older-than, --unreferenced or both
    must choose the products.
    """
    from calstudy.results.reader import keys_of_runs
    from calstudy.run.store import Store, age_of, leftovers, products
    from calstudy.run.store import unreferenced as without_run

    if not folder.is_dir():
        raise InputError(f"{folder}: no such store")
    if delete and older_than is None and not unreferenced:
        raise InputError("--delete: say which products by --older-than or --unreferenced")
    oldest, where = _age(older_than), Store(folder)
    chosen = list(products(where))
    if unreferenced:
        chosen = without_run(chosen, keys_of_runs(runs))
    chosen = [product for product in chosen if age_of(product) >= oldest]
    console = Console(highlight=False)
    _show(chosen, folder, console)
    left = [item for item in leftovers(where) if item.age >= oldest]
    for item in left:
        age = f"{item.age / SECONDS['d']:.1f} d"
        console.print(f"leftover of a run: {item.path}, {_size(item.size)}, {age}", markup=False)
    if delete:
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
