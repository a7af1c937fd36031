"""Coupling and crosstalk against their formulas, written out one visibility at a time."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from observations import small_instrument
from scipy.constants import Boltzmann, speed_of_light
from tiny import tiny

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.identity import identity
from calstudy.base.observation import Frame, Observation
from calstudy.corrupt.effects.additive import Crosstalk, MutualCoupling
from calstudy.corrupt.interface import apply_effect, draw_truth
from calstudy.experiment.files import dump, override, validate
from calstudy.instrument.as_built import position_offsets
from calstudy.instrument.layouts import make_layout
from calstudy.instrument.telescope import make_template
from calstudy.products.corruption import read_truth, truths
from calstudy.products.graph import Graph
from calstudy.simulate.source_sums import PairSums
from calstudy.studies.load import load_study


@pytest.fixture(scope="module")
def observed() -> Observation:
    """Seven antennas in a hexagon of 14 m, 16 channels, three integrations, two polarizations, without data."""
    return Observation(make_template(small_instrument(polarizations=["xx", "yy"])))


@pytest.fixture
def cube(observed, rng) -> np.ndarray:
    return rng.normal(size=observed.shape) + 1j * rng.normal(size=observed.shape)


def corrupted(effect, cube, observed) -> np.ndarray:
    return apply_effect(effect, cube.copy(), observed, draw_truth(effect, observed))


@pytest.mark.parametrize("autos", [{}, None])
def test_coupling_is_the_sum_over_all_third_antennas(observed, cube, autos):
    effect = MutualCoupling(amplitude=0.03, falloff=1.5, autos=autos)
    truth = draw_truth(effect, observed)
    found = apply_effect(effect, cube.copy(), observed, truth)
    index = {tuple(pair): row for row, pair in enumerate(observed.antennas.tolist())}
    positions, nu = observed.positions, observed.frequencies

    def coefficient(i, k, channel):
        length = np.linalg.norm(positions[i] - positions[k])
        phase = truth["phase"][i, k] + 2 * np.pi * nu[channel] * length / speed_of_light
        return 0.03 * (14 / length) ** 1.5 * np.exp(1j * phase)

    def visibility(i, j, time, channel, polarization):
        if i == j:
            kelvin = 50 + 180 * (nu[channel] / 180e6) ** -2.6
            return 0 if autos is None else 1e26 * Boltzmann * kelvin / 21.5
        value = cube[time, index[min(i, j), max(i, j)], channel, polarization]
        return value if i < j else value.conjugate()

    antennas = range(observed.n_antennas)
    for place in ((0, 3, 0), (2, 15, 1)):
        for i, j in index:
            expected = (
                visibility(i, j, place[0], *place[1:])
                + sum(coefficient(i, k, place[1]) * visibility(k, j, *place) for k in antennas if k != i)
                + sum(coefficient(j, k, place[1]).conjugate() * visibility(i, k, *place) for k in antennas if k != j)
            )
            assert found[place[0], index[i, j], place[1], place[2]] == pytest.approx(expected, rel=1e-10)


class AllSky:
    """A beam of one everywhere, for the sums of the simulator."""

    n_feeds = 1

    def at(self, azimuth, zenith_angle):
        return np.ones((1, CHANNELS.size, azimuth.size))


CHANNELS = np.linspace(170e6, 172e6, 50)


def test_what_an_antenna_passes_on_arrives_after_what_it_received():
    """A source on the western horizon, three antennas from west to east, and coupling of the first two alone.

    What the first passes on goes along with the direct wave, and reaches the second together with it in every channel.
    What the second passes back reaches the first late by the way there and back, as by a cable of that delay, which
    turns gains and V_ab by exp(2 pi i nu tau) (`calstudy.calibrate.delay_start`).
    """
    positions, pairs = np.array([[0.0, 0, 0], [100, 0, 0], [200, 0, 0]]), np.array([[0, 1], [0, 2], [1, 2]])
    frame = Frame(np.arange(3), positions, pairs, CHANNELS)
    delays, index = positions / speed_of_light, np.zeros(3, int)
    simulator = PairSums(delays, tuple(pairs.T), CHANNELS, [AllSky()], index, np.float64)
    direct = simulator.at(np.array([[-1.0], [0], [0]]), np.zeros(3), np.ones((CHANNELS.size, 1)))
    direct = direct.transpose(2, 0, 1)[None]
    effect = MutualCoupling(amplitude=0.01, autos=None)
    truth = draw_truth(effect, frame)
    truth["phase"][:], truth["modulus"][2], truth["modulus"][:, 2] = 0, 0, 0
    added = apply_effect(effect, direct.copy(), frame, truth) / direct - 1
    np.testing.assert_allclose(added[0, 2, :, 0], truth["modulus"][0, 1], atol=1e-9)
    cable = np.exp(2j * np.pi * CHANNELS * 200 / speed_of_light)
    np.testing.assert_allclose(added[0, 1, :, 0], truth["modulus"][0, 1] * cable, atol=1e-9)


def test_coupling_is_the_first_order_of_voltages_that_antennas_share(observed, rng):
    """v_i + sum_k e_ik v_k correlated: what is left over is of second order in e."""
    samples = 400
    shape = (observed.n_channels, observed.n_antennas, samples)
    voltages = rng.normal(size=shape) + 1j * rng.normal(size=shape) + 2 * rng.normal(size=(shape[0], 1, samples))
    first, second = observed.antennas.T

    def correlated(signals):
        pairs = signals @ signals.conj().swapaxes(1, 2) / samples
        return pairs, np.repeat(pairs[:, first, second].T[None, ..., None], observed.n_times, axis=0)

    left = []
    for amplitude in (1e-3, 1e-4):
        effect = MutualCoupling(amplitude=amplitude, autos=None)
        truth = draw_truth(effect, observed)
        turns = truth["delay"] * observed.frequencies[:, None, None]
        matrix = truth["modulus"] * np.exp(1j * (truth["phase"] + 2 * np.pi * turns))
        pairs, cube = correlated(voltages)
        cube = np.repeat(cube, 2, axis=-1)
        found = apply_effect(effect, cube.copy(), observed, truth)[0, ..., 0]
        # The autocorrelations that the data do not have.
        power = np.einsum("faa->fa", pairs)
        found += (matrix[:, first, second] * power[:, second]).T
        found += (matrix[:, second, first].conj() * power[:, first]).T
        exact = correlated(voltages + matrix @ voltages)[1][0, ..., 0]
        left.append(abs(exact - found).max())
        assert left[-1] < 1e-2 * abs(exact - cube[0, ..., 0]).max()
    assert left[0] == pytest.approx(100 * left[1], rel=1e-3)


def test_coefficients_are_reciprocal_and_arrive_with_the_delay_of_light(observed):
    truth = draw_truth(MutualCoupling(), observed)
    assert truth["phase"] == pytest.approx(truth["phase"].T)
    neighbours = truth["delay"][0][truth["delay"][0] > 0].min()
    assert neighbours == pytest.approx(14 / speed_of_light, rel=1e-6)
    assert truth["modulus"].max() == pytest.approx(1e-3, rel=1e-6)
    assert (truth["modulus"].diagonal() == 0).all()


def test_coupling_needs_all_baselines(observed):
    part = Observation(make_template(small_instrument()).select(ant_str="0_1,0_2,1_3", inplace=False))
    with pytest.raises(InputError, match="mutual-coupling: needs the baselines of all pairs of antennas"):
        corrupted(MutualCoupling(), np.zeros(part.shape, complex), part)


def test_the_area_of_an_mwa_tile_is_not_taken_for_that_of_another_antenna(tmp_path):
    """Autocorrelations go as its inverse: HERA's dish has 4.8 times the area of a tile."""

    def experiment(beam, **coupling):
        data = override(tiny(tmp_path), "instrument.beam", beam)
        effects = [{"kind": "per-channel-gains"}, {"kind": "mutual-coupling", "seed": 6, **coupling}]
        return validate(override(data, "corruption.effects", effects), tmp_path)

    for beam in ("gaussian", {"kind": "airy", "diameter": "14 m"}, "short-dipole"):
        for coupling in ({}, {"autos": {"receiver": "60 K"}}):
            with pytest.raises(
                ExperimentError, match=r"effects\.1\.autos\.effective_area: must be given with the beam"
            ):
                experiment(beam, **coupling)
    given = experiment("gaussian", autos={"effective_area": "21.5 m2"})
    experiment("gaussian", autos=None)
    for beam in ("mwa-embedded-element", "mwa-analytic"):
        coupling = experiment(beam).corruption.effects[1]
        # Given or not, the same number is the same effect: keys and draws do not change.
        assert identity(coupling) == identity(given.corruption.effects[1])
    assert validate(yaml.safe_load(dump(given)), tmp_path) == given
    swept = override(tiny(tmp_path), "instrument.beam", "mwa-analytic")
    swept = override(swept, "corruption.effects", [{"kind": "mutual-coupling", "seed": 6}])
    swept = override(swept, "sweep", {"instrument.beam": ["mwa-analytic", "gaussian"]})
    with pytest.raises(ExperimentError, match="effective_area: must be given with the beam 'gaussian'"):
        load_study_of(swept, tmp_path)


def load_study_of(data, folder):
    (folder / "study.yaml").write_text(yaml.safe_dump(data))
    return load_study(folder / "study.yaml")


def test_crosstalk_is_constant_in_time_with_its_delay_and_its_size():
    instrument = small_instrument(layout={"kind": "hex", "side": 4}, channels={"count": 64, "width": "400 kHz"})
    observed = Observation(make_template(instrument))
    effect = Crosstalk(amplitude="0.2 Jy", delay="700 ns", delay_scatter="20 ns")
    added = corrupted(effect, np.zeros(observed.shape, complex), observed)
    assert (added == added[:1]).all()
    # Each baseline has one size in all channels; 666 baselines.
    size = abs(added[0, ..., 0])
    assert np.ptp(size, axis=1) == pytest.approx(0, abs=1e-12)
    assert np.sqrt(np.mean(size**2)) == pytest.approx(0.2, rel=0.08)
    steps = np.angle(added[0, :, 1:, 0] * added[0, :, :-1, 0].conj()).mean(axis=1)
    # One turn per channel is 2.5 us.
    delays = -steps / (2 * np.pi * 400e3)
    assert delays.mean() == pytest.approx(700e-9, abs=4e-9)
    assert delays.std() == pytest.approx(20e-9, rel=0.12)
    assert abs(np.mean(added[0, :, 0, 0])) < 4 * 0.2 / np.sqrt(len(size))


def test_antennas_couple_over_their_true_distances(tmp_path):
    """The delay of a coefficient is that of the array as built, while the data say the nominal positions."""
    data = tiny(tmp_path)
    data["instrument"] = {**data["instrument"], "as_built": {"positions": {"scatter": "50 cm"}}}
    data["corruption"] = {"effects": [{"kind": "mutual-coupling", "autos": None}]}
    experiment = validate(data, tmp_path)
    [drawn] = truths(Graph(experiment))
    drawn.make(tmp_path)
    enu = make_layout(experiment.instrument.layout).enu
    true = enu + position_offsets(experiment.instrument.as_built.positions, len(enu))
    distances, nominal = (np.linalg.norm(places[:, None] - places, axis=-1) for places in (true, enu))
    assert np.abs(distances - nominal).max() > 0.3
    # Telescope positions are stored geocentric: some nanometres are lost.
    np.testing.assert_allclose(read_truth(tmp_path)["delay"] * speed_of_light, distances, atol=1e-6)
