"""Chokshi et al. 2024: sky-based calibration of MWA tiles whose beams are deformed.

The statements are in our words, after the paper's abstract. The deformation is that of unequal amplitudes of
dipoles; the paper's deformations are fits to beams measured with satellites.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from calstudy.claims.paper import Paper
from calstudy.claims.roles import bias_of_expected_signal, unsuitable
from calstudy.experiment.assumed import assumed_changes, assumed_world
from calstudy.experiment.model import Experiment
from calstudy.results.reader import Results
from calstudy.verdicts.criterion import AtLeast, AtMost, Finding
from calstudy.verdicts.statement import Source

MODES = (0.1, 1.0)
SCATTER = "dipoles.amplitude_scatter"
DIPOLES = "instrument.as_built.dipoles"
AMPLITUDES = f"instrument.as_built.{SCATTER}"
LEAST = 0.05
"""Scatter of the amplitudes below which it is not a deformation of tiles in the field."""
DEFORMED = Source("Abstract", ("one_beam",))


@DEFORMED.states(
    "with one beam model for the whole array, foregrounds leak to more than about 1000 times the expected signal "
    "between k of 0.1 and 1 h/Mpc",
    "s² P^R0 / P^S outside the wedge, k of 0.1 to 1 h/Mpc",
    AtLeast(10**2.5),
    "about a thousand, to half an order of magnitude",
)
def leakage_exceeds_signal_thousandfold(run: Results) -> Finding:
    return bias_of_expected_signal(run, *MODES)


@DEFORMED.states(
    "with the beams of all tiles in the calibration, the leakage is less than the signal",
    "s² P^R0 / P^S outside the wedge, k of 0.1 to 1 h/Mpc, with the true beams in the sky model",
    AtMost(1, sigmas=2),
    "less than the EoR itself",
    roles=("all_beams",),
)
def known_beams_leave_less_than_signal(run: Results) -> Finding:
    return bias_of_expected_signal(run, *MODES)


class Chokshi2024(Paper):
    """Statements on deformed beams."""

    version: ClassVar[int] = 3
    citation = (
        "Chokshi, A., et al. 2024, The necessity of individually validated beam models for an interferometric epoch of "
        "reionization detection, arXiv:2409.19875"
    )
    roles: ClassVar[Mapping[str, str]] = {
        "one_beam": "a run of sky-based calibration of tiles with unequal dipoles, unknown to its model, with inverse "
        "variances as weights or gains that are smooth in frequency",
        "all_beams": "a run of sky-based calibration of tiles with unequal dipoles, with these in calibration.assumed",
    }
    usual_members: ClassVar[Mapping[str, str]] = {
        "one_beam": "long-deformed-beams",
        "all_beams": "long-deformed-beams-known",
    }

    def refusal(self, role: str, experiment: Experiment) -> str | None:
        found = experiment.instrument.as_built.dipoles.amplitude_scatter
        equal = None if found >= LEAST else f"{AMPLITUDES} is {found:g}, not {LEAST:g} or more"
        incomplete = False if role == "one_beam" else None
        refusal = unsuitable(experiment, ("sky-based", "skycal"), equal, incomplete=incomplete, fault=SCATTER)
        if refusal is not None or role == "one_beam":
            return refusal
        others = [path for path in assumed_changes(experiment.calibration.assumed) if not path.startswith(DIPOLES)]
        if others:
            return f"calibration.assumed has {others[0]}"
        if assumed_world(experiment).instrument.as_built.dipoles != experiment.instrument.as_built.dipoles:
            return f"calibration.assumed does not have the true {DIPOLES}"
        return None
