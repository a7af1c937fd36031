"""Measured data in folders, and what a plan of measured data refuses before anything is computed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from observations import small_instrument, with_autos
from pyuvdata import UVData

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.feeds import rename_feeds
from calstudy.base.visibilities import antenna_pairs, flag_cube, from_cube, to_cube
from calstudy.instrument.telescope import make_template
from calstudy.products.files import DATA, VISIBILITIES
from calstudy.products.observed import observed, read_observed
from calstudy.realdata import reading
from calstudy.realdata.halves import PARITIES
from calstudy.realdata.noise import radiometer_variance
from calstudy.studies.kinds.observed import ObservedStudy
from calstudy.studies.load import load_study
from calstudy.studies.study import Budget

# Antenna 3 shares no baseline with another pair: redundancy does not tie it to the others.
SCATTERED = "number,east_m,north_m,up_m\n0,0,0,0\n1,14,0,0\n2,28,0,0\n3,3,57,0\n"


def measurement(**changes: object) -> UVData:
    """Random visibilities, in Jy."""
    template = make_template(small_instrument(times={"count": 4, "integration": "10 s"}, **changes))
    generator = np.random.default_rng(16)
    shape = (template.Ntimes, template.Nbls, template.Nfreqs, template.Npols)
    data = from_cube(template, generator.normal(size=shape) + 1j * generator.normal(size=shape))
    data.vis_units = "Jy"
    return data


def study(directory: Path, section: dict, **calibration: object) -> ObservedStudy:
    content = {
        "name": "formats",
        "observed": {"beam": "gaussian", **section},
        "calibration": {"calibrator": "calamity", **calibration},
        "outputs": {"store": str(directory / "store"), "runs": str(directory / "runs")},
    }
    path = directory / "formats.yaml"
    path.write_text(yaml.safe_dump(content))
    found = load_study(path)
    assert isinstance(found, ObservedStudy)
    return found


def halves(folder: Path, name: str) -> dict[str, UVData]:
    """What is read of a data set."""
    graph, found = study(folder, {"data": name}).graph, {}
    for parity in PARITIES:
        output = folder / f"{name}-{parity}"
        output.mkdir()
        observed(graph, parity).make(output)
        found[parity] = UVData.from_file(output / DATA, run_check=False)
    return found


def write_folder(data: UVData, path: Path) -> None:
    """Write data to a folder, in the format of its suffix."""
    if path.suffix == ".ms":
        pytest.importorskip("casacore", reason="the extra [ms] is not installed")
        data.phase_to_time(data.time_array[0])
        data.write_ms(str(path))
    else:
        data.write_miriad(str(path))


# Miriad has variables that other formats lack, which pyuvdata tells.
@pytest.mark.filterwarnings("ignore:writing default values for restfreq:UserWarning")
# pyuvdata 3.2 leaves the SIGMA of samples without weight undefined.
@pytest.mark.filterwarnings("ignore:'where' used without 'out':UserWarning")
@pytest.mark.parametrize("suffix", ["uv", "ms"])
def test_folders_are_read_as_files_are(tmp_path, suffix):
    """Both formats store single precision: 6e-8 of each sample, and 1e-6 after unphasing."""
    data = measurement()
    data.write_uvh5(tmp_path / "data.uvh5")
    write_folder(data, tmp_path / f"data.{suffix}")
    expected, found = halves(tmp_path, "data.uvh5"), halves(tmp_path, f"data.{suffix}")
    for parity in PARITIES:
        assert np.array_equal(antenna_pairs(found[parity]), antenna_pairs(expected[parity]))
        difference = np.abs(to_cube(found[parity]) - to_cube(expected[parity]))
        assert difference.max() < 1e-6 * np.abs(expected[parity].data_array).max()


@pytest.mark.filterwarnings("ignore:writing default values for restfreq:UserWarning")
def test_products_depend_on_what_is_in_a_folder(tmp_path):
    """Reading leaves keys alone, as does the name of the folder; a changed file changes them."""
    path = tmp_path / "data.uv"
    write_folder(measurement(), path)
    keys = [observed(study(tmp_path, {"data": "data.uv"}).graph, "even").key for _ in range(2)]
    renamed = path.rename(tmp_path / "other.uv")
    keys.append(observed(study(tmp_path, {"data": "other.uv"}).graph, "even").key)
    assert len(set(keys)) == 1
    content = (renamed / "history").read_bytes()
    (renamed / "history").write_bytes(content + b"\nflagged by hand\n")
    assert observed(study(tmp_path, {"data": "other.uv"}).graph, "even").key != keys[0]


def test_a_measurement_set_without_its_reader_gets_a_sentence(tmp_path, monkeypatch):
    (tmp_path / "data.ms").mkdir()
    (tmp_path / "data.ms" / "table.dat").touch()
    monkeypatch.setattr(reading, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"reading a measurement set takes python-casacore, .* 'calstudy\[ms\]'"):
        study(tmp_path, {"data": "data.ms"})


@pytest.mark.parametrize(
    ("calibrator", "layout", "modelled", "sentence"),
    [
        ("redcal", None, None, "calibrator = 'redcal': needs a sky model, and there is none"),
        ("unified", None, None, "foreground_prior.mean: 'sky-model' needs a sky model"),
        ("redcal", "scattered.csv", slice(None), "calibrator = 'redcal': redundant"),
        ("redcal", None, slice(0, 5), "calibrator = 'redcal': redundant"),
        ("redcal", None, slice(None), None),
        ("unified", "scattered.csv", slice(None), None),
    ],
)
def test_a_plan_asks_the_calibrator(tmp_path, calibrator, layout, modelled, sentence):
    """With the baselines that the data and the sky model, where there is one, have in common.

    The first five baselines of five antennas on a hexagon's lattice begin at two antennas: too few for redundancy.
    """
    changes = {}
    if layout is not None:
        (tmp_path / layout).write_text(SCATTERED)
        changes = {"layout": {"kind": "csv", "path": str(tmp_path / layout)}, "location": "mwa"}
    data = measurement(**changes)
    data.write_uvh5(tmp_path / "data.uvh5")
    section = {"data": "data.uvh5"}
    if modelled is not None:
        pairs = antenna_pairs(data)[modelled].tolist()
        data.select(bls=[tuple(pair) for pair in pairs], inplace=False).write_uvh5(tmp_path / "sky.uvh5")
        section["sky_model"] = "sky.uvh5"
    # The data have no autocorrelations that tell the noise, which finite priors need to know.
    noise = {"foreground_prior": {"noise": "1 Jy"}} if calibrator == "unified" else {}
    found = study(tmp_path, section, calibrator=calibrator, **noise)
    if sentence is None:
        found.sized_to(Budget(workers=1))
        return
    with pytest.raises(InputError) as caught:
        found.sized_to(Budget(workers=1))
    assert sentence in str(caught.value)


def turned(data: UVData) -> UVData:
    data.conjugate_bls("ant2<ant1")
    return data


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda data: data.select(antenna_nums=data.telescope.antenna_numbers[:-1], inplace=False), "in only one of"),
        (lambda data: data.select(polarizations=["xx"], inplace=False), "polarizations xx and observed.data xx, yy"),
        (turned, r"has the baseline \(1, 0\), and observed.data \(0, 1\); turn"),
        (
            lambda data: data.select(times=np.unique(data.time_array)[1:3], inplace=False),
            "lasts 20 s and observed.data 40",
        ),
    ],
)
def test_odd_data_of_other_samples_are_refused_by_a_plan(tmp_path, change, told):
    data = measurement(polarizations=("xx", "yy"))
    data.write_uvh5(tmp_path / "even.uvh5")
    change(data).write_uvh5(tmp_path / "odd.uvh5")
    with pytest.raises(InputError, match=rf"observed\.odd: .*{told}"):
        study(tmp_path, {"data": "even.uvh5", "odd": "odd.uvh5"})


def test_odd_data_with_samples_that_are_not_used_are_taken(tmp_path):
    """Other antennas that are not selected, and feeds of other names."""
    data = measurement()
    data.select(antenna_nums=data.telescope.antenna_numbers[1:], inplace=False).write_uvh5(tmp_path / "even.uvh5")
    data.polarization_array = np.array([-6])
    data.telescope.set_feeds_from_x_orientation("north", feeds=["x", "y"], polarization_array=np.array([-5, -6]))
    data.write_uvh5(tmp_path / "odd.uvh5")
    section = {"data": "even.uvh5", "odd": "odd.uvh5", "select": {"antennas": "1,2,3,4"}}
    parts = study(tmp_path, section).data
    assert parts.facts["even"].polarizations == parts.facts["odd"].polarizations == (-5,)


def test_antenna_numbers_of_odd_data_are_checked(tmp_path):
    data = measurement()
    data.write_uvh5(tmp_path / "even.uvh5")
    data.telescope.antenna_numbers = data.telescope.antenna_numbers + 900
    data.ant_1_array, data.ant_2_array = data.ant_1_array + 900, data.ant_2_array + 900
    data.baseline_array = data.antnums_to_baseline(data.ant_1_array, data.ant_2_array)
    data.write_uvh5(tmp_path / "odd.uvh5")
    with pytest.raises(InputError, match="antenna number 906 is too large for the estimator"):
        study(tmp_path, {"data": "even.uvh5", "odd": "odd.uvh5"})


def test_gains_of_an_export_are_not_those_of_measured_data(tmp_path):
    measurement().write_uvh5(tmp_path / "data.uvh5")
    with pytest.raises(ExperimentError, match=r"calibration.folder: is for simulated data; .* as calibration.gains"):
        study(tmp_path, {"data": "data.uvh5"}, calibrator="by-file", folder=str(tmp_path))


def test_a_sky_model_of_other_antennas_is_refused(tmp_path):
    measurement().write_uvh5(tmp_path / "data.uvh5")
    sky = measurement(layout={"kind": "mwa-compact-minredundant", "count": 3})
    numbers = sky.telescope.antenna_numbers + 500
    sky.telescope.antenna_numbers = numbers
    sky.ant_1_array, sky.ant_2_array = sky.ant_1_array + 500, sky.ant_2_array + 500
    sky.baseline_array = sky.antnums_to_baseline(sky.ant_1_array, sky.ant_2_array)
    sky.write_uvh5(tmp_path / "sky.uvh5")
    found = study(tmp_path, {"data": "data.uvh5", "sky_model": "sky.uvh5"})
    with pytest.raises(InputError, match=r"observed.sky_model: .* has none of the cross-correlations of the data"):
        found.sized_to(Budget(workers=1))


def test_a_sky_model_without_directions_has_the_feeds_of_the_data(tmp_path):
    data = measurement(polarizations=("xx", "yy"))
    data.telescope.set_feeds_from_x_orientation("north", feeds=["x", "y"])
    data.write_uvh5(tmp_path / "data.uvh5")
    data.telescope.set_feeds_from_x_orientation(None)
    data.write_uvh5(tmp_path / "sky.uvh5")
    graph = study(tmp_path, {"data": "data.uvh5", "sky_model": "sky.uvh5"}).graph
    found, sky, notes = observed(graph, "even").read()
    assert np.array_equal(to_cube(sky), to_cube(found))
    assert "Sky model: The file does not tell the orientation of its feeds; x is taken to be north." in notes


def test_polarizations_of_a_sky_model_are_selected_by_direction(tmp_path):
    """HERA calls the northern feed x, and most simulators the eastern one."""
    data = measurement(polarizations=("xx", "yy"))
    data.write_uvh5(tmp_path / "sky.uvh5")
    rename_feeds(data, "north")
    data.write_uvh5(tmp_path / "data.uvh5")
    section = {"data": "data.uvh5", "sky_model": "sky.uvh5", "select": {"polarizations": "xx"}}
    found, sky, _ = observed(study(tmp_path, section).graph, "even").read()
    assert list(found.polarization_array) == [-6]
    assert np.array_equal(to_cube(sky), to_cube(found))


@pytest.mark.parametrize("autos", [False, True])
def test_samples_that_a_sky_model_lacks_are_flagged(tmp_path, autos):
    """Else the sky would be zero there, and the data all residual."""
    data = measurement()
    sky = data.copy()
    sky.flag_array[:, 3], sky.data_array[:, 3] = True, 0
    sky.select(blt_inds=np.delete(np.arange(sky.Nblts), 2 * sky.Nbls), run_check=False)
    sky.blts_are_rectangular = False
    sky.write_uvh5(tmp_path / "sky.uvh5", run_check=False)
    (with_autos(data, 1e3) if autos else data).write_uvh5(tmp_path / "data.uvh5")
    found, model, notes = observed(study(tmp_path, {"data": "data.uvh5", "sky_model": "sky.uvh5"}).graph, "even").read()
    crosses = np.not_equal(*antenna_pairs(found).T)
    flags = flag_cube(found)
    lacking = flags[:, crosses]
    assert lacking[:, :, 3].all()
    assert lacking[1].all(axis=(1, 2)).sum() == 1
    assert lacking.mean() == pytest.approx(np.mean(to_cube(model)[:, crosses] == 0))
    # Weights may need the autocorrelations, of which a sky model has none.
    assert not flags[:, ~crosses].any()
    assert any("flagged in the sky model, or missing there" in note for note in notes)


CONVENTIONS = ("sum", "avg")


@pytest.mark.parametrize("of_data", [*CONVENTIONS, "uncalib"])
@pytest.mark.parametrize("of_sky", CONVENTIONS)
def test_halves_and_their_sky_model_have_one_convention(tmp_path, of_data, of_sky):
    """The same sky, in Jy of two conventions: I is the sum of both polarizations, or their average."""
    intensity = measurement()
    for name, convention in (("data", of_data), ("sky", of_sky)):
        written = intensity.copy()
        written.data_array = intensity.data_array * (2 if convention == "avg" else 1)
        written.pol_convention = convention
        if convention == "uncalib":
            written.vis_units, written.pol_convention = "uncalib", None
        written.write_uvh5(tmp_path / f"{name}.uvh5")
    task = observed(study(tmp_path, {"data": "data.uvh5", "sky_model": "sky.uvh5"}).graph, "even")
    (tmp_path / "made").mkdir()
    task.make(tmp_path / "made")
    for name in (DATA, VISIBILITIES):
        found = UVData.from_file(tmp_path / "made" / name, run_check=False)
        assert (found.vis_units, found.pol_convention) == ("Jy", "sum")
        np.testing.assert_allclose(found.data_array[: found.Nbls], intensity.data_array[: found.Nbls], rtol=1e-6)


@pytest.mark.parametrize(("said", "factor"), [(None, 1), ("sum", 1), ("avg", 2)])
def test_a_convention_that_a_file_does_not_tell_is_that_of_the_study(tmp_path, said, factor):
    data = measurement()
    data.pol_convention = None
    data.write_uvh5(tmp_path / "data.uvh5")
    section = {"data": "data.uvh5"} | ({} if said is None else {"pol_convention": said})
    measured = study(tmp_path, section)
    assert measured.stand_ins == (("I = XX + YY (pol_convention)",) if said is None else ())
    modelled = study(tmp_path, {**section, "sky_model": "data.uvh5"})
    assert modelled.stand_ins == measured.stand_ins
    found, _, notes = observed(measured.graph, "even").read()
    rows = slice(found.Nbls)
    np.testing.assert_allclose(factor * found.data_array[rows], data.data_array[rows], rtol=1e-6)
    assert any("does not tell" in note for note in notes) == (said is None)


def differently_averaged() -> UVData:
    """Baselines of antenna 0 have half the duration of the others, and twice the samples."""
    data = measurement()
    short = data.ant_1_array == data.telescope.antenna_numbers[0]
    whole, averaged = (data.select(blt_inds=np.flatnonzero(chosen), inplace=False) for chosen in (short, ~short))
    averaged.downsample_in_time(n_times_to_avg=2, allow_drift=True)
    return whole + averaged


def test_copies_of_a_sample_are_not_put_into_both_halves(tmp_path):
    data = differently_averaged()
    data.write_uvh5(tmp_path / "data.uvh5")
    with pytest.raises(InputError, match="alternating integrations would share samples"):
        study(tmp_path, {"data": "data.uvh5"})
    found = study(tmp_path, {"data": "data.uvh5", "difference": "data.uvh5"})
    times = found.data.times("even")
    read, _, _ = observed(found.graph, "even").read()
    # The two samples of a correlator have half the duration of their sum, at its time.
    assert np.array_equal(np.unique(read.time_array), times)
    assert not read.flag_array.any()
    assert np.allclose(read.integration_time, 5.0)


def test_noise_that_flagged_autocorrelations_do_not_tell_is_asked_for(tmp_path):
    data = with_autos(measurement(), 1e3)
    data.flag_array[data.ant_1_array == data.ant_2_array] = True
    data.write_uvh5(tmp_path / "data.uvh5")
    graph = study(tmp_path, {"data": "data.uvh5", "sky_model": "data.uvh5"}, calibrator="unified").graph
    (tmp_path / "made").mkdir()
    observed(graph, "even").make(tmp_path / "made")
    with pytest.raises(InputError, match=r"foreground_prior\.noise: must be given"):
        read_observed(tmp_path / "made", graph.experiment.calibration, True)


def test_sums_and_differences_of_a_correlator_give_back_its_two_samples(tmp_path):
    samples = {parity: measurement() for parity in PARITIES}
    samples["odd"].data_array *= 1j
    samples["odd"].flag_array[5] = True
    sums, differences = samples["even"].copy(), samples["even"].copy()
    for made, sign in ((sums, 1), (differences, -1)):
        made.data_array = samples["even"].data_array + sign * samples["odd"].data_array
    differences.flag_array = samples["odd"].flag_array
    for made, name in ((sums, "sum.uvh5"), (differences, "diff.uvh5")):
        made.write_uvh5(tmp_path / name)
    graph = study(tmp_path, {"data": "sum.uvh5", "difference": "diff.uvh5"}).graph
    for parity, sample in samples.items():
        found, _, _ = observed(graph, parity).read()
        assert np.allclose(to_cube(found), to_cube(sample))
        assert np.allclose(found.integration_time, sample.integration_time / 2)
        assert found.flag_array.sum() == samples["odd"].flag_array.sum()
    later = differences.select(times=np.unique(differences.time_array)[1:], inplace=False)
    later.write_uvh5(tmp_path / "later.uvh5")
    with pytest.raises(InputError, match=r"observed\.difference: its baselines, times"):
        study(tmp_path, {"data": "sum.uvh5", "difference": "later.uvh5"})
    with pytest.raises(ExperimentError, match="leave out one of difference and odd"):
        study(tmp_path, {"data": "sum.uvh5", "difference": "diff.uvh5", "odd": "diff.uvh5"})


def test_the_two_samples_of_hera_differ_by_the_noise_of_their_autocorrelations(tmp_path):
    name = "hera_qm:data/zen.2459122.49827.{}.downselected.uvh5"
    quiet = {"frequencies": "159 MHz..187 MHz", "polarizations": "ee", "lengths": "5 m..75 m"}
    section = {"data": name.format("sum"), "difference": name.format("diff"), "select": quiet}
    section["flux_scale"] = {"kind": "factor", "unit": "1 Jy"}
    even, odd = (observed(study(tmp_path, section).graph, parity).read()[0] for parity in PARITIES)
    pairs = antenna_pairs(even)
    crosses = pairs[:, 0] != pairs[:, 1]
    variance = sum(radiometer_variance(uvd, pairs[crosses], 0) for uvd in (even, odd))
    power = np.abs(to_cube(even) - to_cube(odd))[..., 0][:, crosses] ** 2 / variance
    # A mean of 6072 squares scatters by 0.013; of the whole integration time, or of sums, it would be 2 or more.
    assert np.mean(power) == pytest.approx(1, abs=0.08)
