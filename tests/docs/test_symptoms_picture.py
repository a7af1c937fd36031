"""The picture of symptoms in docs/troubleshooting.md: what a calibration shows when something is wrong, and when not.

`python tests/docs/test_symptoms_picture.py` draws the picture again.
"""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1]))
from observations import with_autos

import calstudy
from calstudy.interface import CalibratedData, OpenRun
from calstudy.plotting import style

pytestmark = pytest.mark.slow
DRAWN = True

PICTURE = Path(__file__).parents[2] / "docs" / "figures" / "symptoms.png"
ANTENNAS, FEW = 12, 5
EVERYTHING = ["foregrounds", "eor", "noise"]
BEAM = {"kind": "airy", "diameter": "14 m"}
SPECTRA: dict[str, Any] = {
    "name": "spectra",
    "instrument": {
        "layout": {"kind": "mwa-compact-minredundant", "count": ANTENNAS},
        "beam": BEAM,
        "channels": {"first": "167.075 MHz", "width": "320 kHz", "count": 96},
        "times": {"count": 4, "integration": "10 s"},
    },
    "sky": {"foregrounds": {"count": 500}, "eor": {"nside": 32}},
    "corruption": {"eor_level": "-27 dB", "noise": {"factor": 0.5}},
    "calibration": {"chunks": 1, "weights": "autos"},
    "power": {"bins": {"width": "0.1 h/Mpc", "max": "0.9 h/Mpc"}},
    "variants": {
        "residual": {"components": EVERYTHING, "effects": True, "calibrate": True},
        "eor": {"components": ["eor"]},
    },
}
"""The simulation of power spectra."""
INCOMPLETE = {"calibrator": "sky-based", "weights": "flags", "assumed": {"sky.foregrounds.flux_limit": "10 Jy"}}
CHANGES: dict[str, dict[str, Any]] = {
    "right": {},
    "buffer": {"calibration.basis.buffer": "200 ns"},
    "few": {"instrument.layout.count": FEW},
    "stopped": {"calibration.solver": {"name": "adamax", "max_steps": 150}},
    "sky": {"calibration": {**INCOMPLETE, "chunks": 1}},
}
"""Of the simulation of power spectra, by symptom."""
DATA: dict[str, Any] = {
    "name": "measured",
    "instrument": {
        "layout": {"kind": "hera-19", "count": ANTENNAS},
        "beam": BEAM,
        "channels": {"first": "150 MHz", "width": "240 kHz", "count": 64},
        "times": {"count": 1},
    },
    "sky": {"foregrounds": {"count": 500}, "eor": {"nside": 16}},
    "simulation": {"chunks": 1},
    "variants": {
        "foregrounds": {"components": ["foregrounds"]},
        "measured": {"components": ["foregrounds", "noise"], "effects": True},
        "noise": {"components": ["noise"]},
    },
}
"""The simulation of data that are calibrated."""
BANDPASS = {"kind": "bandpass", "sigma": 0.03}
RFI = {"kind": "rfi", "channels": 0.05, "duty_cycle": 1, "missed": 1, "flux": "300 Jy", "seed": 1}
MOVED = 4
"""Antenna that is not where the sky model has it."""


class Symptom(NamedTuple):
    """What is wrong, and the numbers by which it is seen, beside those of a calibration where nothing is wrong."""

    cause: str
    labels: tuple[str, str]
    limits: tuple[float, float]
    x: np.ndarray
    right: np.ndarray
    wrong: np.ndarray


class Calibrations(NamedTuple):
    """What there is to see: of data, and power spectra of the residual over those of the EoR."""

    data: dict[str, CalibratedData]
    k: np.ndarray
    ratios: dict[str, np.ndarray]


def outputs(folder: Path) -> dict[str, Any]:
    return {"figures": [], "store": str(folder / "store"), "runs": str(folder / "runs")}


def observe(folder: Path, name: str, noise: float, *effects: dict[str, Any], **instrument: Any) -> OpenRun:
    """Simulate data with noise of so many times the rms of foregrounds, and write them with autocorrelations."""
    corruption = {"noise": {"kind": "times-foregrounds", "factor": noise}, "effects": [BANDPASS, *effects]}
    content = {**DATA, "corruption": corruption, "instrument": {**DATA["instrument"], **instrument}}
    run = calstudy.load({**content, "outputs": outputs(folder)}).run(workers=1, quiet=True)
    data, sigma = run.visibilities("measured"), np.std(run.visibilities("noise").data_array)
    # sigma^2 = V_aa V_bb / (channel width x integration time)
    autos = sigma * np.sqrt(data.channel_width[0] * data.integration_time[0])
    with_autos(data, float(autos)).write_uvh5(folder / f"{name}.uvh5")
    return run


def calibrate(folder: Path) -> dict[str, CalibratedData]:
    """Calibrate data in which nothing is wrong, and data in which something is."""
    telescope = observe(folder, "good", 0.01).visibilities("measured").telescope
    rows = [
        [number, *place] for number, place in zip(telescope.antenna_numbers, telescope.get_enu_antpos(), strict=True)
    ]
    rows[MOVED][1] += 2
    table = folder / "two-metres-off.csv"
    np.savetxt(table, rows, fmt="%.4f", delimiter=",", header="number,east_m,north_m,up_m", comments="")
    elsewhere = observe(folder, "elsewhere", 0.01, layout={"kind": "csv", "path": str(table)}, location="hera")
    elsewhere.visibilities("foregrounds").write_uvh5(folder / "model.uvh5")
    observe(folder, "interference", 0.01, RFI)
    observe(folder, "weak", 2)
    observe(folder, "irregular", 0.01, as_built={"positions": {"scatter": "15 cm"}})

    def of(data: str, sky_model: str | None = None, **changes: Any) -> CalibratedData:
        name, settings = "-".join([data, *map(str, changes.values())]), {"weights": "autos", **changes}
        observed = {"sky_model": sky_model}
        path = folder / f"{data}.uvh5"
        return calstudy.calibrate_data(path, folder / name, observed, quiet=True, gain_errors=False, **settings)

    return {
        "right": of("good"),
        # It does not converge with the 500 of the default either.
        "interference": of("interference", **{"solver.max_steps": 100}),
        "noise": of("weak"),
        "position": of("good", str(folder / "model.uvh5"), calibrator="sky-based"),
        "unknowns": of("good", **{"basis.buffer": "1 us"}),
        "baselines": of("irregular"),
        "groups": of("irregular", calibrator="calamity-redundant"),
    }


def quality(found: CalibratedData, name: str) -> np.ndarray:
    """Return numbers of solution.json by which `calstudy calibrate` warns."""
    return np.array(found.solution["quality"][0][name], float)


def measure(folder: Path) -> Calibrations:
    """Run everything; the power spectra have one simulation, but for that of few antennas."""
    ratios = {}
    for name, changes in CHANGES.items():
        run = calstudy.load({**SPECTRA, "outputs": outputs(folder)}, **changes).run(workers=1, quiet=True)
        residual, eor = (run.spectra[variant].power for variant in ("residual", "eor"))
        ratios[name] = (residual.real / eor.real).values
    return Calibrations(calibrate(folder), residual.k.values, ratios)


def symptoms(found: Calibrations) -> list[Symptom]:
    """Return what the panels show, in their order."""
    right = found.data["right"]
    frequency = right.gains.freq_array / 1e6

    def of_data(cause: str, name: str, quantity: str, limits: tuple[float, float]) -> Symptom:
        x, of = (np.arange(ANTENNAS), "antenna") if quantity.endswith("antenna") else (frequency, style.FREQUENCY)
        label = "largest |g| / its median" if quantity.startswith("gain") else r"$\chi^2$ per sample"
        numbers = (quality(data, quantity) for data in (right, found.data[name]))
        return Symptom(cause, (of, label), limits, x, *numbers)

    def of_power(cause: str, name: str, limits: tuple[float, float]) -> Symptom:
        labels = (style.WAVENUMBER, "$P^R$ / $P^S$")
        return Symptom(cause, labels, limits, found.k, found.ratios["right"], found.ratios[name])

    return [
        of_data("interference", "interference", "gain_by_channel", (0.2, 1000)),
        of_data("an antenna not where it should be", "position", "chi2_by_antenna", (0.2, 1000)),
        of_data("hardly any signal to noise", "noise", "gain_by_channel", (0.2, 1000)),
        of_data("nearly as many unknowns as samples", "unknowns", "chi2_by_channel", (0.008, 12)),
        of_data("--redundant, and the array is not", "groups", "chi2_by_channel", (0.008, 12)),
        of_power("a large buffer", "buffer", (0, 1.15)),
        of_power("few antennas", "few", (0, 1.15)),
        of_power("a solver that stops early", "stopped", (0.02, 4000)),
        of_power("a sky model that lacks sources", "sky", (0.02, 4000)),
    ]


@style.journal_style()
def draw(found: Calibrations):
    """Draw a panel for each symptom."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.1, 6.0), layout="constrained")
    grid = figure.subplots(3, 3)
    for letter, axes, symptom in zip("abcdefghi", grid.flat, symptoms(found), strict=True):
        axes.axhline(1, color=style.BLACK, linestyle="--", linewidth=0.6)
        mark = "o" if symptom.labels[0] == "antenna" else None
        for values, colour, label in (
            (symptom.right, style.GREY, "nothing is wrong"),
            (symptom.wrong, style.BLUE, "the symptom"),
        ):
            axes.plot(symptom.x, values, color=colour, label=label, marker=mark)
        axes.set(xlabel=symptom.labels[0], ylabel=symptom.labels[1])
        axes.set(yscale="log" if symptom.limits[0] else "linear", ylim=symptom.limits)
        axes.set_title(f"({letter})  {symptom.cause}", loc="left")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> Calibrations:
    return measure(tmp_path_factory.mktemp("symptoms"))


def test_where_nothing_is_wrong_nothing_stands_out(found):
    right = found.data["right"]
    assert right.solution["warnings"] == []
    assert set(right.solves.status) == {"converged"}
    # Below one, for gains and foregrounds take a part of the samples.
    assert 0.4 < quality(right, "chi2_by_antenna").min() <= quality(right, "chi2_by_antenna").max() < 1


def test_gains_are_high_in_single_channels_by_interference_and_in_many_by_noise(found):
    # From 5 on `calstudy calibrate` warns.
    right, interference, noise = (
        quality(found.data[name], "gain_by_channel") for name in ("right", "interference", "noise")
    )
    assert right.max() < 2
    assert interference.max() > 100
    assert 0 < np.mean(interference > 5) < 0.1
    assert np.mean(noise > 5) > 0.25
    told = {name: " ".join(found.data[name].solution["warnings"]) for name in ("interference", "noise")}
    assert "interference?" in told["interference"]
    assert "noise?" in told["noise"]
    assert "interference?" not in told["noise"]


def test_chi_squared_names_the_antenna_that_is_elsewhere(found):
    chi2 = quality(found.data["position"], "chi2_by_antenna")
    [warning] = found.data["position"].solution["warnings"]
    assert re.findall("antenna (\\w+)", warning) == [found.data["right"].solution["quality"][0]["antennas"][MOVED]]
    # Others share one of their eleven baselines with it.
    assert chi2[MOVED] / np.median(chi2) == pytest.approx(11, rel=0.3)


def test_chi_squared_is_far_below_one_for_many_unknowns_and_above_for_groups_that_are_none(found):
    right, unknowns, baselines, groups = (
        quality(found.data[name], "chi2_by_channel") for name in ("right", "unknowns", "baselines", "groups")
    )
    # Gains and foregrounds of 1 us and more, 2 x 1.1 us x 15 MHz of 64 coefficients, leave less than a third.
    assert np.median(unknowns) < 0.3 * np.median(right)
    assert groups.min() > 2
    # The same data, one model per baseline.
    assert np.median(baselines) == pytest.approx(np.median(right), rel=0.1)


def test_power_is_lost_at_small_k_by_a_buffer_and_everywhere_by_few_antennas(found):
    right, buffer, few = (found.ratios[name] for name in ("right", "buffer", "few"))
    small, large = (found.k > 0.2) & (found.k < 0.3), found.k > 0.6
    assert buffer[small] < 0.3 * right[small]
    assert buffer[large] == pytest.approx(right[large], rel=0.2)
    left = {count: 1 - (2 * count - 1) / (count * (count - 1)) for count in (FEW, ANTENNAS)}
    assert few[large].mean() / right[large].mean() == pytest.approx(left[FEW] / left[ANTENNAS], abs=0.1)


def test_power_is_left_at_small_k_by_a_solver_and_everywhere_by_a_sky_model(found):
    right, stopped, sky = (found.ratios[name] for name in ("right", "stopped", "sky"))
    assert stopped[1] > 5
    assert stopped[found.k > 0.4] == pytest.approx(right[found.k > 0.4], rel=0.1)
    # White gains spread what is missing: no slope over a decade of k.
    assert sky.min() > 100
    assert sky.max() < 10 * sky.min()


def test_the_picture_is_drawn(found, tmp_path):
    draw(found).savefig(tmp_path / "symptoms.png", dpi=110)
    assert (tmp_path / "symptoms.png").stat().st_size < 150_000
    assert PICTURE.is_file()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        draw(measure(Path(scratch))).savefig(PICTURE, dpi=110)
