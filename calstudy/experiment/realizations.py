"""Realizations of an experiment: the same experiment with other seeds of the EoR, the gains or the noise."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any

from calstudy.base.errors import ExperimentError, InputError
from calstudy.corrupt.interface import GainEffect
from calstudy.corrupt.noise import NoNoise
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS, Experiment
from calstudy.sky.settings import SyntheticDiffuse

PARTS = ("eor", "gains", "noise")
"""Parts that can be drawn again."""
SEED_STEP = 10
"""Draw number n of a part, counted from 0, adds n times this to its seeds in the experiment."""


@dataclass(frozen=True)
class Realization:
    """One realization: an experiment with the seeds of its draws and without `realizations`.

    `draws` are the numbers of the draws of each of `PARTS`, counted from 0; 0 has the seeds of the experiment.
    """

    draws: Mapping[str, int]
    experiment: Experiment

    @property
    def label(self) -> str:
        """Parts that are drawn again, such as ``gains 3, noise 3``, counted from 1; ``base`` for the experiment."""
        return ", ".join(f"{part} {number + 1}" for part, number in self.draws.items() if number) or "base"


def expand_realizations(experiment: Experiment) -> list[Realization]:
    """Return the realizations of all blocks, each once: first the experiment itself, then those of block after block.

    Raises InputError if the experiment has none, and ExperimentError, with one sentence per fault, if it cannot.
    """
    blocks = experiment.realizations
    if not blocks:
        raise InputError(f"{experiment.name}: has no realizations")
    if faults := _faults(experiment):
        raise ExperimentError(faults)
    base = experiment.with_defaults("realizations", "scales")
    found = [Realization(dict.fromkeys(PARTS, 0), base)]
    # Besides the experiment itself, only the variants of the pooled quantities are needed.
    lean = base.model_copy(update={"variants": {name: base.variants[name] for name in SIGNAL_LOSS_VARIANTS}})
    for block in blocks:
        for number in range(1, block.count):
            draws = {part: number if part in block.draw else 0 for part in PARTS}
            found.append(Realization(draws, _drawn(lean, draws)))
    return found


def members(experiment: Experiment) -> list[list[int]]:
    """Return the indices of each block's realizations in `expand_realizations`; the first is in all blocks."""
    ends = list(accumulate((block.count - 1 for block in experiment.realizations), initial=1))
    return [[0, *range(first, end)] for first, end in pairwise(ends)]


def _drawn(experiment: Experiment, draws: Mapping[str, int]) -> Experiment:
    """Return the experiment with the seeds of some draws."""
    sky, corruption = experiment.sky, experiment.corruption
    eor = sky.eor.model_copy(update={"seed": sky.eor.seed + SEED_STEP * draws["eor"]})
    seeds = _noise_seeds(experiment)
    moved = {name: tuple(seed + SEED_STEP * draws["noise"] for seed in found) for name, found in seeds.items()}
    changes = {
        "effects": tuple(_with_gains_drawn(effect, SEED_STEP * draws["gains"]) for effect in corruption.effects),
        "noise": corruption.noise.model_copy(update=moved),
    }
    update = {"sky": sky.model_copy(update={"eor": eor}), "corruption": corruption.model_copy(update=changes)}
    return experiment.model_copy(update=update)


def _noise_seeds(experiment: Experiment) -> dict[str, tuple[int, ...]]:
    noise = experiment.corruption.noise
    return {name: found for name in ("seeds", "seeds_without_eor") if (found := getattr(noise, name, None))}


def _gain_seed(effect: Any) -> int | None:
    """Return the seed of an effect on the gains, or else of its drift; None without any, or for other effects."""
    if not isinstance(effect, GainEffect):
        return None
    return getattr(effect, "seed", None if effect.drift is None else effect.drift.seed)


def _with_gains_drawn(effect: Any, step: int) -> Any:
    """Return an effect whose gains have other seeds, larger by a step."""
    if (seed := _gain_seed(effect)) is None:
        return effect
    if hasattr(effect, "seed"):
        return effect.model_copy(update={"seed": seed + step})
    return effect.model_copy(update={"drift": effect.drift.model_copy(update={"seed": seed + step})})


def _faults(experiment: Experiment) -> list[str]:
    faults = []
    drawn = [part for block in experiment.realizations for part in block.draw]
    if experiment.sweep:
        faults.append("realizations: cannot be asked for together with a sweep; use two files")
    if experiment.outputs.tables:
        faults.append("outputs.tables: are tables of single runs, and there are realizations; leave them out")
    if not experiment.measures_signal_loss:
        names = ", ".join(SIGNAL_LOSS_VARIANTS)
        faults.append(f"realizations: pool the signal loss, which needs the variants {names}")
    faults += [
        f"realizations: draw {part!r} in {count} blocks; each part can be drawn in one block only"
        for part, count in Counter(drawn).items()
        if count > 1
    ]
    if "noise" in drawn and isinstance(experiment.corruption.noise, NoNoise):
        faults.append("realizations: draw 'noise', but corruption.noise is 'none'")
    if "gains" in drawn and all(_gain_seed(effect) is None for effect in experiment.corruption.effects):
        faults.append(
            "realizations: draw 'gains', but no effect on the gains in corruption.effects, nor a drift, has a seed"
        )
    return faults or _coinciding_seeds(experiment)


def _coinciding_seeds(experiment: Experiment) -> list[str]:
    """Return a sentence if something that is drawn would have random numbers of another realization, or other draws."""
    counts = {
        "the EoR" if part == "eor" else part: block.count for block in experiment.realizations for part in block.draw
    }
    diffuse, eor = experiment.sky.diffuse, experiment.sky.eor
    # Those of skies and of data are of different generators.
    skies: list[tuple[str, int]] = []
    if isinstance(diffuse, SyntheticDiffuse) and eor.spectrum != "flat":
        skies = [("sky.diffuse", diffuse.seed), ("the EoR", eor.seed)]
    seeds = [(effect, _gain_seed(effect)) for effect in experiment.corruption.effects]
    bases = [("gains", seed) for _, seed in seeds if seed is not None]
    bases += [("noise", seed) for found in _noise_seeds(experiment).values() for seed in found]
    # What no realization draws again.
    built = experiment.instrument.as_built.drawn_seeds
    bases += [(f"instrument.as_built.{name}", seed) for name, seed in built.items()]
    bases += [
        (f"corruption.effects.{place}", own)
        for place, (effect, seed) in enumerate(seeds)
        if seed is None and (own := getattr(effect, "seed", None)) is not None
    ]
    for found, where in ((skies, "sky.diffuse"), (bases, "corruption")):
        seen: dict[int, str] = {}
        for part, base in found:
            for seed in range(base, base + SEED_STEP * counts.get(part, 1), SEED_STEP):
                if seed in seen:
                    return [
                        f"realizations: the seed {seed} would be used for {seen[seed]} and for {part} (seeds grow by "
                        f"{SEED_STEP} from one realization to the next); choose other seeds in {where}"
                    ]
                seen[seed] = part
    return []


def described(draw: Sequence[str]) -> str:
    """Describe the draws of a block: ``EoR, gains and noise``."""
    *others, last = ["EoR" if part == "eor" else part for part in draw]
    return f"{', '.join(others)} and {last}" if others else last
