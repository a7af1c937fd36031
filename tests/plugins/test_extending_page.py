"""Every example of docs/extending*.md is run as it is printed: each section is one kind of thing."""

from __future__ import annotations

import re

import numpy as np
import pytest
import yaml
from observations import small_instrument
from plugin_files import sections
from tiny import tiny

from calstudy.base.observation import Observation
from calstudy.base.plugins import Registry
from calstudy.base.visibilities import from_cube, to_cube
from calstudy.calibrate.interface import CALIBRATORS, Assumed
from calstudy.figures import StudyFigure
from calstudy.instrument.layouts import ArrayLayout
from calstudy.instrument.telescope import make_template
from calstudy.interface import open_run
from calstudy.run.execution import Budget
from calstudy.studies.load import load_study
from calstudy.studies.reference import plugin_reference
from calstudy.studies.study import run_study

# These change what is calibrated, and share nothing of it with other examples: one variant goes all the way.
ALONE = ("A layout", "A beam", "An engine", "An effect", "An effect on gains", "A calibrator")
FEWEST_VARIANTS = {
    "residual": {"components": ["foregrounds", "eor", "noise"], "effects": True, "calibrate": True},
    "eor": {"components": ["eor"]},
}
MOST_LINES = 40


def merged(base: dict | str, changes: dict) -> dict:
    """Return a block with changes, block by block; a name alone and a block of another kind are replaced."""
    kinds = ("kind", "calibrator")
    if isinstance(base, str) or any(base.get(kind) != changes.get(kind, base.get(kind)) for kind in kinds):
        base = {}
    return {
        **base,
        **{
            key: merged(base.get(key, {}), value) if isinstance(value, dict) else value
            for key, value in changes.items()
        },
    }


@pytest.mark.chain
def test_the_page_shows_something():
    assert "A calibrator" in sections()


@pytest.mark.chain
@pytest.mark.parametrize("title", sections())
def test_an_example_is_short_and_runs(title, tmp_path, shared_store):
    blocks = sections()[title]
    lines = blocks["python"].splitlines()
    assert len(lines) < MOST_LINES
    name = re.fullmatch(r"# (\w+\.py)", lines[0])
    assert name, "the first line of an example is the name of its file"
    (tmp_path / name[1]).write_text(blocks["python"])
    assert name[1] in plugin_reference(tmp_path / name[1])
    path = tmp_path / "experiment.yaml"
    experiment = merged(tiny(tmp_path), {"simulation": {"chunks": 1}, "calibration": {"chunks": 1}})
    experiment["outputs"] |= {"store": str(shared_store), "figures": ["layout", "spherical"]}
    if title == "A calibrator":
        experiment["corruption"]["effects"] = [{"kind": "dead-antennas", "antennas": [2]}]
    if title in ALONE:
        experiment["variants"] = FEWEST_VARIANTS
    path.write_text(yaml.safe_dump(merged(experiment, yaml.safe_load(blocks["yaml"]))))
    run = run_study(load_study(path), Budget(workers=1))
    assert (run.folder / "report.html").is_file()
    # Seven antennas determine their gains so badly that single precision may not reach the minimum; solves say so.
    said = ("did not converge", "where solves stall")
    others = [warning for warning in run.warnings if not any(text in warning for text in said)]
    if title != "A calibrator":
        assert others == []
    else:
        # Antenna 2 is dead, in six pairs of 21.
        assert len(others) == 2
        assert any("6 of 21 pairs of baselines are left out" in warning for warning in others)
        assert any("All visibilities of antenna(s) 2 are flagged" in warning for warning in others)
        flags = open_run(run.folder).gains().flag_array
        assert flags.all(axis=(1, 2, 3)).tolist() == [antenna == 2 for antenna in range(len(flags))]


def test_the_calibrator_flags_gains_that_it_has_nothing_to_fit_to(tmp_path):
    """Of an antenna whose data are flagged, and in another integration of one that receives nothing."""
    (tmp_path / "stefcal.py").write_text(sections()["A calibrator"]["python"])
    calibrator = CALIBRATORS.make({"calibrator": str(tmp_path / "stefcal.py")})
    template = make_template(small_instrument(times={"count": 2}))
    rng = np.random.default_rng(4)
    sky = from_cube(template, rng.standard_normal((template.Ntimes, template.Nbls, template.Nfreqs, 1, 2)) @ (1, 1j))
    cube = to_cube(sky).copy()
    flags = np.zeros(cube.shape, bool)
    names = template.telescope.antenna_numbers
    ends = np.stack([template.ant_1_array, template.ant_2_array])[:, : template.Nbls]
    flags[0, (ends == names[1]).any(axis=0)] = True
    cube[1, (ends == names[2]).any(axis=0), 5] = 0
    data = from_cube(template, cube)
    data.flag_array = flags.reshape(data.data_array.shape)
    found = calibrator.calibrate(Observation(data), Assumed(Observation(sky)))
    expected = np.zeros(found.gains.shape, bool)
    expected[1, :, 0], expected[2, 5, 1] = True, True
    np.testing.assert_array_equal(found.gain_flags, expected)
    np.testing.assert_allclose(abs(found.gains[~expected]), 1, atol=1e-3)


@pytest.mark.chain
@pytest.mark.parametrize(("title", "base"), [("A layout", ArrayLayout), ("A figure", StudyFigure)])
def test_an_example_that_is_copied_into_the_package_has_the_name_of_its_module(title, base, tmp_path, monkeypatch):
    """It needs no second name in its class."""
    code = sections()[title]["python"]
    module = re.match(r"# (\w+)\.py\n", code)[1]
    package = f"built_in_{title.split()[-1]}s"
    (tmp_path / package).mkdir()
    (tmp_path / package / "__init__.py").touch()
    (tmp_path / package / f"{module}.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    registry = Registry("thing", package, f"{base.__module__}:{base.__name__}", families=True)
    assert registry.built_in() == [module.replace("_", "-")]
