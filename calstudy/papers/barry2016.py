"""Barry et al. 2016: sky-based calibration, channel by channel, with a catalogue that lacks sources.

The statements are in our words, after the paper's abstract.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from calstudy.calibrate.interface import PolynomialSmoothing
from calstudy.calibrate.settings import GainFit
from calstudy.claims.bins import bias
from calstudy.claims.paper import Paper
from calstudy.claims.roles import k_of_delay, require_long_baselines, structured_gains, unsuitable
from calstudy.corrupt.effects.gains import PerChannelGains, ReflectionGains
from calstudy.experiment.model import Experiment
from calstudy.results.reader import Results
from calstudy.verdicts.criterion import AtLeast, AtMost, Finding
from calstudy.verdicts.statement import Source, Unevaluated

WINDOW = (0.2, 0.5)
"""Range of k beyond the wedge and its leakage by the taper, h/Mpc."""
REALISTIC = (0.01, 0.2)
"""Fraction of the rms of the foregrounds that a catalogue of realistic completeness lacks; one of all sources above 0.1
Jy lacks 0.07."""
MISSING = Source("Abstract", ("incomplete_sky_model",))
COMPLETE = ("complete_sky_model", "structured_complete")
STRUCTURED = ("structured_antennas", "structured_complete")
"""Roles of runs with the true sky as model, and of antennas with structure at the delays of the window."""
JOINT = "the precision of the catalogue and the spectral smoothness of the antennas constrain each other"


def _bias(run: Results, incomplete: bool = True) -> Finding:
    """Return the bias in the window if the array is large enough and, if `incomplete`, a realistic part is missing."""
    require_long_baselines(run, WINDOW[1])
    lacking = run.sky_model_error
    if incomplete and not REALISTIC[0] <= lacking <= REALISTIC[1]:
        raise Unevaluated(
            f"the sky model lacks {100 * lacking:.1f} % of the foregrounds, which is no realistic completeness "
            f"({100 * REALISTIC[0]:.0f} to {100 * REALISTIC[1]:.0f} %)"
        )
    return bias(run, *WINDOW)


@MISSING.states(
    "calibrating every channel to a catalogue of realistic completeness contaminates modes that are otherwise free of "
    "foregrounds, so that the EoR cannot be measured",
    "s² P^R0 / P^S outside the wedge, k of 0.2 to 0.5 h/Mpc, with sources missing",
    AtLeast(1, sigmas=2),
    "the EoR cannot be measured below a bias of its own size",
)
def incomplete_model_contaminates_window(run: Results) -> Finding:
    return _bias(run)


@MISSING.states(
    "it can be used only if the calibration model is unrealistically accurate",
    "s² P^R0 / P^S outside the wedge, k of 0.2 to 0.5 h/Mpc, with the complete sky model",
    AtMost(1, sigmas=2),
    "less than the EoR itself, so that it can be measured",
    roles=("complete_sky_model",),
)
def complete_model_leaves_window_clean(run: Results) -> Finding:
    return _bias(run, incomplete=False)


@MISSING.states(
    f"{JOINT}: gains of smooth antennas can be smoothed, which removes what sources that are missing leave",
    "s² P^R0 / P^S outside the wedge, k of 0.2 to 0.5 h/Mpc, with sources missing and smoothed gains",
    AtMost(1, sigmas=2),
    "less than the EoR itself, so that it can be measured",
    roles=("smooth_antennas",),
)
def smooth_antennas_leave_window_clean(run: Results) -> Finding:
    return _bias(run)


@MISSING.states(
    f"{JOINT}: smoothing fails if antennas have structure at the delays of the window",
    "s² P^R0 / P^S outside the wedge, k of 0.2 to 0.5 h/Mpc, with sources missing, smoothed gains and antennas with "
    "such structure",
    AtLeast(1, sigmas=2),
    "the EoR cannot be measured below a bias of its own size",
    roles=("structured_antennas",),
)
def structured_antennas_contaminate_window(run: Results) -> Finding:
    return _bias(run)


@MISSING.states(
    f"{JOINT}: antennas with such structure can be calibrated if the model is unrealistically accurate",
    "s² P^R0 / P^S outside the wedge, k of 0.2 to 0.5 h/Mpc, with the complete sky model and antennas with such "
    "structure",
    AtMost(1, sigmas=2),
    "less than the EoR itself, so that it can be measured",
    roles=("structured_complete",),
)
def complete_model_calibrates_structured_antennas(run: Results) -> Finding:
    return _bias(run, incomplete=False)


class Barry2016(Paper):
    """Statements on sky-based calibration with complete and incomplete sky models."""

    citation = (
        "Barry, N., et al. 2016, Calibration requirements for detecting the 21 cm epoch of reionization power spectrum "
        "and implications for the SKA, arXiv:1603.00607"
    )
    roles: ClassVar[Mapping[str, str]] = {
        "complete_sky_model": "a run of sky-based calibration, channel by channel, of antennas whose gains are smooth "
        "in frequency, with the true sky as its model",
        "incomplete_sky_model": "such a run whose sky model lacks sources",
        "smooth_antennas": "a run of sky-based calibration that smooths gains by polynomials, of antennas whose "
        "gains are smooth in frequency, with a sky model that lacks sources",
        "structured_antennas": "such a run of antennas with structure at the delays of the window, with inverse "
        "variances as weights",
        "structured_complete": "a run of sky-based calibration, channel by channel, of such antennas, "
        "with the true sky as its model and inverse variances as weights",
    }
    usual_members: ClassVar[Mapping[str, str]] = {
        "complete_sky_model": "long-sky-based",
        "incomplete_sky_model": "long-sky-based-incomplete",
        "smooth_antennas": "long-smoothed-incomplete",
        "structured_antennas": "long-smoothed-reflections",
        "structured_complete": "long-reflections",
    }

    def refusal(self, role: str, experiment: Experiment) -> str | None:
        return unsuitable(
            experiment,
            ("sky-based", "skycal"),
            _other_smoothing(experiment, smoothed=role in ("smooth_antennas", "structured_antennas")),
            _no_structure(experiment) if role in STRUCTURED else structured_gains(experiment),
            incomplete=role not in COMPLETE,
        )


def _other_smoothing(experiment: Experiment, smoothed: bool) -> str | None:
    calibration = experiment.calibration
    if isinstance(calibration, GainFit) and calibration.gain_delay is not None:
        return "calibration.gain_delay is set, so that channels are not fitted by themselves"
    if not smoothed:
        return None if calibration.smooth_gains is None else "calibration.smooth_gains is set"
    # Other kinds may leave structure at the delays of the window.
    if isinstance(calibration.smooth_gains, PolynomialSmoothing):
        return None
    return "calibration.smooth_gains is no polynomial"


def _no_structure(experiment: Experiment) -> str | None:
    """Return a refusal if no gains have structure at delays of the window, or None."""
    for effect in experiment.corruption.effects:
        reflected = isinstance(effect, ReflectionGains) and k_of_delay(experiment, effect.delay)
        if isinstance(effect, PerChannelGains) or (reflected and WINDOW[0] <= reflected <= WINDOW[1]):
            return None
    return f"corruption.effects has no structure of the gains at k of {WINDOW[0]:g} to {WINDOW[1]:g} h/Mpc"
