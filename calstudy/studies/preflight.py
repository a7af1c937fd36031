"""Checks that need antenna positions or beam files, before any long computation starts."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import get_args

import numpy as np

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.errors import InputError
from calstudy.base.files import digest_json
from calstudy.base.identity import identity
from calstudy.base.observation import Frame
from calstudy.base.plugins import guarded
from calstudy.calibrate.execution import require_calibratable
from calstudy.calibrate.interface import Calibrator
from calstudy.calibrate.settings import ForegroundFit
from calstudy.corrupt.interface import require_usable
from calstudy.experiment.assumed import FIELD, SKY_MODEL, assumed_changes, assumed_world
from calstudy.experiment.model import Experiment
from calstudy.instrument.interface import model_of
from calstudy.instrument.layouts import Layout, make_array, make_layout, size_of_instrument
from calstudy.instrument.settings import Channels, InstrumentSettings, nominal_beams
from calstudy.power.interface import require_antennas, require_modes
from calstudy.products.corruption import PARITIES, data
from calstudy.products.graph import Graph
from calstudy.products.sky_model import sky_model
from calstudy.simulate.settings import SimulationSettings
from calstudy.sky.counts import expected_sources
from calstudy.sky.settings import Eor, FileSources, Foregrounds, GleamSources, PointSources, SyntheticSources

LONG_AVERAGE = 15.0
"""Minutes; the sky moves by a sixth of the beam of an MWA tile."""
APERTURE = 5.0
"""Width of antennas, which see multipoles about that of their baseline, m."""
FINEST = max(get_args(Eor.model_fields["nside"].annotation))
"""Largest nside of an EoR."""
SNAPSHOTS = 0.02
"""Of 1 + z: how far coeval boxes of 21cmFAST are apart by default."""


def require_possible(experiment: Experiment) -> None:
    """Raise InputError if a beam or the EoR cannot be made, or an effect or the calibrator refuses the data."""
    require_beams(experiment.instrument)
    _require_small_errors(experiment.instrument)
    _require_eor(experiment.sky.eor, experiment.instrument)
    _require_catalogue(experiment)
    require_usable(experiment.corruption.effects, size_of_instrument(experiment.instrument))
    numbers = make_array(experiment.instrument).numbers
    require_antennas(experiment.power, numbers, "give other numbers in instrument.layout.path")
    frame = frame_of(experiment.instrument)
    require_modes(experiment.power, frame.lengths, frame.frequencies)
    require_calibration(experiment)


def _require_eor(eor: Eor, instrument: InstrumentSettings) -> None:
    """Raise InputError if a table or a box cannot be used for a band, or maps lack what long baselines see."""
    band = instrument.channels.band
    require_fine_maps(eor, frame_of(instrument).lengths, band, "sky.eor")
    if eor.path is None:
        return
    if eor.spectrum == "box":
        from calstudy.sky.boxes import read_box

        read_box(eor.path).part(band)
    else:
        from calstudy.sky.eor import read_power_table

        read_power_table(eor.path)


def _require_catalogue(experiment: Experiment) -> None:
    """Raise InputError if a file of sources, of the data or assumed, cannot be used for the channels."""
    foregrounds = experiment.sky.foregrounds
    if isinstance(foregrounds, FileSources) or (isinstance(foregrounds, GleamSources) and foregrounds.path is not None):
        _kept(foregrounds, experiment.instrument.channels)
    if isinstance(assumed_world(experiment).sky.foregrounds, FileSources):
        _kept_of_assumed(experiment)


def _kept_of_assumed(experiment: Experiment) -> int | None:
    """Return the number of sources that are assumed, as `_kept`; errors name the field of what is assumed."""
    try:
        return _kept(assumed_world(experiment).sky.foregrounds, experiment.instrument.channels)
    except InputError as error:
        raise InputError(f"{FIELD}.{error}") from None


def require_fine_maps(eor: Eor, lengths: np.ndarray, band: tuple[float, float], field: str) -> None:
    """Raise InputError if finer maps of an EoR have what the longest baseline sees; baseline `lengths` are in m.

    Maps of a spectrum that is not flat end at l = 3 nside - 1. Beyond it baselines see replicas of what is below, with
    a sixth to all of the power of the spectrum.
    """
    longest = lengths.max(initial=0.0)
    seen = _multipole(longest, band)
    enough = min(2 ** math.ceil(math.log2((seen + 1) / 3)), FINEST)
    if eor.spectrum != "flat" and eor.nside < enough:
        raise InputError(
            f"{field}.nside = {eor.nside}: maps of a {eor.spectrum} spectrum have multipoles up to {3 * eor.nside - 1} "
            f"and baselines of {longest:.0f} m see those up to {seen:.0f}; give at least {enough}, or spectrum: flat"
        )


def note_of_maps(eor: Eor, lengths: np.ndarray, band: tuple[float, float], field: str) -> str:
    """Say which baselines see more than the finest maps have; an empty text if none does."""
    most = 3 * eor.nside - 1
    if eor.spectrum == "flat" or _multipole(lengths.max(initial=0.0), band) <= most:
        return ""
    resolved = most * SPEED_OF_LIGHT / (2 * math.pi * band[1]) - APERTURE
    return (
        f"{field}.nside = {eor.nside}: maps of a {eor.spectrum} spectrum have multipoles up to {most}; baselines of "
        f"more than {resolved:.0f} m see others, with less than the power of the spectrum"
    )


def _multipole(length: float, band: tuple[float, float]) -> float:
    """Return the largest multipole that a baseline sees at the end of the band; the length is in m."""
    return 2 * math.pi * (length + APERTURE) * band[1] / SPEED_OF_LIGHT


def require_beams(instrument: InstrumentSettings) -> None:
    """Raise InputError if a beam of an instrument cannot be made for its channels."""
    for beam in nominal_beams(instrument):
        with guarded(beam):
            model_of(beam).require_usable(instrument.channels)


def _require_small_errors(instrument: InstrumentSettings) -> None:
    """Raise InputError if antennas are scattered so far that neighbours may change places."""
    scatter, shortest = instrument.as_built.positions.scatter, frame_of(instrument).lengths.min()
    if scatter > shortest / 2 > 0:
        raise InputError(
            f"instrument.as_built.positions.scatter = {scatter:g} m: must be at most half of the shortest baseline of "
            f"{shortest:.3g} m, for it is an error of the positions; give another instrument.layout for another array"
        )


def notes_of(experiment: Experiment) -> tuple[str, ...]:
    """Return sentences on settings that are allowed, but probably a mistake."""
    found = (
        _needless_limit,
        _absent_sources,
        _no_groups,
        _average,
        _needless_chunks,
        _needless_pieces,
        _distant_box,
        _coarse_maps,
    )
    return tuple(note for note in (note(experiment) for note in found) if note)


def _absent_sources(experiment: Experiment) -> str:
    true, assumed = (world.sky.foregrounds for world in (experiment, assumed_world(experiment)))
    if not (isinstance(true, PointSources) and isinstance(assumed, PointSources)) or true.count is None:
        return ""
    more = assumed.count is None or assumed.count > true.count
    if not more or true.with_defaults("count", "errors") != assumed.with_defaults("count", "errors"):
        return ""
    there = _kept(true, experiment.instrument.channels)
    given = math.inf if assumed.count is None else _kept_of_assumed(experiment)
    if there is None or given is None or given <= there:
        return ""
    return (
        f"{FIELD}.sky.foregrounds.count = {assumed.count or 'null'}: the sky has {there} sources, and the sky model of "
        "the calibrator some that are not there; to leave out some, give a smaller number"
    )


def _no_groups(experiment: Experiment) -> str:
    calibration = experiment.calibration
    if not isinstance(calibration, ForegroundFit) or calibration.reference != "calamity-redundant":
        return ""
    vectors, tolerance = frame_of(assumed_world(experiment).instrument).vectors, calibration.redundancy_tolerance
    # Without the library that finds groups, which takes a second to import: baselines of one direction, in the cells of
    # four grids that are shifted by a quarter. In a coordinate, neighbours are in different cells of one grid at most.
    vectors = vectors * np.where(vectors @ [1, 1e-3, 1e-6] < 0, -1, 1)[:, None] / (2 * tolerance)
    shared = any(len(np.unique(np.round(vectors + shift), axis=0)) < len(vectors) for shift in (0, 0.25, 0.5, 0.75))
    if not experiment.calibrates or shared:
        return ""
    return (
        f"calibration.calibrator = 'calamity-redundant': no two baselines are within {tolerance:g} m of each other, so "
        "that each is a group, as with 'calamity'"
    )


def _needless_limit(experiment: Experiment) -> str:
    assumed = assumed_changes(experiment.calibration.assumed)
    limit = "sky.foregrounds.flux_limit"
    if limit not in assumed:
        return ""
    skies = [sky.foregrounds for sky in (experiment.sky, assumed_world(experiment).sky)]
    if len({sky.with_defaults("flux_limit", "count", "errors") for sky in skies if isinstance(sky, PointSources)}) != 1:
        return ""
    kept = _kept(skies[0], experiment.instrument.channels)
    if _kept_of_assumed(experiment) != kept or kept is None:
        return ""
    return f"{FIELD}.{limit} = {str(assumed[limit])!r}: leaves out no source: all {kept} are brighter"


def _require_another_sky(experiment: Experiment) -> None:
    """Raise InputError if all that is assumed is a flux limit, and no source is below it."""
    needless = _needless_limit(experiment)
    if needless and len(assumed_changes(experiment.calibration.assumed)) == 1:
        raise InputError(f"{needless}; give a higher limit, or a smaller {FIELD}.sky.foregrounds.count")


def _needless_chunks(experiment: Experiment) -> str:
    chunks, channels = experiment.simulation.chunks, experiment.instrument.channels.count
    if chunks <= max(channels, SimulationSettings().chunks):
        return ""
    return f"simulation.chunks = {chunks}: the EoR is simulated in {channels} parts, for there are no more channels"


def _needless_pieces(experiment: Experiment) -> str:
    settings, times = experiment.calibration, experiment.instrument.times.count
    solves = math.ceil(times / settings.integrations_per_solve)
    if settings.chunks <= max(solves, type(settings).model_fields["chunks"].default):
        return ""
    return f"calibration.chunks = {settings.chunks}: there are {solves} pieces, one for each solve"


def _average(experiment: Experiment) -> str:
    times, coherent_time = experiment.instrument.times, experiment.power.coherent_time
    minutes = times.count * times.integration / 60
    if coherent_time is not None and coherent_time < times.integration:
        return (
            f"power.coherent_time = {coherent_time:g} s: is shorter than an integration of {times.integration:g} s, so "
            "that each integration is a block of its own"
        )
    if coherent_time is not None or minutes <= LONG_AVERAGE:
        return ""
    return (
        f"power.coherent_time = null: all {minutes:.0f} min are averaged coherently. A sky that drifts through the "
        "beam loses power in it, the EoR as well; such as '10 min' averages the powers of blocks"
    )


def _coarse_maps(experiment: Experiment) -> str:
    instrument = experiment.instrument
    return note_of_maps(experiment.sky.eor, frame_of(instrument).lengths, instrument.channels.band, "sky.eor")


def _distant_box(experiment: Experiment) -> str:
    eor = experiment.sky.eor
    if eor.spectrum != "box" or eor.path is None:
        return ""
    from calstudy.sky.boxes import read_box, redshifts_of

    redshift = read_box(eor.path).redshift
    low, high = redshifts_of(experiment.instrument.channels.band)
    if redshift is None or low - SNAPSHOTS * (1 + low) <= redshift <= high + SNAPSHOTS * (1 + high):
        return ""
    return (
        f"sky.eor.path = {str(eor.path)!r}: a box of redshift {redshift:.2f} for a band of {low:.2f} to {high:.2f}; "
        "its power is used as it is, though it changes with redshift"
    )


def _kept(foregrounds: Foregrounds, channels: Channels) -> int | None:
    """Return the number of kept sources; None if it is not known, for the flux limit and not the count limits it."""
    if isinstance(foregrounds, GleamSources | FileSources):
        return _of_file(foregrounds, channels, digest_json(identity(foregrounds)))
    if not isinstance(foregrounds, SyntheticSources) or foregrounds.count is None:
        return None
    # Several standard deviations of the number drawn, and of the cosmic scatter of bright sources.
    surely = 0.8 * expected_sources(foregrounds.flux_limit) - 100
    return foregrounds.count if surely > foregrounds.count else None


@lru_cache
def _of_file(foregrounds: GleamSources | FileSources, channels: Channels, digest: str) -> int:
    """Return the number of kept sources of a catalogue, whose content has a digest."""
    from calstudy.sky.foregrounds import make_foregrounds

    del digest
    return make_foregrounds(foregrounds, channels.frequencies).sky.Ncomponents


def require_calibration(experiment: Experiment) -> None:
    """Raise InputError if the calibrator refuses the antennas, baselines and channels of an experiment."""
    if experiment.calibrates:
        world = assumed_world(experiment)
        require_beams(world.instrument)
        _require_another_sky(experiment)
        _require_calibrators(experiment)
        places = [(instrument.layout, instrument.site) for instrument in (experiment.instrument, world.instrument)]
        if places[0] != places[1]:
            _require_same_antennas(make_array(experiment.instrument), make_array(world.instrument))


def refusal_of_calibrator(experiment: Experiment) -> str:
    """Return why the calibrator cannot work on the data, or an empty text; InputError if the array cannot be made."""
    make_array(experiment.instrument)
    try:
        _require_calibrators(experiment)
    except InputError as error:
        return str(error)
    return ""


def _require_calibrators(experiment: Experiment) -> None:
    """Raise InputError if the calibrator of any data set refuses it; usually all data sets have the same calibrator."""
    graph, settings = Graph(experiment), experiment.calibration
    asked: dict[int, Calibrator] = {}
    for variant in experiment.variants.values():
        for parity in PARITIES if variant.calibrate else ():
            model = sky_model(graph)
            calibrator = settings.for_data(data(graph, variant, parity).key, model.key if model else None)
            asked[id(calibrator)] = calibrator
    has_model = SKY_MODEL in assumed_changes(settings.assumed) or assumed_world(experiment).sky.has_foregrounds
    for calibrator in asked.values():
        require_calibratable(calibrator, frame_of(experiment.instrument), has_model)


def _require_same_antennas(true: Layout, assumed: Layout) -> None:
    """Raise InputError unless an assumed layout has the antennas of the true one at the same site."""
    field = f"{FIELD}.instrument.layout"
    if len(true.numbers) != len(assumed.numbers):
        raise InputError(
            f"{field}: has {len(assumed.numbers)} antennas; it must have the {len(true.numbers)} of the data"
        )
    different = true.numbers != assumed.numbers
    if different.any():
        raise InputError(
            f"{field}: has antenna {assumed.numbers[different][0]} where the data have {true.numbers[different][0]}; "
            "numbers and their order must be those of the data"
        )
    if true.place != assumed.place:
        raise InputError(f"{field}: is at another site than the data, where the sky is another at the same time")


def frame_of(instrument: InstrumentSettings) -> Frame:
    """Return antennas, baselines and channels of an instrument's data, without autocorrelations."""
    layout, channels = make_layout(instrument.layout), instrument.channels
    order = np.argsort(layout.numbers)
    places = np.argsort(order)
    return Frame(
        layout.numbers[order],
        layout.enu[order],
        places[np.column_stack(np.triu_indices(len(order), 1))],
        channels.frequencies,
        instrument.times.count,
        len(instrument.polarizations),
    )
