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
from calstudy.corrupt.effects.channel_flags import ChannelFlags
from calstudy.corrupt.effects.dead_antennas import DeadAntennas
from calstudy.corrupt.effects.rfi import Rfi
from calstudy.corrupt.interface import Effect, apply_effect, draw_flags, draw_truth
from calstudy.experiment.files import override, validate
from calstudy.instrument.telescope import make_template
from calstudy.products import agreement, calibration, corruption, signal_loss, spectra
from calstudy.products.files import read_json, read_visibilities
from calstudy.products.graph import Graph
from calstudy.products.selection import read_gains

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
    with pytest.raises(InputError, match="dead-antennas: antennas has 7, but there are 7, counted from 0"):
        draw_truth(DeadAntennas(antennas=(7,)), observed)
    with pytest.raises(InputError, match="fewer than three antennas would be left"):
        draw_truth(DeadAntennas(count=5), observed)


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


def test_what_is_under_flags_changes_nothing(run):
    """1e6 Jy in flagged channels: the solves converge, and residual and spectra are of the order of the noise."""
    _, made = run
    assert set(read_json(made["solved"] / "solution.json")["by_status"]) == {"converged"}
    residual = to_cube(read_visibilities(made["solved"] / "residual.uvh5"))
    eor = to_cube(read_visibilities(made["eor"] / "data.uvh5"))
    # The noise is twice the EoR.
    assert np.std(residual[residual != 0]) < 10 * np.std(eor)
    found = read_json(made["agreement"] / "agreement.json")
    assert found["integrations_without_solution"] == 0
    assert found["measurements"]["residual_over_noise_outside"]["value"] == pytest.approx(1, abs=0.5)
    assert found["measurements"]["product_over_data"]["value"] < 1e-3


def test_all_variants_have_the_same_baselines_so_that_spectra_compare(run):
    _, made = run
    residual, eor = (spectra.read_delay_spectra(made[name]) for name in ("power", "power of eor"))
    # Of 21 baselines of seven antennas, 15 are left.
    assert len(residual.vectors) == len(eor.vectors) == 15
    assert (made["transfer"] / "transfer.outside-wedge.h5").is_file()


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
