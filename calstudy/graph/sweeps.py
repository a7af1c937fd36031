"""The graph of a sweep: the graphs of its points, and the comparison of their signal loss."""

from __future__ import annotations

from functools import cached_property

from calstudy.experiment.sweep import Sweep
from calstudy.graph.tasks import Graph, Task, unique


class SweepGraph:
    """The tasks of all points of a sweep, and of what compares them.

    Products that several points need have one key, and are one product.

    Parameters
    ----------
    sweep
        Validated.
    """

    def __init__(self, sweep: Sweep) -> None:
        self.sweep = sweep
        self.graphs = {point.label: Graph(point.experiment) for point in sweep.points}

    @cached_property
    def summary(self) -> Task:
        """The signal loss of all points: a table and a figure."""
        settings = {
            "notes": list(self.footnotes),
            "blocks": [
                [{"label": point.label, "changes": dict(point.changes)} for point in block]
                for block in self.sweep.blocks
            ],
        }
        return Task(
            "sweep", self.sweep.base.name, settings, {name: graph.transfer for name, graph in self.graphs.items()}
        )

    @cached_property
    def footnotes(self) -> tuple[str, ...]:
        """What the experiment whose fields are varied uses in place of the paper's own ingredients."""
        return Graph(self.sweep.base).footnotes

    @cached_property
    def targets(self) -> list[Task]:
        """The products that a run of the sweep is for."""
        return [*(task for graph in self.graphs.values() for task in graph.targets), self.summary]

    @cached_property
    def tasks(self) -> list[Task]:
        """All tasks, once each, every one after its inputs."""
        return unique(self.targets)
