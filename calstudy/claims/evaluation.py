"""All claims of the paper, evaluated on the runs that there are."""

from __future__ import annotations

from collections.abc import Mapping

from calstudy.claims import calibration, computation, low_snr, redundant, window
from calstudy.claims.facts import Role
from calstudy.claims.run_times import RunTimes
from calstudy.claims.statement import Claim, Statement
from calstudy.claims.study import Study, Unevaluated

STATEMENTS: tuple[Statement, ...] = tuple(
    item
    for module in (calibration, window, redundant, low_snr, computation)
    for item in vars(module).values()
    if isinstance(item, Statement)
)
"""In the order of the paper's sections."""

REDUNDANT_FROM = 0.5
"""An array is redundant if this part of its baselines has a redundant partner."""


def roles_of(study: Study) -> tuple[Role, ...]:
    """Return the parts that a run can play, from its gains, its array, its calibrator and its solver."""
    kind = study.corruption.gains.kind
    if kind == "reflection" and study.calibration.code is None:
        return ("low_snr",)
    if kind != "per-channel" or study.calibration.code is not None:
        return ()
    try:
        fraction = study.agreement["redundant_fraction"]
    except Unevaluated:
        return ()
    if fraction >= REDUNDANT_FROM:
        return ("redundant",) if study.calibration.calibrator == "calamity" else ("redundant_modelling",)
    papers = study.calibration.solver.name == "adamax"
    return ("minimally_redundant", "paper_solver") if papers else ("minimally_redundant",)


def evaluate(studies: Mapping[Role, Study | RunTimes]) -> list[Claim]:
    """Evaluate every statement on the runs that play its roles.

    Parameters
    ----------
    studies
        The runs by the role they play; statements whose roles nobody plays come back as not evaluated, with the reason.
    """
    return [statement.evaluate(studies) for statement in STATEMENTS]
