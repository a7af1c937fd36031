"""Joseph et al. 2020: sky-based calibration of MWA tiles of which some have a dead dipole.

The statements are in our words, after the paper's abstract. The paper's 10^3 mK^2 h^-3 Mpc^3 are after subtraction
of sources; here the residual is that of the sky model. They depend on its foregrounds, and are compared through the
expected signal, which is two orders of magnitude smaller according to the paper. By these numbers it would be 10 mK^2
h^-3 Mpc^3, a thousandth of what simulations of reionization expect at k of 0.3 h/Mpc; the reason is not known to us.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from calstudy.claims.paper import Paper
from calstudy.claims.roles import bias_of_expected_signal, unsuitable
from calstudy.experiment.model import Experiment
from calstudy.results.reader import Results
from calstudy.verdicts.criterion import AtLeast, Finding, Within
from calstudy.verdicts.statement import Source

TILES = (0.15, 0.4)
"""Range of the fraction of tiles with at least one dead dipole."""
MODES = (0.1, 1.0)
DEAD = Source("Abstract", ("dead_dipoles",))


@DEAD.states(
    "beam models without the dead dipoles bias the power spectrum by about 10³ mK² h⁻³ Mpc³, two orders of magnitude "
    "above the expected signal",
    "s² P^R0 / P^S outside the wedge, k of 0.1 to 1 h/Mpc",
    Within(10**1.5, 10**2.5),
    "a hundred, to half an order of magnitude",
)
def bias_is_a_hundred_signals(run: Results) -> Finding:
    return bias_of_expected_signal(run, *MODES)


@DEAD.states(
    "this is above the expected signal",
    "s² P^R0 / P^S outside the wedge, k of 0.1 to 1 h/Mpc",
    AtLeast(1, sigmas=2),
    "above it at all, beyond the errors",
)
def bias_exceeds_expected_signal(run: Results) -> Finding:
    return bias_of_expected_signal(run, *MODES)


class Joseph2020(Paper):
    """Statements on dead dipoles."""

    version: ClassVar[int] = 2
    citation = (
        "Joseph, R. C., et al. 2020, Calibration and 21-cm power spectrum estimation in the presence of antenna beam "
        "variations, arXiv:1911.13088"
    )
    roles: ClassVar[Mapping[str, str]] = {
        "dead_dipoles": "a run of sky-based calibration with a dead dipole in 15 to 40 % of tiles, unknown to its "
        "model, with inverse variances as weights or gains that are smooth in frequency"
    }
    usual_members: ClassVar[Mapping[str, str]] = {"dead_dipoles": "long-dead-dipoles"}

    def refusal(self, role: str, experiment: Experiment) -> str | None:
        dead = experiment.instrument.as_built.dipoles.dead_tiles
        fewest, most = TILES
        few = f"instrument.as_built.dipoles.dead_tiles is {dead:g}, not {fewest:g} to {most:g}"
        other = None if fewest <= dead <= most else few
        fault = "dipoles.dead_tiles"
        return unsuitable(experiment, ("sky-based", "skycal"), other, incomplete=False, fault=fault)
