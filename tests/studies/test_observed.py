"""Measured data as a study: a simulated measurement, written to files, gives what the simulation gives."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from pyuvdata import UVData
from small_chain import small

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.visibilities import antenna_pairs, baseline_vectors, flag_cube, to_cube
from calstudy.experiment.files import validate
from calstudy.instrument.beams import make_beam
from calstudy.instrument.settings import BEAMS, Channels
from calstudy.power.average import fringe_stop_and_average
from calstudy.power.interface import estimate_spectra
from calstudy.power.settings import PowerSettings
from calstudy.power.spectra import SphericalSpectrum
from calstudy.power.tables import load_spectrum
from calstudy.power.transfer import ExpectedBins, TransferFunction
from calstudy.products.files import DATA, MODEL, VISIBILITIES
from calstudy.products.observed import observed as observed_task
from calstudy.products.observed_injection import SetLevel
from calstudy.products.selection import read_gains
from calstudy.realdata.halves import PARITIES
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.load import load_study
from calstudy.studies.study import Budget, Run, run_study

pytestmark = pytest.mark.chain

DRAWN = True

ANTENNAS, TIMES, CHANNELS = 12, 4, 48
# Of one pass: what two fits in passes leave differs by the paths that they take.
CALIBRATION = {"weights": "flags", "prior": "gains", "solver": {"name": "gauss-newton", "max_steps": 500}, "chunks": 1}
EVERYTHING = ["foregrounds", "eor", "noise"]
VARIANTS = {
    "uncalibrated": {"components": EVERYTHING, "effects": True},
    "residual": {"components": EVERYTHING, "effects": True, "calibrate": True},
    "residual_without_eor": {"components": ["foregrounds", "noise"], "effects": True, "calibrate": True},
    "eor": {"components": ["eor"]},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("observed")


@pytest.fixture(scope="module")
def simulated(folder) -> Run:
    data = small(
        folder,
        instrument__layout={"kind": "mwa-compact-minredundant", "count": ANTENNAS},
        instrument__channels={"first": "170 MHz", "width": "400 kHz", "count": CHANNELS},
        instrument__times={"integration": "10 s", "count": TIMES},
        corruption__noise={"kind": "times-eor", "factor": 10},
        calibration=CALIBRATION,
        sky__eor={"nside": 32},
    )
    return run_study(ExperimentStudy(validate({**data, "variants": VARIANTS}, folder)), Budget(workers=1))


def product(run: Run, stage: str, label: str) -> Path:
    return next(
        found.path
        for found in run.made.products.values()
        if (found.record["stage"], found.record["label"]) == (stage, label)
    )


def measurement(run: Run, parity: str, components: str = "foregrounds + eor + noise") -> UVData:
    """One measurement of the simulation, gains and noise included."""
    path = product(run, "corrupt", f"corrupted data ({components} {parity})") / DATA
    return UVData.from_file(path, file_type="uvh5", run_check=False)


def with_autos(run: Run, data: UVData) -> UVData:
    """The data with the autocorrelations that their noise has: sigma^2 = V_aa V_bb / (width x time)."""
    manifest = json.loads((run.folder / "manifest.json").read_text())
    levels = next(item["notes"]["levels_jy"] for item in manifest["products"] if item["stage"] == "levels")
    power = levels["noise_std"] * np.sqrt(data.channel_width[0] * data.integration_time[0])
    gains = read_gains(product(run, "gains", "true gains"))
    telescope, numbers = data.telescope, np.unique(antenna_pairs(data))
    autos = UVData.new(
        telescope=telescope,
        antpairs=np.column_stack([numbers, numbers]),
        times=np.unique(data.time_array),
        freq_array=data.freq_array,
        polarization_array=data.polarization_array,
        integration_time=float(data.integration_time[0]),
        channel_width=float(data.channel_width[0]),
        do_blt_outer=True,
        time_axis_faster_than_bls=False,
        update_telescope_from_known=False,
        vis_units="Jy",
        pol_convention="sum",
        empty=True,
    )
    squares = np.abs(gains.over(data.Ntimes, numbers)) ** 2
    autos.data_array = (power * squares).reshape(autos.data_array.shape).astype(complex)
    autos.history = data.history
    return data.fast_concat(autos, "blt", inplace=False)


def observed_file(folder: Path, name: str, observed: dict, **sections) -> Path:
    content = {
        "name": name,
        "observed": {"beam": "gaussian", **observed},
        "calibration": CALIBRATION,
        "power": {"pairs": "same-baseline", "bins": {"width": "0.1 h/Mpc", "max": "0.8 h/Mpc"}},
        "outputs": {"store": str(folder / "store"), "runs": str(folder / "runs")},
        **sections,
    }
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def spectrum(run: Run, name: str, modes: str = "outside-wedge") -> SphericalSpectrum:
    return load_spectrum(run.folder / "tables" / f"{name}.{modes}.h5", SphericalSpectrum)


@pytest.fixture(scope="module")
def two_files(simulated, folder) -> Run:
    paths = {}
    for parity in ("even", "odd"):
        paths[parity] = folder / f"{parity}.uvh5"
        measurement(simulated, parity).write_uvh5(paths[parity])
    observed = {"data": str(paths["even"]), "odd": str(paths["odd"])}
    return run_study(load_study(observed_file(folder, "two-files", observed)), Budget(workers=1))


@pytest.fixture(scope="module")
def one_file(simulated, folder) -> Run:
    """Interleaved integrations of data without EoR, with autocorrelations; the EoR of the simulation is injected."""
    path = folder / "one.uvh5"
    with_autos(simulated, measurement(simulated, "even", "foregrounds + noise")).write_uvh5(path)
    observed = {"data": str(path)}
    injection = {"eor": {"nside": 32}, "level": "-30 dB", "simulation": {"chunks": 1}}
    return run_study(load_study(observed_file(folder, "one-file", observed, injection=injection)), Budget(workers=1))


@pytest.mark.parametrize("modes", ["all-modes", "outside-wedge"])
@pytest.mark.parametrize(("measured", "variant"), [("data", "uncalibrated"), ("residual", "residual")])
def test_a_simulation_read_as_measured_data_has_the_spectra_of_the_simulation(
    simulated, two_files, measured, variant, modes
):
    """The same numbers go through the same estimator; files hold them in single precision, 6e-8 of each sample."""
    expected, found = spectrum(simulated, variant, modes), spectrum(two_files, measured, modes)
    scale = np.nanmax(np.abs(expected.power))
    np.testing.assert_allclose(found.power, expected.power, atol=1e-6 * scale, rtol=1e-6)
    assert np.isfinite(found.power).sum() >= 5


def test_calibrated_data_are_residual_and_model(two_files):
    """Outside the wedge the model has nothing, inside it nearly everything."""
    calibrated, residual, data = (spectrum(two_files, name, "all-modes") for name in ("calibrated", "residual", "data"))
    assert calibrated.power.real[0] > 1e3 * abs(residual.power.real[0])
    assert calibrated.power.real[0] == pytest.approx(data.power.real[0], rel=0.5)


def test_the_noise_of_the_residual_is_what_was_put_in_less_what_the_fit_takes(one_file):
    """By the difference of the halves over that by the autocorrelations: noise is lost like a white signal.

    Of some 30 delays outside the wedge 15 are independent: each of 66 ratios scatters by 1/4, their mean by 0.03.
    """
    summary = json.loads((one_file.folder / "tables" / "noise.json").read_text())
    expected = load_spectrum(one_file.folder / "tables" / "expected-loss.h5", ExpectedBins)
    modes = spectrum(one_file, "residual").n_modes
    left = np.nansum(modes * expected.outside) / modes.sum()
    assert summary["residual"]["difference_over_autos"]["mean"] == pytest.approx(left, abs=0.1)


def test_chi_squared_per_degree_of_freedom_is_one(one_file):
    """Of noise alone it scatters by sqrt(1 / samples), 1 % here; nothing else is in the data."""
    found = json.loads((one_file.folder / "tables" / "quality.json").read_text())
    for parity in ("even", "odd"):
        part = found[parity]
        baselines = ANTENNAS * (ANTENNAS - 1) // 2
        assert part["samples"] == baselines * CHANNELS * TIMES // 2
        assert 0.2 < part["unknowns"] / part["samples"] < 0.9
        error = 1 / np.sqrt(part["samples"] - part["unknowns"])
        assert part["per_degree_of_freedom"] == pytest.approx(1, abs=5 * error)


def test_integrations_that_were_not_fitted_have_the_chi_squared_of_two_noises(one_file):
    """That of the data, and half that of a fit; what the sky does not linearly in 10 s adds less than the limit."""
    found = json.loads((one_file.folder / "tables" / "quality.json").read_text())
    for parity in ("even", "odd"):
        held = found[parity]["held_out"]
        assert held["samples"] == ANTENNAS * (ANTENNAS - 1) // 2 * CHANNELS * (TIMES // 2 - 1)
        # Of noise with 1.3 times the variance, the mean scatters by 1.3 / sqrt(samples): the limit is four times that.
        assert held["per_sample"] == pytest.approx(held["expected"], abs=5 / np.sqrt(held["samples"]))


def test_the_transfer_function_is_that_of_the_simulation(simulated, one_file):
    """Injected with the fitted gains, T is free of the flux scale; the simulation's is T s^2.

    They are two measurements of one number with the same sky and other noise, each with its error.
    """
    kept, found = (
        load_spectrum(run.folder / "tables" / "transfer-bands.outside-wedge.h5", TransferFunction)
        for run in (simulated, one_file)
    )
    known = np.isfinite(kept.transfer) & np.isfinite(found.transfer)
    assert known.sum() >= 2
    error = np.hypot(kept.scale_free_transfer_error, found.transfer_error)
    difference = np.abs(found.transfer - kept.scale_free_transfer)
    assert (difference[known] < 4 * error[known]).all()
    assert found.transfer[-1] == pytest.approx(1 - 0.17, abs=0.12)


def test_what_the_fit_predicts_is_what_injection_measures(one_file):
    expected = load_spectrum(one_file.folder / "tables" / "expected-loss.h5", ExpectedBins)
    found = load_spectrum(one_file.folder / "tables" / "transfer.outside-wedge.h5", TransferFunction)
    known = np.isfinite(found.transfer_error) & (found.transfer_error > 0)
    pulls = (found.transfer - expected.outside)[known] / found.transfer_error[known]
    assert np.sqrt(np.mean(pulls**2)) < 2.5
    assert known.sum() >= 4


def test_corrected_power_is_the_residual_over_t(one_file):
    with (one_file.folder / "tables" / "residual-corrected.outside-wedge.csv").open() as file:
        rows = list(csv.DictReader(file))
    unit = "[mK2 h-3 Mpc3]"
    corrected = [row for row in rows if row[f"corrected {unit}"] != "nan"]
    assert corrected
    for row in corrected:
        power, transfer = float(row[f"residual {unit}"]), float(row["transfer"])
        assert float(row[f"corrected {unit}"]) == pytest.approx(power / transfer)
        assert float(row[f"corrected error {unit}"]) >= float(row[f"residual error {unit}"]) / transfer


def halves(folder: Path, name: str, observed: dict) -> dict[str, UVData]:
    """What the stage `observe` makes of the data of a file, in this process."""
    graph, found = load_study(observed_file(folder, name, observed)).graph, {}
    for parity in PARITIES:
        output = folder / f"{name}-{parity}"
        output.mkdir(exist_ok=True)
        observed_task(graph, parity).make(output)
        found[parity] = UVData.from_file(output / DATA, run_check=False)
    return found


def power(data: dict[str, UVData]) -> np.ndarray:
    """Delay spectra even x odd."""
    settings = PowerSettings(pairs="same-baseline")
    channels = Channels(first="170 MHz", width="400 kHz", count=CHANNELS)
    averages = [fringe_stop_and_average(data[parity], 2457708.0) for parity in PARITIES]
    return estimate_spectra(*averages, make_beam(BEAMS.make("gaussian"), channels), settings).power


def test_flagged_channels_do_not_enter(simulated, folder):
    """Interference in flagged channels changes nothing, however strong."""
    found = {}
    for name, strength in (("clean", 0.0), ("interference", 1e4)):
        data = measurement(simulated, "even")
        to_cube(data)[:, :, 20:23] += strength
        data.write_uvh5(folder / f"{name}.uvh5")
        observed = {
            "data": f"{name}.uvh5",
            "flag": ["177.9 MHz..178.9 MHz"],
        }
        found[name] = halves(folder, name, observed)
    flags = flag_cube(found["clean"]["even"])
    assert np.flatnonzero(flags.all(axis=(0, 1, 3))).tolist() == [20, 21, 22]
    assert flags.sum() == flags[:, :, 20:23].size
    np.testing.assert_allclose(power(found["clean"]), power(found["interference"]), rtol=1e-12)


@pytest.mark.parametrize("said", [True, {"significance": 8}])
def test_interference_is_flagged_in_both_halves(simulated, folder, said):
    """It is looked for in all integrations together, so that halves have the same channels."""
    data = measurement(simulated, "even")
    to_cube(data)[:, :, 20] += 1e4
    data.write_uvh5(folder / "spoiled.uvh5", clobber=True)
    found = halves(folder, f"spoiled-{said is True}", {"data": "spoiled.uvh5", "flag_interference": said})
    even, odd = (flag_cube(found[parity]).all(axis=(0, 1, 3)) for parity in PARITIES)
    assert even[20]
    np.testing.assert_array_equal(even, odd)
    assert even.mean() < 0.2


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (5, "observed.flag_interference = 5: must be a block of keys"),
        ({"significance": 0.5}, "observed.flag_interference.significance = 0.5"),
        ({"sigma": 5}, "observed.flag_interference.sigma: unknown key"),
    ],
)
def test_a_search_for_interference_that_cannot_be_meant_is_refused(simulated, folder, said, told):
    measurement(simulated, "even").write_uvh5(folder / "refused.uvh5", clobber=True)
    with pytest.raises(ExperimentError) as error:
        halves(folder, "refused", {"data": "refused.uvh5", "flag_interference": said})
    assert told in str(error.value)


def test_a_plan_refuses_to_look_for_interference_in_two_integrations(simulated, folder):
    measurement(simulated, "even").write_uvh5(folder / "short.uvh5", clobber=True)
    observed = {"data": "short.uvh5", "flag_interference": True, "select": {"times": "0..1"}}
    with pytest.raises(InputError, match=r"flag_interference: takes at least 3 integrations.*the data have 2 and 48"):
        load_study(observed_file(folder, "short", observed)).sized_to(Budget())


def test_false_and_null_are_no_search(simulated, folder):
    measurement(simulated, "even").write_uvh5(folder / "as-given.uvh5", clobber=True)
    for said in (False, None):
        study = load_study(observed_file(folder, "as-given", {"data": "as-given.uvh5", "flag_interference": said}))
        assert "interference" not in observed_task(study.graph, "even").settings


def test_feeds_that_are_named_otherwise_are_the_same(simulated, folder):
    """x to the north in the file: its east-west feeds are y, and what was xx is yy."""
    data = measurement(simulated, "even")
    data.write_uvh5(folder / "east.uvh5")
    data.polarization_array = np.array([-6])
    data.telescope.set_feeds_from_x_orientation("north", feeds=["x", "y"], polarization_array=np.array([-5, -6]))
    data.write_uvh5(folder / "north.uvh5")
    east, north = (halves(folder, name, {"data": f"{name}.uvh5"}) for name in ("east", "north"))
    for parity in PARITIES:
        assert north[parity].polarization_array.tolist() == east[parity].polarization_array.tolist() == [-5]
        np.testing.assert_array_equal(north[parity].data_array, east[parity].data_array)


def test_halves_are_every_second_integration(simulated, folder):
    data = measurement(simulated, "even")
    data.write_uvh5(folder / "whole.uvh5")
    found = halves(folder, "whole", {"data": "whole.uvh5"})
    for first, parity in enumerate(PARITIES):
        np.testing.assert_array_equal(to_cube(found[parity]), to_cube(data)[first::2])


def test_data_become_jansky(simulated, folder):
    """By a factor, or so that the autocorrelations are those of the system temperature: k T / A_e."""
    data = with_autos(simulated, measurement(simulated, "even"))
    data.data_array /= 4
    data.vis_units, data.pol_convention = "uncalib", None
    data.write_uvh5(folder / "unit.uvh5")
    with pytest.raises(InputError, match="flux_scale: the data are in 'uncalib'"):
        load_study(observed_file(folder, "no-unit", {"data": "unit.uvh5"}))
    by_factor = halves(folder, "unit", {"data": "unit.uvh5", "flux_scale": {"kind": "factor", "unit": "4 Jy"}})
    for pair in antenna_pairs(data)[::20].tolist():
        expected = 4 * data.get_data(*pair)[::2]
        np.testing.assert_allclose(by_factor["even"].get_data(*pair), expected, rtol=1e-12)
    temperature = {"kind": "system-temperature", "receiver": "100 K", "sky": "0 K"}
    scaled = halves(folder, "temperature", {"data": "unit.uvh5", "flux_scale": temperature})["even"]
    autos = to_cube(scaled).real[:, np.equal(*antenna_pairs(scaled).T)]
    frequencies = np.asarray(scaled.freq_array)
    beam = make_beam(BEAMS.make("gaussian"), Channels(first="170 MHz", width="400 kHz", count=CHANNELS))
    omega, _ = beam.solid_angles(frequencies, "xx")
    expected = 1.380649e-23 * 100 * omega * (frequencies / 299792458.0) ** 2 / 1e-26
    assert np.median(expected[:, None] / autos) == pytest.approx(1, rel=1e-12)


def test_autocorrelations_of_zero_tell_no_scale(simulated, folder):
    """As of antennas that are not connected and not flagged."""
    data = with_autos(simulated, measurement(simulated, "even"))
    temperature = {"kind": "system-temperature", "receiver": "100 K", "sky": "0 K"}
    found = []
    for name, dead in (("alive", 0), ("dead", 30)):
        data.data_array[data.ant_1_array == data.ant_2_array, :dead] = 0
        data.write_uvh5(folder / f"{name}.uvh5")
        scaled = halves(folder, name, {"data": f"{name}.uvh5", "flux_scale": temperature})["even"]
        found.append(scaled.data_array[scaled.ant_1_array != scaled.ant_2_array])
    # The median is of fewer channels, between which the beam differs.
    assert np.abs(found[1]).mean() == pytest.approx(np.abs(found[0]).mean(), rel=0.2)


def test_the_level_of_an_injection_is_relative_to_cross_correlations(simulated, tmp_path):
    model, factors = measurement(simulated, "even"), []
    for name, fitted in (("crosses", model), ("autos", with_autos(simulated, model))):
        (tmp_path / name).mkdir()
        fitted.write_uvh5(tmp_path / name / MODEL)
        model.write_uvh5(tmp_path / name / VISIBILITIES)
        task = SetLevel("level", level=-10.0, eor=tmp_path / name, calibration=tmp_path / name)
        factors.append(task.make(tmp_path / name)["factor"])
    assert factors == pytest.approx([0.1, 0.1])


def test_antennas_get_their_positions(simulated, folder):
    """An array twice as large: baselines twice as long, by metadata and by data alike."""
    data = measurement(simulated, "even")
    data.write_uvh5(folder / "small.uvh5")
    numbers, enu = data.telescope.antenna_numbers, 2 * data.telescope.get_enu_antpos()
    rows = [
        f"{number},{east!r},{north!r},{up!r}" for number, (east, north, up) in zip(numbers, enu.tolist(), strict=True)
    ]
    (folder / "twice.csv").write_text("\n".join(["number,east_m,north_m,up_m", *rows]))
    observed = {"data": "small.uvh5", "positions": "twice.csv"}
    found = halves(folder, "twice", observed)["odd"]
    longest = np.linalg.norm(baseline_vectors(found), axis=1).max()
    assert longest == pytest.approx(2 * np.linalg.norm(baseline_vectors(data), axis=1).max(), rel=1e-9)
    size = load_study(observed_file(folder, "twice", observed)).graph.parts.facts["even"].size(2)
    assert size.longest == pytest.approx(longest, rel=1e-9)


def test_a_second_run_computes_nothing(one_file, folder):
    assert run_study(load_study(folder / "one-file.yaml"), Budget(workers=1)).made.tasks == ()


def test_the_report_has_figures_and_numbers(one_file):
    text = (one_file.folder / "report.html").read_text()
    for figure in ("observed-wedge", "observed-spherical", "observed-signal-loss"):
        assert (one_file.folder / "figures" / f"{figure}.png").is_file()
        assert figure in text
    assert "per degree of freedom" in text
    assert "Signal loss" in text


@pytest.mark.parametrize(
    ("observed", "sections", "sentence"),
    [
        ({"data": "nowhere.uvh5"}, {}, "observed.data.0: 'nowhere.uvh5': no such file or folder"),
        ({"data": "no_such_package:x.uvh5"}, {}, "there is no installed package 'no_such_package'"),
        ({"select": {"frequencies": "140..162"}}, {}, "observed.select.frequencies: '140..162': '140' has no unit"),
        ({"select": {"times": "0..0"}}, {}, "observed.data: 1 integration; two are needed"),
        ({"select": {"frequencies": "170 MHz..171 MHz"}}, {}, "observed.select: 3 channels are left"),
        ({"select": {"frequencies": "1 MHz..2 MHz"}}, {}, "observed.select.frequencies: no channels in this range"),
        ({"flag": ["150"]}, {}, "observed.flag.0: '150'"),
        ({"beam": "no-beam"}, {}, "observed.beam: 'no-beam' is not a beam"),
        ({}, {"calibration": {"integrations_per_solve": 4}}, "a half of the data has 2 integrations"),
        ({}, {"calibration": {"assumed": {"sky.diffuse": "none"}}}, "calibration.assumed: is for simulated data"),
        ({}, {"outputs": {"figures": ["wedge"]}}, "'wedge' is a figure for experiment files, not for observed files"),
        ({}, {"outputs": {"figures": ["observed-signal-loss"]}}, "needs the section injection"),
        ({}, {"injection": {"level": -30}}, "injection.level"),
        ({"positions": "few.csv"}, {}, "has no antenna"),
        ({"positions": "named.csv"}, {}, "named.csv needs a column number, by which antennas are found"),
    ],
)
def test_errors_get_a_sentence(one_file, folder, observed, sections, sentence):
    (folder / "few.csv").write_text("number,east_m,north_m,up_m\n0,0,0,0\n1,10,0,0\n")
    rows = "".join(f"ant{row},{10 * row},0,0\n" for row in range(100))
    (folder / "named.csv").write_text(f"name,east_m,north_m,up_m\n{rows}")
    path = observed_file(folder, "broken", {"data": "one.uvh5", **observed}, **sections)
    with pytest.raises((ExperimentError, InputError)) as caught:
        load_study(path)
    assert sentence in str(caught.value)
