"""Report the progress of a run: a bar with the remaining time on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from calstudy.run.store import Product
from calstudy.run.task import Task


def duration(seconds: float) -> str:
    """Format a duration: ``8 s``, ``3 min``, ``2.5 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


PLANNED_SECONDS = 60.0
"""So much of a run counts as having gone as planned before it began: workers that start, and import libraries, tell
little of the pace of what follows."""


class Forecast:
    """Estimate the remaining time of a run from the estimated cost of its tasks and the pace so far.

    Costs are seconds of one core by key; `workers` is the number of tasks that are made at a time, and `count` that of
    tasks that were made.
    """

    def __init__(self, costs: dict[str, float], workers: int) -> None:
        self._costs, self._workers = costs, workers
        self._total, self._made, self.count = sum(costs.values()), 0.0, 0
        self._start = time.perf_counter()

    @property
    def fraction(self) -> float:
        """Completed fraction of the estimated cost."""
        return self._made / self._total

    def finish(self, key: str) -> float:
        """Count a task as made; return the remaining seconds at the present pace."""
        self._made += self._costs[key]
        self.count += 1
        elapsed = time.perf_counter() - self._start
        pace = (elapsed + PLANNED_SECONDS) / (self._made / self._workers + PLANNED_SECONDS)
        return pace * max(0.0, self._total - self._made) / self._workers


@contextmanager
def report(
    tasks: Sequence[Task], costs: dict[str, float], workers: int, console: Console
) -> Iterator[Callable[[Task, Product], None]]:
    """Yield a function that reports each product when it is made; costs are estimated seconds by key."""
    forecast = Forecast(costs, workers)
    if not console.is_terminal:

        def line(task: Task, product: Product) -> None:
            left, seconds = duration(forecast.finish(task.key)), duration(product.record["seconds"])
            place = f"[{forecast.count}/{len(tasks)}]"
            console.print(f"{place} {task.stage.name}: {task.label} ({seconds}), about {left} left", markup=False)

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

        def advance(task: Task, product: Product) -> None:
            left = f"about {duration(forecast.finish(task.key))} left"
            made, described = forecast.count, f"{task.stage.name}: {task.label}"
            progress.update(bar, completed=forecast.fraction, made=made, left=left, description=described)

        yield advance
