"""What a published paper is to a study: statements with thresholds, and the roles that runs play in them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, cast

from calstudy.base.plugins import Plugin, guarded
from calstudy.experiment.model import PAPERS, Experiment

if TYPE_CHECKING:
    from calstudy.claims.realizations import PooledResults
    from calstudy.claims.results import RunResults
    from calstudy.verdicts.statement import Statement


class Paper(Plugin):
    """The base of all papers.

    Attributes
    ----------
    citation
        Authors, year, title, identifier.
    roles
        The roles that runs play in the paper's statements, and which run plays each, in words that follow "needs".
    usual_members
        Names of members of a collection that play a role unless its file says otherwise.
    own_solver_roles
        For a role, the role of the run that is the same but for its solver, which is the paper's own. If both are
        played, every statement is evaluated with either solver.
    """

    registry: ClassVar = PAPERS
    citation: ClassVar[str] = ""
    roles: ClassVar[Mapping[str, str]] = {}
    usual_members: ClassVar[Mapping[str, str]] = {}
    own_solver_roles: ClassVar[Mapping[str, str]] = {}

    kind: str

    def statements(self) -> Sequence[Statement]:
        """Return the statements, in the order of the paper."""
        return ()

    def refusal(self, role: str, experiment: Experiment) -> str | None:
        """Return in words why an experiment cannot play a role, as far as its settings tell, or None.

        Be strict: a run that is judged by sentences on something else misleads. Scale alone (fewer antennas, channels,
        integrations, sources) should not decide.
        """
        del role, experiment
        return None

    def refusal_of_run(self, role: str, results: RunResults | PooledResults) -> str | None:
        """Return in words why a finished run cannot play a role, or None; by default as `refusal` of its experiment."""
        return self.refusal(role, results.experiment)

    def substitutions(self, experiment: Experiment) -> tuple[str, ...]:
        """Return one short sentence for each ingredient that an experiment uses in place of the paper's own."""
        del experiment
        return ()


def distinct_papers(named: Iterable[Plugin]) -> list[Paper]:
    """Return what fields of papers hold, once each; their registry lets no other plug-ins in."""
    return cast(list[Paper], list({paper.reference: paper for paper in named}.values()))


def stand_ins(experiment: Experiment) -> tuple[str, ...]:
    """Return what must be printed on every figure of an experiment: what stands in for its papers' ingredients.

    If they name nothing, whether the foregrounds are synthetic. And how the instrument as built differs.
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
    """Return notes once each, in their order."""
    return tuple(dict.fromkeys(notes))
