"""The interface of papers: statements with thresholds, and the roles of runs in them."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, cast

from calstudy.base.plugins import Plugin, guarded
from calstudy.experiment.model import PAPERS, Experiment
from calstudy.verdicts.statement import Statement

if TYPE_CHECKING:
    from calstudy.claims.realizations import PooledResults
    from calstudy.results.reader import Results


class Paper(Plugin):
    """Base class of papers.

    Attributes
    ----------
    citation : authors, year, title, identifier
    roles : roles of runs in the paper's statements, with a description of the run in words that follow "needs"
    usual_members : name of the member of a collection that plays a role, unless its file names another
    own_solver_roles
        For a role, the role of the run that differs only in its solver, which is the paper's own. If both are
        played, every statement is evaluated with either solver.
    """

    registry: ClassVar = PAPERS
    citation: ClassVar[str] = ""
    roles: ClassVar[Mapping[str, str]] = {}
    usual_members: ClassVar[Mapping[str, str]] = {}
    own_solver_roles: ClassVar[Mapping[str, str]] = {}
    module: ClassVar[ModuleType | None]

    kind: str

    @classmethod
    def __pydantic_init_subclass__(cls, **given: Any) -> None:
        """Keep the module of a class: another file may import another module of this name later."""
        super().__pydantic_init_subclass__(**given)
        cls.module = sys.modules.get(cls.__module__)

    def statements(self) -> Sequence[Statement]:
        """Return the statements, in the order of the paper; by default those in the module of the class or a base."""
        modules = [vars(kind)["module"] for kind in type(self).__mro__ if "module" in vars(kind)]
        found = (
            [item for item in vars(module).values() if isinstance(item, Statement)] for module in filter(None, modules)
        )
        return next(filter(None, found), [])

    def refusal(self, role: str, experiment: Experiment) -> str | None:
        """Return in words why the settings of an experiment do not allow it to play a role, or None.

        Be strict: statements mislead if they are evaluated on a run of something else. Scale alone (fewer antennas,
        channels, integrations, sources) should not decide.
        """
        return None

    def refusal_of_run(self, role: str, results: Results | PooledResults) -> str | None:
        """Return in words why a finished run cannot play a role, or None; by default `refusal` of its experiment."""
        return self.refusal(role, results.experiment)

    def substitutions(self, experiment: Experiment) -> tuple[str, ...]:
        """Return one short sentence for each ingredient that an experiment uses in place of the paper's own."""
        return ()


def distinct_papers(named: Iterable[Plugin]) -> list[Paper]:
    """Return the papers in plug-in fields once each; only papers are possible in these fields."""
    return cast(list[Paper], list({paper.reference: paper for paper in named}.values()))


def stand_ins(experiment: Experiment) -> tuple[str, ...]:
    """Return the notes printed on every figure of an experiment: substitutions for its papers' ingredients.

    If there are none, a note on synthetic foregrounds may follow, and finally one on the instrument as built.
    """
    notes: list[str] = []
    for paper in distinct_papers(experiment.papers):
        with guarded(paper):
            notes += paper.substitutions(experiment)
    if not notes and experiment.sky.foregrounds.kind == "g4jy-and-counts":
        notes.append("sky: G4Jy bright sources + synthetic faint ones from counts")
    as_built = experiment.instrument.as_built.note
    return unique_notes([*notes, as_built] if as_built else notes)


def unique_notes(notes: Iterable[str]) -> tuple[str, ...]:
    """Return each note once, in order."""
    return tuple(dict.fromkeys(notes))
