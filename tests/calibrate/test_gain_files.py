"""Gains of DP3, hyperdrive and calibrate: files that are written here restore the data that they calibrate."""

import os
import struct
import subprocess
from importlib.util import find_spec
from urllib.error import URLError

import h5py
import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time
from pyuvdata import UVCal, UVData
from toy import complex_normal, make_toy, scattered
from toy_data import make_uvdata

from calstudy.base.errors import InputError
from calstudy.base.gain_files import read_gain_pair, read_gains, write_gains
from calstudy.base.gains import ErrorsOfFile, draw_gains, make_uvcal
from calstudy.base.observation import Observation
from calstudy.base.visibilities import antenna_indices, from_cube, to_cube
from calstudy.calibrate.calibrators import ddecal
from calstudy.calibrate.calibrators.given_gains import ByFile
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.preparation import starting_gains
from calstudy.corrupt.effects.gains import FileGains
from calstudy.realdata.halves import east_and_north

N_ANTENNAS, N_TIMES, N_SOLUTIONS = 5, 4, 2
FORMATS = ("gains.bin", "gains.fits", "gains.h5")


@pytest.fixture(scope="module")
def world():
    """Data V = g_a g_b* M of two polarizations without noise, M, and gains for the two halves of the run.

    Gains are (Nants, Nfreqs, 2, Npols).
    """
    rng = np.random.default_rng(3)
    toy = make_toy(scattered(N_ANTENNAS), noise=0.0)
    template = make_uvdata(toy, N_TIMES, (-5, -6))
    model = to_cube(template).astype(complex)
    gains = 1 + 0.3 * complex_normal(rng, (N_ANTENNAS, template.Nfreqs, N_SOLUTIONS, 2))
    return from_cube(template, corrupted(template, model, gains)), from_cube(template, model), gains


def corrupted(template, model, gains):
    first, second = antenna_indices(template).T
    each = np.repeat(gains, N_TIMES // gains.shape[2], axis=2)
    return model * np.moveaxis(each[first] * each[second].conj(), 2, 0)


def seconds(uvd):
    """Centres of the integrations, in s of GPS and of MJD, the latter of UTC as in measurement sets."""
    times = Time(np.unique(uvd.time_array), format="jd", scale="utc")
    return times.gps, times.mjd * 86400


def jones(of_file):
    """Matrices that calibrate by J_a V J_b^H, (Ntimes, Nants, Nfreqs, 4): XX, XY, YX, YY."""
    matrices = np.zeros((*np.moveaxis(of_file, 2, 0).shape[:3], 4), complex)
    with np.errstate(invalid="ignore"):
        matrices[..., [0, 3]] = 1 / np.moveaxis(of_file, 2, 0)
    return matrices


def write_bin(path, of_file, uvd, **changes):
    matrices = jones(of_file)
    counts = {"intervals": len(matrices), "antennas": matrices.shape[1], "channels": matrices.shape[2]} | changes
    header = struct.pack("<8s6I2d", b"MWAOCAL", 0, 0, *counts.values(), 4, 0.0, 0.0)
    path.write_bytes(header + matrices.astype("<c16").tobytes())


def write_fits(path, of_file, uvd, optional=True, names=None, times=None):
    matrices = jones(of_file)
    image = np.stack([matrices.real, matrices.imag], axis=-1).reshape(*matrices.shape[:3], 8)
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(image, name="SOLUTIONS")]
    if optional:
        blocks = np.split(seconds(uvd)[0] if times is None else times, len(matrices))
        ends = {"Start": [b[0] for b in blocks], "End": [b[-1] for b in blocks], "Average": [b.mean() for b in blocks]}
        tables = {
            "TIMEBLOCKS": ends,
            "TILES": {"TileName": names or list(uvd.telescope.antenna_names)},
            "CHANBLOCKS": {"Freq": uvd.freq_array},
        }
        for name, columns in tables.items():
            made = [
                fits.Column(key, "20A" if key == "TileName" else "D", array=np.array(values))
                for key, values in columns.items()
            ]
            hdus.append(fits.BinTableHDU.from_columns(made, name=name))
    fits.HDUList(hdus).writeto(path)


def write_h5parm(path, of_file, uvd, axes="time,freq,ant,dir,pol", soltabs=("amplitude", "phase"), polarizations=None):
    """Write amplitude and phase with some axes; those left out must be of length one."""
    times = np.array([block.mean() for block in np.split(seconds(uvd)[1], of_file.shape[2])])
    labels = {
        "ant": np.array(uvd.telescope.antenna_names, "S"),
        "freq": uvd.freq_array,
        "time": times,
        "pol": np.array(polarizations or [b"XX", b"YY"]),
        "dir": np.array([b"pointing"]),
    }
    with h5py.File(path, "w") as file:
        group = file.create_group("sol000")
        group.attrs["h5parm_version"] = np.bytes_(b"1.0")
        for name in soltabs:
            values = np.abs(of_file) if name == "amplitude" else np.angle(of_file)
            letters = "".join(axis[0] for axis in axes.split(","))
            values = np.einsum(f"aftpd->{letters}", values[..., None])
            soltab = group.create_group(f"{name}000")
            for data in ("val", "weight"):
                soltab[data] = np.nan_to_num(values) if data == "val" else np.isfinite(values).astype(np.float32)
                soltab[data].attrs["AXES"] = np.bytes_(axes.encode())
            for axis in axes.split(","):
                soltab[axis] = labels[axis]


WRITERS = dict(zip(FORMATS, (write_bin, write_fits, write_h5parm), strict=True))


def by_file(path, data, sky):
    return run_calibrator(ByFile(gains=path), data, sky)


@pytest.mark.parametrize("name", FORMATS)
def test_gains_found_in_uvfits_files_restore_the_data(world, tmp_path, name):
    """A program sees visibilities as they are in the file; gains that calibrate these must calibrate ours."""
    data, sky, gains = world
    of_run = gains[:, :, :1]
    data = from_cube(data, corrupted(data, to_cube(sky), of_run))
    in_file = {}
    for label, uvd in {"data": data, "sky": sky}.items():
        phased = uvd.copy()
        phased.phase_to_time(phased.time_array[0])
        phased.write_uvfits(str(tmp_path / f"{label}.uvfits"))
        with fits.open(tmp_path / f"{label}.uvfits") as hdus:
            groups = hdus[0].data
            samples = groups.data.squeeze(axis=(1, 2, 3))
            ends = np.stack([groups.par("ANTENNA1"), groups.par("ANTENNA2")]).astype(int)
        in_file[label] = samples[..., 0].astype(complex) + 1j * samples[..., 1]
    first, second = np.searchsorted(data.telescope.antenna_numbers, ends)
    of_file = of_run.conj()
    assert np.allclose(
        in_file["data"],
        of_file[first, :, 0] * of_file[second, :, 0].conj() * in_file["sky"],
        atol=1e-5 * np.abs(in_file["sky"]).max(),  # Single precision.
    )
    WRITERS[name](tmp_path / name, of_file, data)
    result = by_file(tmp_path / name, data, sky)
    assert np.allclose(result.gains.gain_array, of_run, rtol=1e-12)
    assert np.abs(to_cube(result.residual)).max() < 1e-9 * np.abs(to_cube(sky)).max()
    assert not result.gains.flag_array.any()


@pytest.mark.parametrize("name", ["gains.fits", "gains.h5"])
def test_solutions_hold_in_their_times(world, tmp_path, name):
    data, sky, gains = world
    WRITERS[name](tmp_path / name, gains.conj(), data)
    result = by_file(tmp_path / name, data, sky)
    assert np.allclose(result.gains.gain_array, gains.repeat(N_TIMES // N_SOLUTIONS, axis=2), rtol=1e-12)
    # The same if the data come in pieces.
    second = data.select(times=np.unique(data.time_array)[2:], inplace=False)
    result = by_file(tmp_path / name, second, sky.select(times=np.unique(data.time_array)[2:], inplace=False))
    assert np.allclose(result.gains.gain_array, gains[:, :, [1, 1]], rtol=1e-12)
    later = data.copy()
    later.time_array = later.time_array + 60 / 86400
    later.set_lsts_from_time_array()
    with pytest.raises(InputError, match="no solution within half an integration"):
        by_file(tmp_path / name, later, from_cube(later, to_cube(sky)))


def write_calh5(path, of_file, uvd):
    make_uvcal(uvd, of_file.conj()).write_calh5(str(path))


def write_casa(path, of_file, uvd):
    """Write a table, which does not tell where its feeds point."""
    pytest.importorskip("casacore", reason="the extra [ms] is not installed")
    make_uvcal(uvd, of_file.conj()).write_ms_cal(str(path))


@pytest.mark.parametrize("name", [*FORMATS, "gains.calh5", "gains.cal"])
@pytest.mark.parametrize("turned", [True, False])
def test_gains_and_models_are_of_the_feeds_that_they_were_found_for(world, tmp_path, name, turned):
    """Where files call the northern feed x, and where measured data were renamed since."""
    north, sky, gains = (made.copy() for made in world)
    of_run = gains[:, :, :1]
    for uvd in (north, sky):
        uvd.telescope.set_feeds_from_x_orientation("north", feeds=["x", "y"])
    data = from_cube(north, corrupted(north, to_cube(sky), of_run))
    writers = {**WRITERS, "gains.calh5": write_calh5, "gains.cal": write_casa}
    writers[name](tmp_path / name, of_run.conj(), data)
    sky.write_uvh5(tmp_path / "model.uvh5")
    if turned:
        assert east_and_north(data) != []
        # As a product.
        data.write_uvh5(tmp_path / "data.uvh5")
        data = UVData.from_file(tmp_path / "data.uvh5")
    result = run_calibrator(ByFile(gains=tmp_path / name, model=tmp_path / "model.uvh5"), data)
    # CASA stores complex64.
    assert np.abs(to_cube(result.residual)).max() < 1e-6 * np.abs(to_cube(sky)).max()


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_not_known_is_flagged(world, tmp_path, name):
    data, sky, gains = world
    of_file = gains[:, :, :1].conj()
    of_file[1], of_file[:, 7] = np.nan, np.nan
    WRITERS[name](tmp_path / name, of_file, data)
    found = by_file(tmp_path / name, data, sky).gains.flag_array
    expected = np.zeros(found.shape, bool)
    expected[1], expected[:, 7] = True, True
    assert np.array_equal(found, expected)


def test_files_of_hyperdrive_need_only_the_solutions(world, tmp_path):
    """Antennas are then in the order of their numbers, in which telescopes need not have them."""
    data, _, gains = world
    write_fits(tmp_path / "gains.fits", gains[:, :, :1].conj(), data, optional=False)
    shuffled = data.copy()
    order = np.random.default_rng(1).permutation(N_ANTENNAS)
    for name in ("numbers", "names", "positions"):
        attribute = f"antenna_{name}"
        setattr(shuffled.telescope, attribute, np.asarray(getattr(data.telescope, attribute))[order])
    cal = read_gains(tmp_path / "gains.fits", "test", shuffled)
    rows = [list(cal.ant_array).index(number) for number in data.telescope.antenna_numbers]
    assert np.allclose(cal.gain_array[rows], gains[:, :, :1], rtol=1e-12)


@pytest.mark.parametrize("unknown", [0.0, np.nan])
def test_times_that_hyperdrive_does_not_know_are_none(world, tmp_path, unknown):
    """Of one solution, which holds at all times."""
    data, _, gains = world
    write_fits(tmp_path / "gains.fits", gains[:, :, :1].conj(), data, times=np.array([unknown, unknown]))
    cal = read_gains(tmp_path / "gains.fits", "test", data)
    assert np.allclose(cal.gain_array, gains[:, :, :1], rtol=1e-12)


def test_names_of_antennas_decide_over_their_order(world, tmp_path):
    data, _, gains = world
    order = np.random.default_rng(2).permutation(N_ANTENNAS)
    names = [data.telescope.antenna_names[row] for row in order]
    write_fits(tmp_path / "gains.fits", gains[order].conj(), data, names=names)
    cal = read_gains(tmp_path / "gains.fits", "test", data)
    assert np.allclose(cal.gain_array[np.argsort(cal.ant_array)], gains, rtol=1e-12)


def test_axes_of_h5parm_may_lack_and_have_any_order(world, tmp_path):
    """LoSoTo and DP3 write one gain for all polarizations, channels or times without the axis, or phases alone."""
    data, _, gains = world

    def read(name, of_file, **options):
        write_h5parm(tmp_path / name, of_file, data, **options)
        return read_gains(tmp_path / name, "test", data).gain_array

    assert np.allclose(read("order.h5", gains.conj(), axes="pol,ant,time,freq"), gains, rtol=1e-12)
    scalar = gains[..., :1]
    found = read("scalar.h5", scalar.conj(), axes="time,freq,ant")
    assert np.allclose(found, scalar.repeat(2, axis=3), rtol=1e-12)
    phases = np.exp(1j * np.angle(gains[:, :1, :1]))
    found = read("phases.h5", phases.conj(), axes="ant,pol", soltabs=["phase"])
    assert np.allclose(found, phases.repeat(data.Nfreqs, axis=1), rtol=1e-12)


def test_four_polarizations_are_taken_for_the_diagonal(world, tmp_path):
    data, _, gains = world
    full = np.full((*gains.shape[:3], 4), 0.1 + 0j)
    full[..., [0, 3]] = gains.conj()
    write_h5parm(tmp_path / "gains.h5", full, data, polarizations=[b"XX", b"XY", b"YX", b"YY"])
    assert np.allclose(read_gains(tmp_path / "gains.h5", "test", data).gain_array, gains, rtol=1e-12)


@pytest.mark.parametrize("name", FORMATS)
def test_calibrations_start_from_them(world, tmp_path, name):
    data, _, gains = world
    WRITERS[name](tmp_path / name, gains[:, :, :1].conj(), data)
    start = starting_gains(Observation(data), read_gains(tmp_path / name, "test", data))
    assert np.allclose(start, gains[:, :, :1].repeat(N_TIMES, axis=2), rtol=1e-12)
    # Effects on simulated data read them likewise.
    drawn = FileGains(path=tmp_path / name).gains(Observation(data), np.random.default_rng(0))
    assert np.allclose(drawn, gains[:, :, :1], rtol=1e-12)


@pytest.mark.parametrize("name", FORMATS)
def test_they_are_compared_with_gains_that_know_the_telescope(world, tmp_path, name):
    data, _, gains = world
    WRITERS[name](tmp_path / name, gains[:, :, :1].conj(), data)
    make_uvcal(data, gains[:, :, :1]).write_calh5(str(tmp_path / "gains.calh5"))
    paths = tmp_path / name, tmp_path / "gains.calh5"
    for pair in (paths, paths[::-1]):
        first, second = read_gain_pair(*pair)
        assert np.allclose(first.gain_array, second.gain_array, rtol=1e-12)
        assert np.array_equal(first.ant_array, second.ant_array)
        assert np.array_equal(first.freq_array, second.freq_array)
    with pytest.raises(InputError, match="needs the data that it is for; give a CalH5"):
        read_gain_pair(paths[0], paths[0])


def header(magic=b"MWAOCAL", kind=0, counts=(1, N_ANTENNAS, 64, 4), size=None):
    def write(path, of_file, uvd):
        size_of_data = 16 * int(np.prod(counts)) if size is None else size
        path.write_bytes(struct.pack("<8s6I2d", magic, kind, 0, *counts, 0.0, 0.0) + bytes(size_of_data))

    return write


def without_names(path, of_file, uvd):
    write_fits(path, of_file[:4, :, :1], uvd, optional=False)


def other_names(path, of_file, uvd):
    write_fits(path, of_file, uvd, names=[f"Tile{row}" for row in range(N_ANTENNAS)])


def overlapping(path, of_file, uvd):
    write_fits(path, of_file, uvd, times=seconds(uvd)[0][[0, 2, 1, 3]])


def short_table(path, of_file, uvd):
    write_fits(path, of_file[:4], uvd)


def flat_image(path, of_file, uvd):
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.ones((5, 64, 8)), name="SOLUTIONS")]).writeto(path)


def changed(change):
    def write(path, of_file, uvd):
        write_h5parm(path, of_file, uvd)
        with h5py.File(path, "a") as file:
            change(file)

    return write


def as_clock(file):
    for name in ("amplitude000", "phase000"):
        del file["sol000"][name]
    file["sol000"].create_group("clock000")


def other_axis(file):
    file["sol000/phase000/freq"][3] += 1e6


def short_axis(file):
    for name in ("amplitude000", "phase000"):
        labels = file[f"sol000/{name}/freq"][:5]
        del file[f"sol000/{name}/freq"]
        file[f"sol000/{name}/freq"] = labels


def only_data(file):
    del file["sol000"]
    file["sol000"] = np.zeros(3)


def stokes(file):
    for name in ("amplitude000", "phase000"):
        file[f"sol000/{name}/pol"][:] = [b"I", b"V"]


FAULTS = {
    "magic.bin": (header(magic=b"MWAOCAX"), "not a readable file of calibrate .it does not start with MWAOCAL"),
    "kind.bin": (header(kind=1), "its type, structure and polarizations are 1, 0, 4, and not 0, 0, 4"),
    "pols.bin": (header(counts=(1, 5, 64, 2)), "its type, structure and polarizations are 0, 0, 2"),
    "short.bin": (header(size=16), "its header promises .*, of 1 intervals, 5 antennas and 64 channels"),
    "huge.bin": (header(counts=(2**32 - 1,) * 3 + (4,), size=16), "its header promises"),
    "antennas.bin": (header(counts=(1, 6, 64, 4)), "has gains of 6 antennas without names, and the telescope .* has 5"),
    "channels.bin": (header(counts=(1, 5, 32, 4)), "has 32 channels without frequencies, and the data have 64"),
    "times.bin": (write_bin, "has 2 solutions in time and not their times; calibrate all integrations together"),
    "antennas.fits": (without_names, "has gains of 4 antennas without names"),
    "names.fits": (other_names, "the data have no antenna 'Tile0'; their names are ant10, ant12, ant14"),
    "rows.fits": (short_table, "TILES has 5 rows, and SOLUTIONS 4"),
    "overlap.fits": (overlapping, "Some time_ranges overlap"),
    "image.fits": (flat_image, "SOLUTIONS has shape .5, 64, 8., and not .times, tiles, channels, 8"),
    "clock.h5": (changed(as_clock), "it has clock000, and neither amplitude000 nor phase000"),
    "sets.h5": (changed(lambda file: file.copy("sol000", "sol001")), "the solution sets sol000, sol001; one is needed"),
    "axes.h5": (changed(other_axis), "amplitude000 and phase000 have different axes freq"),
    "labels.h5": (changed(short_axis), "labels.h5"),
    "data.h5": (changed(only_data), "not a readable H5Parm file"),
    "stokes.h5": (changed(stokes), "its polarizations are I, V; XX and YY are needed"),
    "text.h5": (lambda path, of_file, uvd: path.write_text("nothing"), "not a readable file of CalH5, calfits, H5Parm"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_sentences(world, tmp_path, name):
    data, sky, gains = world
    write, sentence = FAULTS[name]
    write(tmp_path / name, gains.conj(), data)
    with pytest.raises(InputError, match=sentence):
        by_file(tmp_path / name, data, sky)


def test_a_location_that_cannot_be_fetched_is_named(tmp_path, monkeypatch):
    def fail(*arguments, **options):
        raise URLError("no network")

    monkeypatch.setattr(UVCal, "from_file", fail)
    (tmp_path / "gains.calfits").write_text("")
    with pytest.raises(InputError, match=r"lacks the location of its telescope.*no network"):
        read_gains(tmp_path / "gains.calfits", "test")


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("convention", ["divide", "multiply"])
def test_what_is_written_is_what_is_read(world, tmp_path, name, convention):
    """Also with gains that are flagged, and antennas that have none."""
    data, _, gains = world
    cal = make_uvcal(data, gains[:, :, :1])
    cal.flag_array[2, 5] = True
    if convention == "multiply":
        cal.gain_array, cal.gain_convention = 1 / cal.gain_array, convention
    cal.select(antenna_nums=cal.ant_array[1:])
    write_gains(cal, tmp_path / name)
    found = read_gains(tmp_path / name, "test", data)
    expected = np.isnan(np.full(found.gain_array.shape, 0.0))
    expected[0], expected[2, 5] = True, True
    assert np.array_equal(found.flag_array, expected)
    assert np.allclose(found.gain_array[~expected], gains[:, :, :1][~expected], rtol=1e-12)


@pytest.mark.parametrize("name", ["gains.fits", "gains.h5"])
def test_every_integration_is_written_and_read(world, tmp_path, name):
    data, _, gains = world
    each = gains.repeat(2, axis=2) * (1 + 0.1 * np.arange(N_TIMES)[:, None])
    write_gains(make_uvcal(data, each), tmp_path / name)
    found = read_gains(tmp_path / name, "test", data)
    assert np.allclose(found.gain_array, each, rtol=1e-12)
    centres = found.time_range.mean(axis=1)
    assert np.abs(centres - np.unique(data.time_array)).max() * 86400 < 1e-3


def test_files_of_jones_matrices_are_those_that_are_written_here(world, tmp_path):
    """Byte for byte up to the times in the header, which calibrate leaves zero."""
    data, _, gains = world
    write_gains(make_uvcal(data, gains[:, :, :1]), tmp_path / "ours.bin")
    write_bin(tmp_path / "theirs.bin", gains[:, :, :1].conj(), data)
    ours, theirs = ((tmp_path / name).read_bytes() for name in ("ours.bin", "theirs.bin"))
    assert ours[:32] == theirs[:32]
    assert np.allclose(np.frombuffer(ours[48:], "<c16"), np.frombuffer(theirs[48:], "<c16"), rtol=1e-12)
    start, end = struct.unpack("<2d", ours[32:48])
    assert np.allclose([start, end], seconds(data)[0][[0, -1]], atol=1e-3)
    write_gains(make_uvcal(data, gains[:, :, :1]), tmp_path / "ours.fits")
    write_fits(tmp_path / "theirs.fits", gains[:, :, :1].conj(), data)
    with fits.open(tmp_path / "ours.fits") as ours, fits.open(tmp_path / "theirs.fits") as theirs:
        assert np.allclose(ours["SOLUTIONS"].data, theirs["SOLUTIONS"].data, rtol=1e-12)
        for table, column in (("TILES", "TileName"), ("CHANBLOCKS", "Freq")):
            assert np.array_equal(ours[table].data[column], theirs[table].data[column])


def test_a_jones_matrix_needs_two_feeds(world, tmp_path):
    data, _, gains = world
    one = data.select(polarizations=[-5], inplace=False)
    with pytest.raises(InputError, match=r"has gains of xx and yy, and these are of 1 feed"):
        write_gains(make_uvcal(one, gains[:, :, :1, :1]), tmp_path / "gains.bin")
    with pytest.raises(InputError, match=r"are not written as '.npy'; allowed are .h5, .fits, .bin"):
        write_gains(make_uvcal(one, gains[:, :, :1, :1]), tmp_path / "gains.npy")


def run_dp3(folder, *settings):
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "CASARCFILES": str(folder / "casarc")}
    program = [ddecal._program(), "msin=data.ms", "numthreads=1", *settings]
    subprocess.run(program, cwd=folder, env=environment, check=True, stdout=subprocess.PIPE)


@pytest.mark.skipif(ddecal._program() is None or find_spec("casacore") is None, reason="needs the extra [dp3]")
@pytest.mark.filterwarnings("ignore:'where' used without 'out':UserWarning")
def test_dp3_writes_what_is_read_and_applies_what_is_written(tmp_path):
    """DP3's gains of a measurement set are the true ones; its applycal, with the true ones written here, leaves M."""
    from casacore.tables import table

    toy = make_toy(scattered(N_ANTENNAS), noise=0.0)
    template = make_uvdata(toy, N_TIMES, (-5, -6, -7, -8))
    template.telescope.name = ddecal.TELESCOPE
    gains = 1 + 0.2 * complex_normal(np.random.default_rng(1), (N_ANTENNAS, template.Nfreqs, N_SOLUTIONS, 2))
    values = np.zeros(to_cube(template).shape, complex)
    values[..., :2] = toy.foregrounds[:, :, None]
    model, data = from_cube(template, values), from_cube(template, values.copy())
    to_cube(data)[..., :2] = corrupted(template, values[..., :2], gains)
    for uvd in (data, model):
        uvd.phase(lon=0.0, lat=-0.5, epoch="J2000", cat_name="field", phase_frame="icrs")
    data.write_ms(str(tmp_path / "data.ms"), model_data=model.data_array)
    ddecal._write_observatories(tmp_path)
    settings = "type=ddecal mode=diagonal h5parm=gains.h5 modeldatacolumns=[MODEL_DATA] solint=2 nchan=1 uvlambdamin=0 "
    settings += "maxiter=300 tolerance=1e-7 stepsize=0.5 detectstalling=false"
    run_dp3(tmp_path, "msout=", "steps=[cal]", *(f"cal.{text}" for text in settings.split()))
    found = read_gains(tmp_path / "gains.h5", "test", data)
    assert not found.flag_array.any()
    # The phase of all antennas together is free.
    common = np.sum(gains * found.gain_array.conj(), axis=0)
    # DP3 works in single precision, and stops at changes of 1e-7 when it converges slowly.
    assert np.abs(found.gain_array * common / np.abs(common) - gains).max() < 3e-5
    parallel = data.select(polarizations=[-5, -6], inplace=False)
    write_gains(make_uvcal(parallel, gains.repeat(N_TIMES // N_SOLUTIONS, axis=2)), tmp_path / "true.h5")
    apply = "type=applycal parmdb=true.h5 missingantennabehavior=unit"
    steps = [f"{step}.{text}" for step in "ab" for text in apply.split()]
    corrections = ["a.correction=amplitude000", "b.correction=phase000"]
    run_dp3(tmp_path, "msout=out.ms", "steps=[a,b]", *steps, *corrections)
    restored, expected = (
        table(str(tmp_path / name), ack=False).getcol(column)
        for name, column in (("out.ms", "DATA"), ("data.ms", "MODEL_DATA"))
    )
    assert np.abs(restored - expected).max() < 1e-5 * np.abs(expected).max()


def test_drawn_gains_scatter_by_their_errors(world):
    """A scatter of 400 draws of 32 gains of each antenna is known to 0.6 %."""
    data, _, of_solves = world
    fitted = make_uvcal(data, np.repeat(of_solves, N_TIMES // N_SOLUTIONS, axis=2))
    shape = fitted.gain_array.shape
    amplitude, phase = np.full(shape, 0.02), np.full(shape, 0.01)
    amplitude[1], phase[2] = 0.05, np.nan
    solves = [slice(0, 2), slice(2, 4)]
    errors = ErrorsOfFile(amplitude, phase, smooth_delay=0.0)
    drawn = np.array([draw_gains(fitted, errors, solves, seed).gain_array[:, ::8] for seed in range(400)])
    ratio = drawn / fitted.gain_array[:, ::8]
    np.testing.assert_array_equal(ratio[..., 0, :], ratio[..., 1, :])
    assert np.abs(ratio[..., 1, :] - ratio[..., 2, :]).min() > 0
    sizes = np.std(np.abs(ratio), axis=0) * np.abs(fitted.gain_array[:, ::8])
    np.testing.assert_allclose(sizes[[0, 1, 3, 4]].mean(axis=(1, 2, 3)), [0.02, 0.05, 0.02, 0.02], rtol=0.03)
    np.testing.assert_allclose(np.std(np.angle(ratio), axis=0)[[0, 1]].mean(axis=(1, 2, 3)), 0.01, rtol=0.03)
    assert np.abs(np.angle(ratio[:, 2])).max() < 1e-12
