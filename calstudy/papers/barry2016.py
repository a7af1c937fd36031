"""Barry et al. 2016: sky-based calibration, channel by channel, with a catalogue that lacks sources.

The statements are in our words, after the paper's abstract.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

from calstudy.claims.bins import bias
from calstudy.claims.paper import Paper
from calstudy.claims.roles import first_refusal, other_calibrator, other_faults, other_sky_model
from calstudy.verdicts.criterion import AtLeast, AtMost, Finding
from calstudy.verdicts.statement import Source, Statement, Unevaluated

if TYPE_CHECKING:
    from calstudy.claims.results import RunResults
    from calstudy.experiment.model import Experiment

WINDOW = (0.2, 0.5)
"""h/Mpc, beyond the wedge and its leakage by the taper."""
REALISTIC = 0.2
"""Part of the rms of the foregrounds that a catalogue of realistic completeness lacks at most; one of all sources above
0.1 Jy lacks 0.07."""
MISSING = Source("Abstract", ("incomplete_sky_model",))


@MISSING.states(
    "calibrating every channel to a catalogue of realistic completeness contaminates modes that are otherwise free of "
    "foregrounds, so that the EoR cannot be measured",
    "s² P^R0 / P^S outside the wedge, k of 0.2 to 0.5 h/Mpc, with sources missing",
    AtLeast(1, sigmas=2),
    "the EoR cannot be measured below a bias of its own size",
)
def incomplete_model_contaminates_window(run: RunResults) -> Finding:
    if run.sky_model_error > REALISTIC:
        raise Unevaluated(
            f"the sky model lacks {100 * run.sky_model_error:.0f} % of the foregrounds, which is no realistic "
            f"completeness ({100 * REALISTIC:.0f} % at most)"
        )
    return bias(run, *WINDOW)


@MISSING.states(
    "it can be used only if the calibration model is unrealistically accurate",
    "the same with the complete sky model",
    AtMost(1, sigmas=2),
    "less than the EoR itself, so that it can be measured",
    roles=("complete_sky_model",),
)
def complete_model_leaves_window_clean(run: RunResults) -> Finding:
    return bias(run, *WINDOW)


class Barry2016(Paper):
    """Statements on sky-based calibration with complete and incomplete sky models."""

    citation = (
        "Barry, N., et al. 2016, Calibration requirements for detecting the 21 cm epoch of reionization power spectrum "
        "and implications for the SKA, arXiv:1603.00607"
    )
    roles: ClassVar[Mapping[str, str]] = {
        "complete_sky_model": "a run of sky-based calibration with the true sky as its model",
        "incomplete_sky_model": "a run of sky-based calibration whose sky model lacks sources",
    }
    usual_members: ClassVar[Mapping[str, str]] = {
        "complete_sky_model": "sky-based",
        "incomplete_sky_model": "sky-based-incomplete",
    }

    def statements(self) -> Sequence[Statement]:
        """Return the statements."""
        return [incomplete_model_contaminates_window, complete_model_leaves_window_clean]

    def refusal(self, role: str, experiment: Experiment) -> str | None:
        """Return what of an experiment is not that of the role, or None."""
        return first_refusal(
            other_calibrator(experiment, ("sky-based", "skycal")),
            other_faults(experiment),
            other_sky_model(experiment, incomplete=role == "incomplete_sky_model"),
        )
