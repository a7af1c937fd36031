"""The line that says what a study calibrates has the numbers of the experiment."""

from pathlib import Path

import pytest

from calstudy.studies.load import load_study


def test_the_line_of_the_paper_is_that_of_the_paper():
    # Ewall-Wice et al. 2022: 36 tiles, 384 channels of 80 kHz, 56 integrations of 2 s, noise of ten times the EoR.
    line = load_study(Path("minredundant")).setup
    for words in ("36 antennas", "384 channels of 80 kHz", "56 integrations of 2 s", "noise 10 times the EoR"):
        assert words in line
    assert line.endswith("; calamity")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("corruption.noise={kind: radiometer, nights: 3}", "thermal noise of 3 nights"),
        ("corruption.effects=[]", "no gains"),
        ("instrument.layout={kind: hex, side: 3, spacing: 10 m}", "19 antennas (hex), baselines to 40 m"),
        ("calibration.calibrator=redcal", "redcal"),
    ],
)
def test_a_change_is_in_the_line(change, words):
    assert words in load_study(Path("quickstart"), overrides=[change]).setup


def test_a_comparison_has_the_data_of_all_worlds_only_if_they_are_the_same():
    assert "antennas" in load_study(Path("unbiased")).setup.split(";")[0]
    assert load_study(Path("calibrators")).setup == ""


def test_the_line_of_measured_data_is_that_of_the_file():
    # hera_qm's file has 19 antennas, of which the study leaves one out, 100 MHz in 1024 channels, and steps of 10.7 s.
    line = load_study(Path("hera19")).setup
    for words in ("18 antennas", "channels of 97.6562 kHz", "3 integrations of 10.7 s", "EoR injected at -30 dB"):
        assert words in line
    without = load_study(Path("hera19"), overrides=["injection=null", "outputs.figures=null"]).setup
    assert "no EoR injected" in without
