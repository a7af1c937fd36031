"""Tell how a run goes: a bar with the remaining time on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from calstudy.run.store import Product
from calstudy.run.task import Task


def duration(seconds: float) -> str:
    """Write a duration for a person: ``8 s``, ``3 min``, ``2.5 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


class Forecast:
    """Estimate the remaining time of a run from the estimated cost of its tasks and the pace so far."""

    def __init__(self, costs: dict[str, float]) -> None:
        self._costs = costs
        self._total = sum(costs.values())
        self._start = time.perf_counter()
        self.fraction = 0.0

    def finish(self, key: str) -> float:
        """Count a task as made; return the seconds that the rest will take at this pace."""
        self.fraction += self._costs[key] / self._total
        elapsed = time.perf_counter() - self._start
        return elapsed * max(0.0, 1 - self.fraction) / max(self.fraction, 1e-6)


@contextmanager
def report(
    tasks: Sequence[Task], costs: dict[str, float], console: Console
) -> Iterator[Callable[[Task, Product], None]]:
    """Yield a function to call after each product.

    Parameters
    ----------
    tasks
        All that will be made.
    costs
        Estimated seconds per task key.
    console
        Where to write.
    """
    forecast = Forecast(costs)
    if not console.is_terminal:
        count = 0

        def line(task: Task, product: Product) -> None:
            nonlocal count
            count += 1
            left = duration(forecast.finish(task.key))
            seconds = duration(product.record["seconds"])
            console.print(
                f"[{count}/{len(tasks)}] {task.stage.name}: {task.label} ({seconds}), about {left} left", markup=False
            )

        yield line
        return
    columns = (
        TextColumn("{task.percentage:3.0f} %"),
        BarColumn(),
        TextColumn("{task.fields[made]}/" + str(len(tasks))),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
        TextColumn("[dim]{task.description}"),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        bar = progress.add_task("starting workers", total=1.0, made=0, left="")
        made = 0

        def advance(task: Task, product: Product) -> None:
            nonlocal made
            made += 1
            left = duration(forecast.finish(task.key))
            description = f"{task.stage.name}: {task.label}"
            progress.update(
                bar, completed=forecast.fraction, made=made, left=f"about {left} left", description=description
            )

        yield advance
