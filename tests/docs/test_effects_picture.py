"""The picture of effects in docs/effects.md: what each does to foregrounds in delay, and where.

`python tests/docs/test_effects_picture.py` draws the picture again.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from pyuvdata import UVData
from scipy.constants import c
from scipy.signal.windows import blackmanharris

import calstudy
from calstudy.base.visibilities import baseline_vectors, flag_cube, to_cube
from calstudy.plotting import style

pytestmark = pytest.mark.slow
DRAWN = True

PICTURE = Path(__file__).parents[2] / "docs" / "figures" / "effects.png"
EFFECTS: dict[str, dict[str, Any]] = {
    "per-channel-gains, 1 %": {"kind": "per-channel-gains", "sigma": 0.01},
    "bandpass, to 200 ns": {"kind": "bandpass", "sigma": 0.05, "shape": {"kind": "delays", "max_delay": "200 ns"}},
    "reflection-gains, at 1200 ns": {"kind": "reflection-gains"},
    "coarse-channels, of 1.28 MHz": {"kind": "coarse-channels"},
    "mutual-coupling": {"kind": "mutual-coupling", "autos": {"effective_area": "21.5 m2"}},
    "crosstalk": {"kind": "crosstalk"},
    "decoherence, 1 %": {"kind": "decoherence", "loss": "1 %", "per_board": 3, "block": "7.68 MHz"},
    "channel-flags": {"kind": "channel-flags"},
    "rfi": {"kind": "rfi"},
}
LENGTHS = (20.0, 50.0)
"""Of the baselines whose powers are averaged, m."""
CONTENT: dict[str, Any] = {
    "name": "effects",
    "instrument": {
        "layout": {"kind": "mwa-compact-minredundant", "count": 12},
        "beam": {"kind": "airy", "diameter": "14 m"},
        "channels": {"first": "167.075 MHz", "width": "160 kHz", "count": 192},
        "times": {"count": 8, "integration": "10 s"},
    },
    "sky": {"foregrounds": {"count": 500}, "eor": {"nside": 64}},
    "variants": {
        "with": {"components": ["foregrounds"], "effects": True},
        "without": {"components": ["foregrounds"]},
        "eor": {"components": ["eor"]},
    },
}


class Powers(NamedTuple):
    """Mean powers of baselines at delays in ns: by effect, of foregrounds without one, and of the EoR."""

    delay: np.ndarray
    by_effect: dict[str, np.ndarray]
    foregrounds: np.ndarray
    eor: np.ndarray


def delay_power(data: UVData) -> np.ndarray:
    """Return the power of tapered transforms, averaged over baselines and times; flagged samples are zero."""
    lengths = np.linalg.norm(baseline_vectors(data), axis=1)
    chosen = (lengths > LENGTHS[0]) & (lengths < LENGTHS[1])
    cube = np.where(flag_cube(data), 0, to_cube(data))[:, chosen, :, 0]
    spectra = np.fft.fftshift(np.fft.fft(cube * blackmanharris(cube.shape[-1]), axis=-1), axes=-1)
    return np.mean(np.abs(spectra) ** 2, axis=(0, 1))


def measure(folder: Path) -> Powers:
    """Run a small study of each effect; the simulation is that of the first."""
    found, delay = {}, np.array([])
    for name, effect in EFFECTS.items():
        outputs = {"figures": [], "store": str(folder / "store"), "runs": str(folder / "runs")}
        run = calstudy.load({**CONTENT, "outputs": outputs, "corruption": {"effects": [effect]}}).run(workers=1)
        data = run.visibilities("with")
        found[name] = delay_power(data)
        if delay.size == 0:
            delay = np.fft.fftshift(np.fft.fftfreq(data.Nfreqs, float(np.mean(data.channel_width)))) * 1e9
            foregrounds, eor = (delay_power(run.visibilities(variant)) for variant in ("without", "eor"))
    return Powers(delay, found, foregrounds, eor)


@style.journal_style()
def draw(powers: Powers):
    """Draw a panel for each effect, in dB of the largest power without one."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.1, 5.2), layout="constrained")
    grid = figure.subplots(3, 3, sharex=True, sharey=True)
    for axes, (name, power) in zip(grid.flat, powers.by_effect.items(), strict=True):
        for values, colour, label in (
            (powers.eor, style.GREEN, "EoR"),
            (powers.foregrounds, style.GREY, "foregrounds"),
            (power, style.BLUE, "foregrounds with the effect"),
        ):
            decibel = 10 * np.log10(values / powers.foregrounds.max())
            axes.plot(powers.delay, decibel, color=colour, linewidth=0.8, label=label)
        for side in (-1, 1):
            axes.axvline(side * LENGTHS[1] / c * 1e9, color=style.BLACK, linestyle="--", linewidth=0.6)
        axes.set(title=name, xlim=(-2500, 2500), ylim=(-135, 5))
    grid[2, 1].set_xlabel("delay [ns]")
    grid[1, 0].set_ylabel("power in delay [dB]")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


@pytest.fixture(scope="module")
def powers(tmp_path_factory) -> Powers:
    return measure(tmp_path_factory.mktemp("effects"))


def loudest(powers: Powers, name: str, beyond: float = 500) -> float:
    """Return the delay beyond so many ns at which an effect adds most, in ns."""
    added = np.where(np.abs(powers.delay) > beyond, powers.by_effect[name] - powers.foregrounds, 0)
    return float(powers.delay[np.argmax(added)])


def test_effects_appear_at_their_delays(powers):
    assert abs(loudest(powers, "reflection-gains, at 1200 ns")) == pytest.approx(1200, abs=200)
    # 1 / 1.28 MHz.
    assert abs(loudest(powers, "coarse-channels, of 1.28 MHz", 600)) == pytest.approx(781, abs=33)
    # Of one sign: the delay of a leak is that of one receiver after the other.
    crosstalk = powers.by_effect["crosstalk"] - powers.foregrounds
    beyond = np.abs(powers.delay) > 500
    assert crosstalk[beyond & (powers.delay < 0)].sum() > 1e3 * crosstalk[beyond & (powers.delay > 0)].sum()


def test_white_gains_throw_foregrounds_to_all_delays_alike(powers):
    far = powers.by_effect["per-channel-gains, 1 %"][np.abs(powers.delay) > 500]
    # Real and imaginary parts of each antenna's gain scatter by 1 %, so that a product of two has a variance of 4e-4.
    spread = 4e-4 * powers.foregrounds.sum() / powers.delay.size
    assert far.mean() == pytest.approx(spread, rel=0.3)
    assert far.std() < 0.5 * far.mean()


def test_a_smooth_bandpass_and_coupling_stay_near_the_wedge(powers):
    far = np.abs(powers.delay) > 900
    for name, most in (("bandpass, to 200 ns", 2), ("mutual-coupling", 100)):
        assert powers.by_effect[name][far].max() < most * powers.foregrounds[far].max()
        assert powers.by_effect[name][far].max() < 0.1 * powers.eor[far].min()


def test_the_picture_is_drawn(powers, tmp_path):
    draw(powers).savefig(tmp_path / "effects.png", dpi=110)
    assert (tmp_path / "effects.png").stat().st_size < 150_000
    assert PICTURE.is_file()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        draw(measure(Path(scratch))).savefig(PICTURE, dpi=110)
