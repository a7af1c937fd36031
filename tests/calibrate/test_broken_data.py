"""Broken visibilities and gains through ``calstudy calibrate``: a sentence that names the file or the fault."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import run_and_read, run_command, time_limit
from pyuvdata import UVData
from toy_data import make_uvdata

REFUSED, UNCONVERGED = 2, 3
OPTIONS = ["--buffer", "50 ns", "--set", "basis.min_delay=50 ns", "--overwrite"]


@pytest.fixture(autouse=True)
def no_hang() -> Iterator[None]:
    """Fail what does not end in five minutes: what is not refused takes seconds to calibrate."""
    with time_limit(300):
        yield


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    from toy import make_toy, scattered

    path = tmp_path_factory.mktemp("data") / "good.uvh5"
    make_uvdata(make_toy(scattered(6)), 1).write_uvh5(str(path))
    return path


def complaint(message: str) -> str:
    """Return the one sentence of a refusal."""
    (line,) = [line for line in message.splitlines() if line.startswith("calstudy: ")]
    assert "Traceback" not in message
    return line


def cut(fraction: float) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(path.read_bytes()[: int(fraction * path.stat().st_size)])


def flip(seed: int) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        content = bytearray(path.read_bytes())
        for place in np.random.default_rng(seed).integers(0, min(len(content), 20_000), 40):
            content[place] ^= 0xFF
        path.write_bytes(content)

    return change


def without(name: str) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            del file[name]

    return change


def with_values(name: str, values: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            old = file[name][()]
            del file[name]
            file[name] = values(old)

    return change


FILES: dict[str, Callable[[Path], object]] = {
    **{f"cut to {100 * part:.0f} %": cut(part) for part in (0, 0.001, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99)},
    "text": lambda path: path.write_text("these are not visibilities\n" * 100),
    "noise": lambda path: path.write_bytes(np.random.default_rng(0).bytes(5000)),
    "no header": without("Header"),
    "no data": without("Data"),
    "no visibilities": without("Data/visdata"),
    "no flags": without("Data/flags"),
    "no frequencies": without("Header/freq_array"),
    "no times": without("Header/time_array"),
    "no antennas": without("Header/ant_1_array"),
    "no polarizations": without("Header/polarization_array"),
    "frequencies too few": with_values("Header/freq_array", lambda values: values[:-3]),
    "frequencies not numbers": with_values("Header/freq_array", lambda values: np.array([b"x"] * values.size)),
    "frequencies nan": with_values("Header/freq_array", lambda values: values * np.nan),
    "frequencies zero": with_values("Header/freq_array", lambda values: values * 0),
    "times nan": with_values("Header/time_array", lambda values: values * np.nan),
    "antenna unknown": with_values("Header/ant_1_array", lambda values: values + 1000),
    "visibilities too few": with_values("Data/visdata", lambda values: values[:-1]),
    "visibilities real": with_values("Data/visdata", lambda values: values["r"] if values.dtype.names else values.real),
    "positions nan": with_values("Header/antenna_positions", lambda values: values * np.nan),
}
"""Damage to the file; pyuvdata refuses it in words of its own, which are passed on."""


def with_one(name: str, index: int, value: object) -> Callable[[Path], None]:
    def change(values: np.ndarray) -> np.ndarray:
        values = np.array(values, float)
        values[index] = values[1] if value == "second" else value
        return values

    return with_values(name, change)


IMPLAUSIBLE: dict[str, tuple[Callable[[Path], object], str]] = {
    "frequencies negative": (with_values("Header/freq_array", lambda values: -values), "frequencies of -"),
    "frequencies in MHz": (with_values("Header/freq_array", lambda values: values / 1e6), "they look like MHz"),
    "frequencies in GHz": (with_values("Header/freq_array", lambda values: values / 1e9), "and 1e+12 Hz are allowed"),
    "frequencies far too high": (with_values("Header/freq_array", lambda values: values * 1e9), "are allowed"),
    "one frequency nan": (with_one("Header/freq_array", 3, np.nan), "1 of 64 frequencies are not finite"),
    "one frequency infinite": (with_one("Header/freq_array", 3, np.inf), "1 of 64 frequencies are not finite"),
    "one frequency twice": (with_one("Header/freq_array", 3, "second"), "MHz occurs 2 times; once is allowed"),
    "one frequency zero": (with_one("Header/freq_array", 0, 0.0), "frequencies of 0 to"),
    "channel widths zero": (with_values("Header/channel_width", lambda values: values * 0), "widths of 0 to 0"),
    "channel widths nan": (
        with_values("Header/channel_width", lambda values: values * np.nan),
        "channel widths of nan",
    ),
    "one time nan": (with_one("Header/time_array", 2, np.nan), "cannot be read as visibilities"),
    "durations zero": (
        with_values("Header/integration_time", lambda values: values * 0),
        "integration times of 0 to 0",
    ),
    "durations negative": (with_values("Header/integration_time", lambda values: -values), "times of -"),
    "durations nan": (
        with_values("Header/integration_time", lambda values: values * np.nan),
        "integration times of nan",
    ),
}
"""Numbers that pyuvdata reads, and no telescope writes; what the refusal says."""


@pytest.mark.parametrize("name", IMPLAUSIBLE)
@pytest.mark.filterwarnings("ignore")
def test_implausible_numbers_are_refused_with_the_value_and_what_is_allowed(name, good, tmp_path, capsys):
    path = tmp_path / "data.uvh5"
    path.write_bytes(good.read_bytes())
    change, told = IMPLAUSIBLE[name]
    change(path)
    status, message = run_command(capsys, "calibrate", path, *OPTIONS, "--dry-run", "--output", tmp_path / "out")
    assert status == REFUSED, message
    assert "data.uvh5" in complaint(message)
    assert told in complaint(message)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.filterwarnings("ignore")
def test_a_damaged_file_is_named(name, good, tmp_path, capsys):
    path = tmp_path / "data.uvh5"
    path.write_bytes(good.read_bytes())
    FILES[name](path)
    status, message = run_command(capsys, "calibrate", path, *OPTIONS, "--output", tmp_path / "out")
    assert status == REFUSED, message
    assert "data.uvh5" in complaint(message) or "frequencies" in complaint(message)
    assert not (tmp_path / "out" / "gains.calh5").exists()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.filterwarnings("ignore")
def test_flipped_bytes_of_the_header_never_end_in_a_traceback(seed, good, tmp_path, capsys):
    path = tmp_path / "data.uvh5"
    path.write_bytes(good.read_bytes())
    flip(seed)(path)
    status, message = run_command(capsys, "calibrate", path, *OPTIONS, "--output", tmp_path / "out")
    assert status in (0, REFUSED, UNCONVERGED)
    assert "Traceback" not in message


def all_flagged(uvd: UVData) -> UVData:
    uvd.flag_array[:] = True
    return uvd


def all_nan(uvd: UVData) -> UVData:
    uvd.data_array[:] = np.nan
    return uvd


def some_nan(uvd: UVData) -> UVData:
    uvd.data_array[3, 5:9] = np.nan
    return uvd


def zero(uvd: UVData) -> UVData:
    uvd.data_array[:] = 0
    return uvd


def one_antenna(uvd: UVData) -> UVData:
    uvd.ant_2_array = uvd.ant_1_array.copy()
    uvd.baseline_array = uvd.antnums_to_baseline(uvd.ant_1_array, uvd.ant_2_array)
    uvd.uvw_array[:] = 0
    return uvd.select(blt_inds=[0], inplace=False, run_check=False)


def two_antennas(uvd: UVData) -> UVData:
    return uvd.select(blt_inds=[0], inplace=False, run_check=False)


def crossed_hands(uvd: UVData) -> UVData:
    uvd.polarization_array = np.array([-7])
    return uvd


def pseudo_stokes(uvd: UVData) -> UVData:
    uvd.polarization_array = np.array([1])
    return uvd


def descending(uvd: UVData) -> UVData:
    uvd.reorder_freqs(channel_order="-freq", run_check=False)
    return uvd


def shuffled(uvd: UVData) -> UVData:
    uvd.reorder_freqs(channel_order=np.random.default_rng(1).permutation(uvd.Nfreqs), run_check=False)
    return uvd


def uneven(uvd: UVData) -> UVData:
    uvd.freq_array = uvd.freq_array + uvd.channel_width * np.linspace(0, 9, uvd.Nfreqs) ** 1.5
    return uvd


def one_channel(uvd: UVData) -> UVData:
    return uvd.select(freq_chans=[0], inplace=False, run_check=False)


def one_place(uvd: UVData) -> UVData:
    uvd.telescope.antenna_positions[:] = 0
    uvd.uvw_array[:] = 0
    return uvd


def kilometres(uvd: UVData) -> UVData:
    uvd.telescope.antenna_positions *= 1e6
    return uvd


def huge(uvd: UVData) -> UVData:
    uvd.data_array *= 1e35
    return uvd


REFUSALS: dict[str, tuple[Callable[[UVData], UVData], str]] = {
    "one antenna": (one_antenna, "no cross-correlations"),
    "crossed hands": (crossed_hands, "no parallel hands"),
    "pseudo-Stokes": (pseudo_stokes, "no parallel hands"),
    "one channel": (one_channel, "channels"),
    "uneven channels": (uneven, "even grid"),
    "positions in another unit": (kilometres, "cannot be read as visibilities (antenna positions: "),
}
SKIPPED: dict[str, tuple[Callable[[UVData], UVData], str]] = {
    "all flagged": (all_flagged, "every sample is flagged"),
    "all nan": (all_nan, "every sample is flagged"),
    "zero": (zero, "are exactly zero"),
}
HARMLESS = {
    "some nan": some_nan,
    "two antennas": two_antennas,
    "descending": descending,
    "shuffled channels": shuffled,
    "one place": one_place,
    "huge": huge,
}


def written(good: Path, change: Callable[[UVData], UVData], path: Path) -> Path:
    uvd = change(UVData.from_file(good))
    uvd.write_uvh5(str(path), run_check=False)
    return path


@pytest.mark.parametrize("name", REFUSALS)
@pytest.mark.filterwarnings("ignore")
def test_data_that_cannot_be_calibrated_are_refused_with_the_reason(name, good, tmp_path, capsys):
    change, reason = REFUSALS[name]
    path = written(good, change, tmp_path / "data.uvh5")
    status, message = run_command(capsys, "calibrate", path, *OPTIONS, "--output", tmp_path / "out")
    assert status == REFUSED, message
    assert reason in complaint(message)


@pytest.mark.chain
@pytest.mark.parametrize("name", SKIPPED)
@pytest.mark.filterwarnings("ignore")
def test_data_without_anything_in_them_are_not_said_to_be_calibrated(name, good, tmp_path, capsys):
    change, reason = SKIPPED[name]
    path = written(good, change, tmp_path / "data.uvh5")
    status, message = run_and_read(capsys, "calibrate", path, *OPTIONS, "--output", tmp_path / "out")
    assert status == UNCONVERGED
    assert reason in message.out + message.err


@pytest.mark.slow
@pytest.mark.parametrize("name", HARMLESS)
@pytest.mark.filterwarnings("ignore")
def test_odd_data_are_calibrated_or_refused_but_never_break(name, good, tmp_path, capsys):
    path = written(good, HARMLESS[name], tmp_path / "data.uvh5")
    status, message = run_command(capsys, "calibrate", path, *OPTIONS, "--output", tmp_path / "out")
    assert status in (0, REFUSED, UNCONVERGED)
    assert "Traceback" not in message
    if status == REFUSED:
        complaint(message)


@pytest.mark.parametrize("option", ["--gains", "--sky-model", "--weights"])
@pytest.mark.parametrize("damage", ["text", "cut", "folder", "empty"])
@pytest.mark.filterwarnings("ignore")
def test_other_damaged_inputs_are_named(option, damage, good, tmp_path, capsys):
    path = tmp_path / "other.h5"
    if damage == "folder":
        path.mkdir()
    else:
        content = {"text": b"not this\n", "cut": good.read_bytes()[:3000], "empty": b""}[damage]
        path.write_bytes(content)
    status, message = run_command(capsys, "calibrate", good, *OPTIONS, option, path, "--output", tmp_path / "out")
    assert status == REFUSED, message
    assert "other.h5" in complaint(message)
