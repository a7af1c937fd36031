"""The graph of a collection: the graphs of its members, and what compares them."""

from __future__ import annotations

from functools import cached_property

from calstudy.experiment.collection import COMPARED, Collection
from calstudy.graph.claims import claim_facts, claim_inputs
from calstudy.graph.tasks import Graph, Task, unique


class CollectionGraph:
    """The tasks of all members of a collection, and of its combined figures and claims.

    Products that several members need have one key, and are one product.

    Parameters
    ----------
    collection
        Validated.
    """

    def __init__(self, collection: Collection) -> None:
        self.collection = collection
        self.graphs = {name: Graph(experiment) for name, experiment in collection.members.items()}

    @cached_property
    def figures(self) -> list[Task]:
        """The combined figures asked for."""
        return [self._figure(name) for name in self.collection.figures]

    def _figure(self, name: str) -> Task:
        compared = {role: self.graphs[self.collection.roles[role]] for role in COMPARED}
        notes = list(dict.fromkeys(note for graph in compared.values() for note in graph.footnotes))
        if name == "layouts":
            layouts = {role: graph.sections["instrument"]["layout"] for role, graph in compared.items()}
            return Task("combined-figure", name, {"figure": name, "notes": [], "layouts": layouts})
        inputs = {role: graph.spectra for role, graph in compared.items()}
        return Task("combined-figure", name, {"figure": name, "notes": notes}, inputs)

    @cached_property
    def claims(self) -> Task:
        """The paper's claims, each evaluated on the members whose roles it is about."""
        playing = {name: self.graphs[name] for name in self.collection.roles.values()}
        settings = {
            "title": self.collection.name,
            "notes": list(self.footnotes),
            "roles": dict(self.collection.roles),
            "experiments": {name: claim_facts(graph) for name, graph in playing.items()},
        }
        inputs = {
            f"{table}:{name}": task for name, graph in playing.items() for table, task in claim_inputs(graph).items()
        }
        return Task("combined-claims", "claims of all", settings, inputs)

    @cached_property
    def footnotes(self) -> tuple[str, ...]:
        """What any member uses in place of the paper's own ingredients."""
        return tuple(dict.fromkeys(note for graph in self.graphs.values() for note in graph.footnotes))

    @cached_property
    def own(self) -> list[Task]:
        """The products that are the collection's own, and not a member's."""
        return [*self.figures, self.claims]

    @cached_property
    def targets(self) -> list[Task]:
        """The products that a run of the collection is for."""
        return [task for graph in self.graphs.values() for task in graph.targets] + self.own

    @cached_property
    def tasks(self) -> list[Task]:
        """All tasks, once each, every one after its inputs."""
        return unique(self.targets)
