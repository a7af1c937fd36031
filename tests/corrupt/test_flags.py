"""Effects that flag data: which samples, and that no flagged sample reaches gains, residuals or spectra."""

from __future__ import annotations

import numpy as np
import pytest
from observations import small_instrument
from plugin_files import make
from scipy.constants import speed_of_light
from tiny import tiny

from calstudy.base.errors import InputError
from calstudy.base.identity import identity
from calstudy.base.observation import Observation
from calstudy.base.visibilities import flag_cube, to_cube
from calstudy.corrupt.effects.additive import Rfi
from calstudy.corrupt.effects.losses import ChannelFlags, DeadAntennas
from calstudy.corrupt.interface import Effect, apply_effect, draw_flags, draw_truth
from calstudy.experiment.files import override, validate
from calstudy.instrument.telescope import make_template
from calstudy.products import agreement, calibration, corruption, signal_loss, spectra
from calstudy.products.files import read_json, read_visibilities
from calstudy.products.graph import Graph
from calstudy.products.selection import read_gains
from calstudy.studies.preflight import require_possible

DEAD, GAPS = 2, [5, 6, 20]


@pytest.fixture(scope="module")
def observed() -> Observation:
    """Seven antennas, 64 channels of 80 kHz as in the paper, 50 integrations, without data."""
    return Observation(make_template(small_instrument(channels={"count": 64, "width": "80 kHz"}, times={"count": 50})))


def flags_of(effect: Effect, observed: Observation) -> np.ndarray:
    """Return the flags of an effect, (Ntimes, Nbls, Nfreqs, Npols)."""
    return np.broadcast_to(draw_flags(effect, observed, draw_truth(effect, observed)), observed.shape)


def test_a_dead_antenna_takes_all_of_its_baselines_and_no_other(observed):
    flags = flags_of(DeadAntennas(antennas=(1, 4)), observed)
    numbers = observed.uvd.telescope.antenna_numbers[[1, 4]]
    expected = [bool({*numbers} & {a, b}) for a, b in observed.pairs.tolist()]
    assert (flags == np.array(expected)[None, :, None, None]).all()
    assert sum(expected) == 11
    drawn = {tuple(draw_truth(DeadAntennas(count=2, seed=seed), observed)["numbers"]) for seed in range(20)}
    assert len(drawn) > 10
    assert all(len(set(pair)) == 2 for pair in drawn)


def test_dead_antennas_that_cannot_be_are_refused(observed):
    with pytest.raises(InputError, match="dead-antennas: antennas: names antenna 7, but there are 7 antennas, counted"):
        draw_truth(DeadAntennas(antennas=(7,)), observed)
    with pytest.raises(InputError, match="count: 5 of 7 antennas would be dead; at most 4 can be, for 3 must be left"):
        draw_truth(DeadAntennas(count=5), observed)


@pytest.mark.parametrize(
    ("effect", "told"),
    [
        (
            {"kind": "dead-antennas", "antennas": [99, 3]},
            "antennas: names antenna 99, but there are 7 antennas, counted",
        ),
        ({"kind": "dead-antennas", "antennas": [0, 1, 2, 3, 4]}, "antennas: 5 of 7 antennas would be dead; at most 4"),
        ({"kind": "dead-antennas", "antennas": [0, 1, 2, 3, 3]}, None),
        (
            {"kind": "dead-antennas", "count": 5},
            "count: 5 of 7 antennas would be dead; at most 4 can be, for 3 must be",
        ),
        ({"kind": "dead-antennas", "count": 4}, None),
        # 64 channels of 80 kHz: the middle ones are centred 2.52 MHz from the ends.
        ({"kind": "channel-flags", "band_edges": "2.6 MHz"}, "band_edges: 2.6 MHz: all 64 channels would be flagged"),
        ({"kind": "channel-flags", "band_edges": "2.6 MHz"}, "; 2.52 MHz at most do not cover the band"),
        ({"kind": "channel-flags", "band_edges": "2.52 MHz", "coarse_width": None}, None),
        (
            {"kind": "channel-flags", "coarse_edges": "640 kHz"},
            " = 'channel-flags': all 64 channels would be flagged by",
        ),
        ({"kind": "channel-flags"}, None),
        ({"kind": "rfi", "channels": "100 %", "duty_cycle": 1}, "channels: 100 % with duty_cycle 100 % and missed 0 %"),
        ({"kind": "rfi", "broadband": "100 %"}, "broadband: 100 % with missed 0 % would flag all samples"),
        ({"kind": "rfi", "channels": "100 %", "duty_cycle": 1, "missed": "1 %"}, None),
        ({"kind": "rfi", "channels": "100 %", "duty_cycle": 0.99}, None),
    ],
)
def test_a_plan_refuses_what_would_fail_or_leave_no_data(effect, told, observed, tmp_path):
    """What it refuses for its flags flags all samples, and what it does not refuse leaves some."""
    instrument = {
        "layout": {"kind": "hex", "side": 2},
        "beam": "gaussian",
        "channels": {"count": 64, "width": "80 kHz"},
        "times": {"count": 50},
    }
    data = {"name": "flagged", "instrument": instrument, "variants": {"noise": {"components": ["noise"]}}}
    settings = {"effects": [{"kind": "per-channel-gains"}, effect]}
    outputs = {"figures": []}
    experiment = validate({**data, "corruption": settings, "outputs": outputs}, tmp_path)
    made = experiment.corruption.effects[1]
    if told is None:
        require_possible(experiment)
        assert not flags_of(made, observed).all()
        return
    with pytest.raises(InputError) as caught:
        require_possible(experiment)
    message = str(caught.value)
    assert told in message
    assert message.startswith(("corruption.effects.1.", "corruption.effects.1 = "))
    if effect["kind"] != "dead-antennas":
        assert flags_of(made, observed).all()


def test_an_effect_of_ones_own_is_asked_too(tmp_path):
    code = """
from calstudy.corrupt.interface import Effect

class Few(Effect):
    most: int = 5

    def refusal(self, size):
        if size.antennas > self.most:
            return f"most: {size.antennas} antennas are too many; at most {self.most}"

    def apply(self, visibilities, observation, truth):
        return visibilities
"""
    (tmp_path / "few.py").write_text(code)
    data = override(tiny(tmp_path), "corruption.effects", [{"kind": "few.py"}])
    with pytest.raises(InputError, match=r"^corruption\.effects\.0\.most: 7 antennas are too many; at most 5$"):
        require_possible(validate(data, tmp_path))
    require_possible(validate(override(data, "corruption.effects.0.most", 7), tmp_path))


def test_the_coarse_channels_of_the_mwa_lose_their_edges_and_centres(observed):
    """Sixteen channels of 80 kHz each: 131 x 1.28 MHz = 167.68 MHz is the first centre, 167.04 the first edge."""
    flags = flags_of(ChannelFlags(), observed)
    assert (flags == flags[:1, :1]).all()
    lost = np.flatnonzero(flags[0, 0, :, 0])
    # The paper's first channel is centred at 167.075 MHz, 5 kHz off the MWA's own: 0.035 MHz from an edge.
    assert lost.tolist() == [0, 8, 15, 16, 24, 31, 32, 40, 47, 48, 56, 63]
    centres = observed.frequencies[lost][lost % 16 == 8]
    assert abs(centres - 1.28e6 * np.round(centres / 1.28e6)).max() <= 40e3
    edges = flags_of(ChannelFlags(coarse_width=None, band_edges="240 kHz"), observed)
    assert np.flatnonzero(edges[0, 0, :, 0]).tolist() == [0, 1, 2, 61, 62, 63]
    assert not flags_of(ChannelFlags(coarse_edges="0 Hz", coarse_centres=False), observed).any()


def test_rfi_occupies_the_channels_and_times_that_are_asked_for():
    instrument = small_instrument(channels={"count": 400, "width": "40 kHz"}, times={"count": 300})
    observed = Observation(make_template(instrument))
    found = draw_truth(Rfi(channels=0.2, duty_cycle=0.3, broadband=0.05, flux="50 Jy", missed=0.25), observed)
    occupied = found["flux"] > 0
    broad = occupied.all(axis=1)
    narrow = occupied[~broad].mean(axis=0)
    # 300 integrations and 400 channels: chances are known to sqrt(p (1 - p) / n).
    assert broad.mean() == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / 300))
    assert (narrow > 0).mean() == pytest.approx(0.2, abs=4 * np.sqrt(0.2 * 0.8 / 400))
    assert narrow[narrow > 0].mean() == pytest.approx(0.3, abs=0.02)
    assert found["flux"][occupied].mean() == pytest.approx(50, rel=0.05)
    flagged = found["flagged"].astype(bool)
    assert not (flagged & ~occupied).any()
    assert flagged[occupied].mean() == pytest.approx(0.75, abs=0.02)


def test_rfi_is_a_plane_wave_along_the_ground(observed):
    effect = Rfi(channels=0.3, duty_cycle=0.5, flux="20 Jy")
    truth = draw_truth(effect, observed)
    added = apply_effect(effect, np.zeros(observed.shape, complex), observed, truth)
    time, channel = np.argwhere(truth["flux"] > 0)[7]
    azimuth = truth["azimuth"][time, channel]
    direction = np.array([np.cos(azimuth), np.sin(azimuth), 0])
    for row, (a, b) in enumerate(observed.antennas):
        delay = (observed.positions[b] - observed.positions[a]) @ direction / speed_of_light
        expected = truth["flux"][time, channel] * np.exp(2j * np.pi * observed.frequencies[channel] * delay)
        assert added[time, row, channel, 0] == pytest.approx(expected, rel=1e-9)
    quiet = np.broadcast_to((truth["flux"] == 0)[:, None, :, None], added.shape)
    assert not added[quiet].any()


FLAGGING = f"""
import numpy as np
from calstudy.corrupt.interface import Effect

class Gaps(Effect):
    def apply(self, visibilities, observation, truth):
        visibilities[:, :, {GAPS}] = 1e6
        return visibilities

    def flags(self, observation, truth):
        flags = np.zeros((1, 1, observation.n_channels, 1), bool)
        flags[:, :, {GAPS}] = True
        return flags

class Wrong(Effect):
    def flags(self, observation, truth):
        return np.zeros(3, bool)
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with a dead antenna and channels that are lost everywhere, with 1e6 Jy in them."""
    folder = tmp_path_factory.mktemp("flags")
    (folder / "gaps.py").write_text(FLAGGING)
    effects = [{"kind": "per-channel-gains"}, {"kind": "gaps.py:Gaps"}, {"kind": "dead-antennas", "antennas": [DEAD]}]
    data = override(tiny(folder), "corruption.effects", effects)
    data = override(data, "outputs.figures", ["gains", "model", "data", "baselines", "signal-loss"])
    graph = Graph(validate(data, folder))
    variants = graph.experiment.variants
    tasks = {
        "solved": calibration.calibration(graph, variants["residual"], "even"),
        "eor": corruption.data(graph, variants["eor"], "even"),
        "average": spectra.average(graph, variants["residual"], "even"),
        "agreement": agreement.agreement(graph),
        "transfer": signal_loss.transfer(graph),
        "spectra": spectra.spectra(graph),
        "power": spectra.power(graph, "residual"),
        "power of eor": spectra.power(graph, "eor"),
    }
    made = make(tasks.values(), folder)
    return graph, {name: made[task.key].path for name, task in tasks.items()}


def expected_flags(uvd) -> np.ndarray:
    """Return the flags of the run, (Ntimes, Nbls, Nfreqs, Npols)."""
    flags = np.zeros(to_cube(uvd).shape, bool)
    flags[:, :, GAPS] = True
    dead = uvd.telescope.antenna_numbers[DEAD]
    flags[:, (uvd.ant_1_array == dead)[: uvd.Nbls] | (uvd.ant_2_array == dead)[: uvd.Nbls]] = True
    return flags


@pytest.mark.chain
def test_flags_reach_gains_residuals_averages_and_data_without_effects(run):
    _, made = run
    for name, file in (("solved", "residual.uvh5"), ("solved", "model.uvh5"), ("eor", "data.uvh5")):
        uvd = read_visibilities(made[name] / file)
        assert (flag_cube(uvd) == expected_flags(uvd)).all()
    average = read_visibilities(made["average"] / "average.uvh5")
    assert (flag_cube(average) == expected_flags(average)).all()
    residual = read_visibilities(made["solved"] / "residual.uvh5")
    assert not to_cube(residual)[expected_flags(residual)].any()
    gains = read_gains(made["solved"])
    assert gains.flags[:, :, GAPS].all()
    assert gains.flags[:, DEAD].all()
    assert not np.delete(np.delete(gains.flags, DEAD, axis=1), GAPS, axis=2).any()


@pytest.mark.chain
def test_what_is_under_flags_changes_nothing(run):
    """1e6 Jy in flagged channels: the solves end, and residual and spectra are of the order of the noise."""
    _, made = run
    # The noise is so low that single precision may not resolve what is left.
    assert set(read_json(made["solved"] / "solution.json")["by_status"]) <= {"converged", "stalled"}
    residual = to_cube(read_visibilities(made["solved"] / "residual.uvh5"))
    eor = to_cube(read_visibilities(made["eor"] / "data.uvh5"))
    # The noise is twice the EoR.
    assert np.std(residual[residual != 0]) < 10 * np.std(eor)
    found = read_json(made["agreement"] / "agreement.json")
    assert found["integrations_without_solution"] == 0
    assert found["measurements"]["residual_over_noise_outside"]["value"] == pytest.approx(1, abs=0.5)
    assert found["measurements"]["product_over_data"]["value"] < 1e-3


@pytest.mark.chain
def test_all_variants_have_the_same_baselines_so_that_spectra_compare(run):
    _, made = run
    residual, eor = (spectra.read_delay_spectra(made[name]) for name in ("power", "power of eor"))
    # Of 21 baselines of seven antennas, 15 are left.
    assert len(residual.vectors) == len(eor.vectors) == 15
    assert (made["transfer"] / "transfer.outside-wedge.h5").is_file()


@pytest.mark.chain
def test_figures_show_a_run_with_flags(run):
    from calstudy.experiment.model import FIGURES
    from calstudy.run.task import Job

    graph, _ = run
    for name in ("gains", "model", "data", "baselines"):
        figure = FIGURES.make(name)
        inputs = figure.inputs(graph)
        made = make(inputs.values(), graph.experiment.outputs.store.parent)
        settings = {**figure.settings(graph), "notes": []}
        job = Job(settings=settings, inputs={key: made[task.key].path for key, task in inputs.items()}, output=None)
        shown = figure.draw(job).shown
        if name in ("gains", "model", "data"):
            assert not shown.residual.values[..., GAPS].any()
            whole = shown.true if name == "gains" else shown.model
            assert abs(shown.residual.values).max() < abs(whole.values).max()


def test_flags_are_part_of_every_variant_and_change_no_key_where_there_are_none(tmp_path):
    def data_of(name, *effects):
        data = override(tiny(tmp_path), "corruption.effects", ["per-channel-gains", *effects])
        graph = Graph(validate(data, tmp_path))
        return corruption.data(graph, graph.experiment.variants[name], "even")

    assert set(data_of("eor").settings) == {"components", "instrument"}
    assert data_of("eor", "crosstalk").key == data_of("eor").key
    assert data_of("eor", "channel-flags").key != data_of("eor").key
    assert [effect["kind"] for effect in identity(data_of("eor", "rfi").settings)["flagged_by"]] == ["rfi"]


def test_flags_of_the_wrong_shape_are_refused(observed, tmp_path):
    (tmp_path / "gaps.py").write_text(FLAGGING)
    effect = Effect.registry.make("gaps.py:Wrong", folder=tmp_path)
    with pytest.raises(InputError, match=r"effect 'Wrong': flags returned an array of bool of shape \(3,\), expected"):
        draw_flags(effect, observed, {})
