"""Delay spectra of any estimator: what is stored is what was estimated, and what does not fit is refused."""

import subprocess
import sys
from dataclasses import fields, replace

import h5py
import numpy as np
import pytest
from hera_pspec import UVPSpec

from calstudy.base.errors import InputError
from calstudy.instrument.array_layouts.geometric import GolombLayout
from calstudy.power.interface import Estimator, estimate_spectra, require_antennas, require_modes
from calstudy.power.settings import PowerSettings
from calstudy.power.spectra import DelaySpectra, delay_spectra
from calstudy.power.tables import load_spectrum, save_spectrum


class Spoiled(Estimator):
    """Return spectra with some fields replaced."""

    def estimate(self, even, odd, beam, settings):
        found = PowerSettings().estimator.estimate(even, odd, beam, settings)
        return replace(found, **self._changes) if isinstance(self._changes, dict) else self._changes


def spoiled(changes) -> PowerSettings:
    estimator = Spoiled()
    object.__setattr__(estimator, "_changes", changes)
    return PowerSettings(pairs="same-baseline").model_copy(update={"estimator": estimator})


@pytest.fixture
def data(observe, white, rng):
    template = observe(GolombLayout(kind="golomb", count=3, spacing="14 m"))
    return white(template, rng), white(template, rng)


LENGTHS = np.array([0.0, 3.0, 90.0])
CHANNELS = 167e6 + 80e3 * np.arange(64)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"wedge_buffer": "6.3 us"}, r"power\.wedge_buffer = 6\.3 us: .* shortest baseline has 3 m, .* reach 6\.25 us"),
        ({"bins": {"max": "0.01 h/Mpc", "width": "0.01 h/Mpc"}}, r"power\.bins: no mode .* between 0 and 0\.01 h/Mpc"),
        ({"bins": {"min": "4 h/Mpc", "max": "5 h/Mpc"}}, r"power\.bins: .* are between 0\.\d+ and 3\.\d+ h/Mpc"),
    ],
)
def test_settings_that_leave_no_mode_are_refused(changes, told):
    require_modes(PowerSettings(wedge_buffer="5 us"), LENGTHS, CHANNELS)
    with pytest.raises(InputError, match=told):
        require_modes(PowerSettings(**changes), LENGTHS, CHANNELS)


def test_delay_spectra_are_stored_with_units_and_read_without_hera_pspec(data, beam, tmp_path):
    settings = PowerSettings(pairs="same-baseline")
    found = estimate_spectra(*data, beam, settings, tmp_path)
    save_spectrum(tmp_path / "delay-spectra.h5", found)
    back = load_spectrum(tmp_path / "delay-spectra.h5", DelaySpectra)
    for item in fields(DelaySpectra):
        np.testing.assert_array_equal(getattr(back, item.name), getattr(found, item.name))
        assert type(getattr(back, item.name)) is type(getattr(found, item.name))
    with h5py.File(tmp_path / "delay-spectra.h5") as file:
        assert {name: file[name].attrs["unit"] for name in ("power", "vectors", "delay", "k_perp", "frequency")} == {
            "power": "mK2 h-3 Mpc3",
            "vectors": "m",
            "delay": "s",
            "k_perp": "h/Mpc",
            "frequency": "Hz",
        }
    exported = UVPSpec()
    exported.read_hdf5(str(tmp_path / "pspec.h5"))
    np.testing.assert_array_equal(delay_spectra(exported, settings).power, found.power)
    code = "import sys; from calstudy.products.spectra import read_delay_spectra as read; from pathlib import Path; "
    code += f"read(Path({str(tmp_path)!r})); assert 'hera_pspec' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (None, "returned a NoneType, expected DelaySpectra"),
        ({"k_perp": np.zeros(2)}, r"k_perp has shape \(2,\), expected \(3,\) for 3 units"),
        ({"vectors": np.full((3, 3), np.nan)}, "its vectors is not finite somewhere"),
        ({"taper": "gauss"}, "taper 'gauss' is none of blackman-harris, hann"),
    ],
)
def test_spectra_that_do_not_fit_are_refused(data, beam, changes, told):
    with pytest.raises(InputError, match=rf"estimator 'Spoiled': .*{told}"):
        estimate_spectra(*data, beam, spoiled(changes))


def test_antenna_numbers_that_the_estimator_cannot_take_are_refused_before_the_run():
    numbers = np.array([0, 899])
    require_antennas(PowerSettings(), numbers, "rename them")
    with pytest.raises(InputError, match=r"antenna number 900 is too large .* allowed: 0 to 899; rename them"):
        require_antennas(PowerSettings(), numbers + 1, "rename them")
    require_antennas(spoiled({}), numbers + 1, "rename them")
