"""Byrne et al. 2019: redundant calibration with a sky model that lacks sources.

The statements are in our words, after the paper's abstract.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from calstudy.claims.bins import bias
from calstudy.claims.paper import Paper
from calstudy.claims.roles import unsuitable
from calstudy.experiment.model import Experiment
from calstudy.instrument.layouts import make_array, redundant_groups
from calstudy.results.reader import Results
from calstudy.verdicts.criterion import AtLeast, AtMost, Finding
from calstudy.verdicts.statement import Source

CRUCIAL = (0.1, 0.2)
"""Range of k in which the noise allows a detection first, h/Mpc."""
EXACT = 1e-3
"""Distance within which redundant baselines of a lattice are equal, m."""
MISSING = Source("Abstract", ("redundant_incomplete",))


@MISSING.states(
    "with perfect positions and identical beams, redundant calibration still has errors from sources that its sky "
    "model lacks, which can overwhelm the EoR on crucial modes",
    "s² P^R0 / P^S outside the wedge, k of 0.1 to 0.2 h/Mpc, redundant calibration with sources missing",
    AtLeast(1, sigmas=2),
    "a bias of the size of the EoR itself",
)
def absolute_calibration_overwhelms_eor(run: Results) -> Finding:
    return bias(run, *CRUCIAL)


@MISSING.states(
    "the errors come from the sky model",
    "s² P^R0 / P^S outside the wedge, k of 0.1 to 0.2 h/Mpc, redundant calibration with the complete sky model",
    AtMost(1, sigmas=2),
    "less than the EoR itself: with the complete model there are no such errors",
    roles=("redundant_complete",),
)
def complete_model_leaves_crucial_modes(run: Results) -> Finding:
    return bias(run, *CRUCIAL)


class Byrne2019(Paper):
    """Statements on the absolute step of redundant calibration."""

    citation = (
        "Byrne, R., et al. 2019, Fundamental limitations on the calibration of redundant 21 cm cosmology instruments "
        "and implications for HERA and the SKA, arXiv:1811.01378"
    )
    roles: ClassVar[Mapping[str, str]] = {
        "redundant_complete": "a run of redundant calibration (redcal) of an exact lattice, with inverse variances as "
        "weights or gains that are smooth in frequency, and the true sky as its model",
        "redundant_incomplete": "such a run whose sky model lacks sources",
    }
    usual_members: ClassVar[Mapping[str, str]] = {
        "redundant_complete": "redcal",
        "redundant_incomplete": "redcal-incomplete",
    }

    def refusal(self, role: str, experiment: Experiment) -> str | None:
        steps = getattr(experiment.calibration, "steps", ())
        partial = None if "omnical" in steps else "calibration.steps has no omnical"
        found = unsuitable(experiment, ("redcal",), partial, incomplete=role == "redundant_incomplete")
        return found or _no_lattice(experiment)


def _no_lattice(experiment: Experiment) -> str | None:
    """Return a refusal if baselines that count as redundant are not equal, or None."""
    enu = make_array(experiment.instrument).enu
    first, second = np.triu_indices(len(enu), 1)
    tolerances = EXACT, getattr(experiment.calibration, "redundancy_tolerance", EXACT)
    exact, near = (redundant_groups(enu[second] - enu[first], tolerance).index.max() for tolerance in tolerances)
    return None if exact == near else f"redundant baselines of the array differ by more than {1e3 * EXACT:g} mm"
