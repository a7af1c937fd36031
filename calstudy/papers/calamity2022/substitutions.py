"""Substitutions of an experiment for the paper's own ingredients, printed with all of its results."""

from __future__ import annotations

from calstudy.experiment.model import Experiment
from calstudy.instrument.beam_models.tables import MwaEmbeddedBeam

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
    reductions = []
    if instrument.channels.count < PAPER_CHANNELS:
        reductions.append(f"{instrument.channels.count} of {PAPER_CHANNELS} channels")
    if instrument.times.count < PAPER_TIMES:
        reductions.append(f"{instrument.times.count} of {PAPER_TIMES} integrations")
    antennas = getattr(instrument.layout, "count", None)
    if antennas is not None and antennas < PAPER_ANTENNAS:
        reductions.append(f"{antennas} of {PAPER_ANTENNAS} antennas")
    if experiment.sky.eor.nside < PAPER_NSIDE:
        reductions.append(f"EoR nside {experiment.sky.eor.nside} of {PAPER_NSIDE}")
    sources = getattr(experiment.sky.foregrounds, "count", None)
    if sources is not None:
        reductions.append(f"the {sources} brightest sources")
    return f"reduced scale: {', '.join(reductions)}" if reductions else None


def substitutions(experiment: Experiment) -> tuple[str, ...]:
    """Return one short sentence per substitution of the experiment, empty if all ingredients are the paper's."""
    return tuple(note for note in (_sky(experiment), _beam(experiment), _scale(experiment)) if note)
