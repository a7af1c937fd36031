"""CALAMITY: Ewall-Wice et al. 2022, calibration with foregrounds modelled by DPSS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

from calstudy.base.paths import differences
from calstudy.base.schema import Section
from calstudy.calibrate.settings import AdamaxSettings, FlagWeights, GainFit, Solver
from calstudy.claims.paper import Paper
from calstudy.corrupt.noise import NoNoise, RadiometerNoise
from calstudy.experiment.model import Experiment
from calstudy.instrument.as_built import AsBuilt
from calstudy.instrument.beam_models.tables import MwaEmbeddedBeam
from calstudy.verdicts.statement import Statement

if TYPE_CHECKING:
    from calstudy.claims.realizations import PooledResults
    from calstudy.results.reader import Results

REDUNDANT_FROM = 0.5
"""Fraction of baselines with a redundant partner from which an array is redundant."""
PAPER_WIDTH = 80e3
"""Width of a channel, Hz."""
PAPER_BAND = 167e6, 198e6
"""The paper's 384 channels begin and end within it, Hz."""
EOR_LEVEL = -40.0
"""Level of the EoR relative to the foregrounds, dB of brightness."""
NOISE_FACTORS = {"times-eor": 10.0, "times-foregrounds": 0.1}
SAME_NOISE = 0.1
"""Largest relative difference of the noise, averaged over all integrations, from the paper's in a run of fewer ones."""
PAPER_RATE, PAPER_STEPS = 0.01, 10_000
LEAST_STEPS = 1000
"""First-order steps below which foregrounds are not fitted: the paper's solver takes thousands."""
NOT_THE_METHOD = ("calibrator", "solver", "weights", "chunks", "models_at_once")
"""Fields of a calibrator whose defaults are not the paper's, or need not be."""
NOT_THE_ESTIMATE = ("estimator", "pairs", "redundancy_tolerance", "length_bin", "bins")
"""Fields of `power` that may differ: bins, and what makes the same spectra."""


class Calamity2022(Paper):
    """The statements of Ewall-Wice et al. 2022 on its two arrays, the low-SNR case, and run times."""

    citation = (
        "Ewall-Wice, A., et al. 2022, Precision calibration of radio interferometers for 21 cm cosmology with no "
        "redundancy and little knowledge of antenna beams and the radio sky"
    )
    roles: ClassVar[Mapping[str, str]] = {
        "minimally_redundant": "a run of an array that is not redundant, with gains per channel",
        "redundant": "a run of a redundant array, each baseline modelled by itself",
        "redundant_modelling": "a run of the redundant array with one model per group (calibrator: calamity-redundant)",
        "low_snr": "a run with reflection gains alone",
        "other_channels": "a run of the minimally redundant array with channels of another width",
        "paper_solver": "a run of the minimally redundant array with the paper's solver (solver: adamax)",
        "redundant_paper_solver": "a run of the redundant array with the paper's solver",
        "low_snr_paper_solver": "a run with reflection gains alone and the paper's solver",
        "run_time": "a run of experiments/runtime.yaml",
    }
    usual_members: ClassVar[Mapping[str, str]] = {
        "minimally_redundant": "minredundant",
        "redundant": "redundant",
        "redundant_modelling": "redundant-modelling",
        "low_snr": "lowsnr",
        "other_channels": "minredundant-320-khz",
        "paper_solver": "minredundant-adamax",
        "redundant_paper_solver": "redundant-adamax",
        "low_snr_paper_solver": "lowsnr-adamax",
    }
    own_solver_roles: ClassVar[Mapping[str, str]] = {
        "minimally_redundant": "paper_solver",
        "redundant": "redundant_paper_solver",
        "low_snr": "low_snr_paper_solver",
    }

    def statements(self) -> Sequence[Statement]:
        from calstudy.papers.calamity2022 import calibration, computation, method, redundant, window

        modules = (method, calibration, window, redundant, computation)
        return [item for module in modules for item in vars(module).values() if isinstance(item, Statement)]

    def refusal(self, role: str, experiment: Experiment) -> str | None:
        """Return in words an unsuitable setting of an experiment for a role, or None.

        Defaults of experiments are the paper's values, except for the weights. Antennas, channels, integrations and
        sources may be fewer, and substitutions for the sky and the beam are written with the results.
        """
        if role == "run_time":
            return "an experiment measures no run times"
        checks = (
            _other_calibrator,
            _other_gains,
            _other_noise,
            _other_data,
            _other_sky,
            _too_few_steps,
            _other_channels,
            _other_power,
        )
        study = _study(role)
        found = next((refusal for check in checks if (refusal := check(study, experiment)) is not None), None)
        return _other_solver(experiment) if found is None and role != study else found

    def refusal_of_run(self, role: str, results: Results | PooledResults) -> str | None:
        refusal, study = self.refusal(role, results.experiment), _study(role)
        if refusal is not None or study == "low_snr":
            return refusal
        fraction = results.redundant_fraction
        if fraction is None:
            return "the run has no calibrated variant 'residual' of foregrounds and noise, or no variant 'noise'"
        wanted = study in ("redundant", "redundant_modelling")
        if (fraction >= REDUNDANT_FROM) == wanted:
            return None
        verdict = "few" if wanted else "many"
        return f"too {verdict} of the baselines have a redundant partner ({100 * fraction:.0f} %)"

    def substitutions(self, experiment: Experiment) -> tuple[str, ...]:
        return tuple(note for note in (_sky(experiment), _beam(experiment), _scale(experiment)) if note)


def _study(role: str) -> str:
    """Return the role of the same study with any solver."""
    return {own: of_any for of_any, own in Calamity2022.own_solver_roles.items()}.get(role, role)


def _changed(section: Section, path: str, free: tuple[str, ...] = ()) -> str | None:
    """Return in words a field of a section that is not the paper's, which is its default; None if all others are."""
    papers = section.with_defaults(*(name for name in type(section).model_fields if name not in free))
    changes = differences(papers.model_dump(mode="json"), section.model_dump(mode="json"))
    return next((f"{path}.{field} is {value}, not the paper's" for field, _, value in changes), None)


def _other_calibrator(role: str, experiment: Experiment) -> str | None:
    wanted = "calamity-redundant" if role == "redundant_modelling" else "calamity"
    if experiment.calibration.calibrator != wanted:
        return f"calibration.calibrator is {experiment.calibration.calibrator!r}, not {wanted!r}"
    if isinstance(experiment.calibration, GainFit) and experiment.calibration.weights != FlagWeights():
        return f"calibration.weights is {experiment.calibration.weights.kind!r}, not the paper's 'flags'"
    return _changed(experiment.calibration, "calibration", NOT_THE_METHOD)


def _other_gains(role: str, experiment: Experiment) -> str | None:
    wanted = "reflection-gains" if role == "low_snr" else "per-channel-gains"
    effects = experiment.corruption.effects
    if [effect.kind for effect in effects] != [wanted]:
        named = ", ".join(effect.label for effect in effects) or "empty"
        return f"corruption.effects is {named}, not {wanted} alone"
    return _changed(effects[0], "corruption.effects.0", ("kind", "seed"))


def _other_noise(role: str, experiment: Experiment) -> str | None:
    noise, wanted = experiment.corruption.noise, "times-foregrounds" if role == "low_snr" else "times-eor"
    if isinstance(noise, NoNoise | RadiometerNoise) or noise.kind != wanted:
        return f"corruption.noise is {noise.kind!r}, not {wanted!r}"
    papers = NOISE_FACTORS[wanted]
    averaged = noise.factor / papers * (PAPER_TIMES / experiment.instrument.times.count) ** 0.5
    if noise.factor != papers and abs(averaged - 1) > SAME_NOISE:
        return (
            f"corruption.noise.factor is {noise.factor:g}, not {papers:g} or as much in the mean of fewer integrations"
        )
    return None


def _other_data(role: str, experiment: Experiment) -> str | None:
    if experiment.instrument.as_built != AsBuilt():
        return "instrument.as_built is set: the paper's antennas are as designed"
    if experiment.corruption.eor_level != EOR_LEVEL:
        return f"corruption.eor_level is not {EOR_LEVEL:g} dB"
    papers = type(experiment).model_fields["variants"].get_default(call_default_factory=True)
    others = [name for name, variant in experiment.variants.items() if papers.get(name, variant) != variant]
    return f"variants.{others[0]} is not the paper's" if others else None


def _other_sky(role: str, experiment: Experiment) -> str | None:
    if experiment.sky.diffuse.kind != "none":
        return f"sky.diffuse is {experiment.sky.diffuse.kind!r}, and the paper's sky has sources alone"
    return _changed(experiment.sky.eor, "sky.eor", ("nside", "seed"))


def _other_channels(role: str, experiment: Experiment) -> str | None:
    channels = experiment.instrument.channels
    low, high = PAPER_BAND
    if not low <= channels.band[0] < channels.band[1] <= high:
        return f"instrument.channels has {channels.label}, not in the paper's {low / 1e6:g} to {high / 1e6:g} MHz"
    if role == "other_channels" and channels.width == PAPER_WIDTH:
        return f"instrument.channels.width is the paper's, {PAPER_WIDTH / 1e3:g} kHz"
    return None


def _other_power(role: str, experiment: Experiment) -> str | None:
    if role in ("minimally_redundant", "other_channels") and experiment.power.pairs == "redundant-group":
        return "power.pairs is 'redundant-group', and the paper's baselines are crossed with themselves"
    # At low signal to noise the paper does not say what it averages.
    free = (*NOT_THE_ESTIMATE, "coherent_time") if role == "low_snr" else NOT_THE_ESTIMATE
    return _changed(experiment.power, "power", free)


def _solver(experiment: Experiment) -> Solver | None:
    return experiment.calibration.solver if isinstance(experiment.calibration, GainFit) else None


def _too_few_steps(role: str, experiment: Experiment) -> str | None:
    solver = _solver(experiment)
    if isinstance(solver, AdamaxSettings) and solver.max_steps < LEAST_STEPS:
        return f"calibration.solver.max_steps is {solver.max_steps}, and {solver.name} takes thousands of steps"
    return None


def _other_solver(experiment: Experiment) -> str | None:
    """Return a refusal of a solver unlike the authors' code: fixed rate, last gains, steps or rule to stop."""
    solver = _solver(experiment)
    if not isinstance(solver, AdamaxSettings) or solver.learning_rate != PAPER_RATE:
        return f"calibration.solver is not the paper's (adamax at a constant rate of {PAPER_RATE})"
    for name, wanted in (("keep", "last"), ("precision", "single")):
        if (found := getattr(solver, name)) != wanted:
            return f"calibration.solver.{name} is {found!r}, not the paper's {wanted!r}"
    if solver.max_steps < PAPER_STEPS:
        return f"calibration.solver.max_steps is {solver.max_steps}, not the paper's {PAPER_STEPS}"
    if solver.stop != "published" and solver.tolerance > 0:
        return (
            f"calibration.solver.tolerance is {solver.tolerance:g}: it takes a fixed number of steps (0), or the "
            "paper's rule (stop: published)"
        )
    return None


PAPER_CHANNELS, PAPER_TIMES, PAPER_ANTENNAS, PAPER_NSIDE = 384, 56, 36, 256


def _sky(experiment: Experiment) -> str | None:
    foregrounds = experiment.sky.foregrounds
    if foregrounds.kind == "g4jy-and-counts":
        return "sky: G4Jy bright sources + synthetic faint ones from counts, not GLEAM"
    if foregrounds.kind in ("file", "code"):
        return f"sky: {foregrounds.path.name}, not GLEAM"
    return None


def _beam(experiment: Experiment) -> str | None:
    others = sum(len(group.antennas) for group in experiment.instrument.antenna_beams.values())
    own = _own_beam(experiment)
    if not others:
        return own
    return f"{own or 'beam: the MWA embedded element'}; antennas with another: {others}"


def _own_beam(experiment: Experiment) -> str | None:
    beam = experiment.instrument.beam
    if not isinstance(beam, MwaEmbeddedBeam):
        return f"beam: {beam.label}, not the MWA embedded element"
    return f"beam: {beam.path.name}, not the MWA embedded element's own file" if beam.path else None


def _scale(experiment: Experiment) -> str | None:
    instrument = experiment.instrument
    counts = (
        (instrument.channels.count, PAPER_CHANNELS, "channels"),
        (instrument.times.count, PAPER_TIMES, "integrations"),
        (getattr(instrument.layout, "count", None), PAPER_ANTENNAS, "antennas"),
    )
    fewer = ((count, papers, noun) for count, papers, noun in counts if count is not None and count < papers)
    reductions = [f"{count} of {papers} {noun}" for count, papers, noun in fewer]
    if experiment.sky.eor.nside < PAPER_NSIDE:
        reductions.append(f"EoR nside {experiment.sky.eor.nside} of {PAPER_NSIDE}")
    sources = getattr(experiment.sky.foregrounds, "count", None)
    if sources is not None:
        reductions.append(f"the {sources} brightest sources")
    return f"reduced scale: {', '.join(reductions)}" if reductions else None
