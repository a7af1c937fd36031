"""Names of plug-ins; the code of the notebook on one's own calibrator and sky; skies that are functions of a file."""

from __future__ import annotations

import inspect
import json
import os
import pkgutil
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import yaml
from distributed.protocol.pickle import dumps, loads
from pydantic import ValidationError
from tiny import load, tiny

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.user_code import load_file
from calstudy.base.visibilities import from_cube, to_cube
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.interface import CALIBRATORS
from calstudy.corrupt.interface import Effect
from calstudy.experiment.model import FIGURES
from calstudy.instrument.settings import BEAMS, LAYOUTS, InstrumentSettings
from calstudy.instrument.telescope import make_template
from calstudy.products import calibration, corruption
from calstudy.products.files import read_visibilities
from calstudy.run.execution import Budget
from calstudy.run.store import Store
from calstudy.simulate.interface import Engine
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.sky.settings import CodeSources
from calstudy.studies.load import load_study
from calstudy.studies.reference import plugin_reference
from calstudy.studies.study import run_study

OWN_CODE = Path(__file__).parents[2] / "notebooks" / "own_code.py"


@pytest.fixture(scope="module")
def template():
    instrument = {**tiny(Path())["instrument"], "channels": {"first": "170 MHz", "width": "400 kHz", "count": 8}}
    return make_template(InstrumentSettings.model_validate(instrument))


@pytest.mark.parametrize(
    "registry", [CALIBRATORS, FIGURES, BEAMS, LAYOUTS, Effect.registry, Engine.registry], ids=lambda found: found.noun
)
def test_names_that_are_read_from_the_text_of_modules_are_those_of_their_classes(registry):
    package = import_module(registry.package)
    modules = [import_module(f"{registry.package}.{item.name}") for item in pkgutil.iter_modules(package.__path__)]
    classes = [
        value
        for module in modules
        for name, value in vars(module).items()
        if inspect.isclass(value) and issubclass(value, registry.base) and not inspect.isabstract(value)
        if value.__module__ == module.__name__ and not name.startswith("_")
    ]
    found = {name: cls for cls in classes for name in cls.names()}
    assert {name: registry.find(name) for name in registry.built_in()} == found


def test_a_sky_of_ones_own(tmp_path):
    frequencies = np.linspace(170e6, 180e6, 4)
    source = CodeSources(kind="code", path=OWN_CODE, function="few_bright", options={"count": 7})
    found = make_foregrounds(source, frequencies)
    assert found.sky.Ncomponents == 7
    assert found.stand_in == "foregrounds: 7 sources by few_bright of own_code.py"
    flux = found.sky.at_frequencies(found.sky.reference_frequency[:1], inplace=False).stokes[0, 0].to_value("Jy")
    np.testing.assert_allclose(flux, 100 * (1 + np.arange(7)) ** -0.7)
    other = tmp_path / "sky.py"
    other.write_text("def sky(frequencies):\n    return frequencies\n")
    with pytest.raises(InputError, match="must return a pyradiosky SkyModel of points"):
        make_foregrounds(CodeSources(kind="code", path=other, function="sky"), frequencies)


@pytest.mark.parametrize(
    ("changes", "refusal"),
    [
        ({"function": "absent"}, "sky.foregrounds: 'absent' is not a function of sky.py (it has: sky)"),
        (
            {"options": {"n": 3}},
            "sky.foregrounds.function: is called as sky(frequencies, n=...): got an unexpected keyword argument 'n'",
        ),
    ],
)
def test_a_sky_that_cannot_be_made_is_refused_before_anything_starts(tmp_path, changes, refusal):
    content = tiny(tmp_path)
    foregrounds = {"kind": "code", "path": "sky.py", "function": "sky", **changes}
    content["sky"] = {**content["sky"], "foregrounds": foregrounds}
    (tmp_path / "sky.py").write_text("def sky(frequencies):\n    return frequencies\n")
    path = tmp_path / "own.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ExperimentError) as caught:
        load(path)
    assert caught.value.faults == [refusal]


def test_fields_of_lists_say_what_is_in_them(tmp_path):
    path = tmp_path / "listed.py"
    path.write_text(
        "from calstudy.corrupt.interface import Effect\n\n\nclass Listed(Effect):\n"
        "    antennas: list[int]\n    limits: tuple[float, ...] | None = None\n"
    )
    text = plugin_reference(path)
    assert "| `antennas` | list of whole numbers | required |" in text
    assert "| `limits` | list of numbers | null |" in text


def test_lists_and_texts_of_a_file_become_tuples_sets_and_paths(tmp_path):
    """In the settings of a plug-in as in those of calstudy, also where one is in another; numbers remain strict."""
    (tmp_path / "table.txt").write_text("1\n")
    (tmp_path / "typed.py").write_text(
        "from pathlib import Path\nfrom calstudy.corrupt.interface import Effect\n\n\nclass Typed(Effect):\n"
        "    table: Path\n    limits: tuple[float, ...] | None = None\n    pairs: dict[str, tuple[int, int]] = {}\n"
        "    chosen: frozenset[int] = frozenset()\n    metadata: tuple[int, ...] = ()\n"
        "    default: tuple[tuple[int, ...], ...] = ()\n\n    def apply(self, visibilities, observation, truth):\n"
        "        return visibilities\n"
    )
    block = {"kind": "typed.py", "table": "table.txt", "limits": [1, 2.5], "pairs": {"a": [0, 1]}, "chosen": [3, 3]}
    block |= {"metadata": [1, 2], "default": [[1, 2]]}
    made = Effect.registry.make(block, folder=tmp_path)
    assert (made.table, made.limits) == (tmp_path / "table.txt", (1.0, 2.5))
    assert (made.pairs, made.chosen) == ({"a": (0, 1)}, {3})
    assert (made.metadata, made.default) == ((1, 2), ((1, 2),))
    assert loads(dumps(made)) == made
    for wrong in ({"limits": ["1"]}, {"pairs": {"a": [0, "1"]}}, {"limits": 3}, {"table": 3}):
        with pytest.raises(ValidationError):
            Effect.registry.make({**block, **wrong}, folder=tmp_path)


@pytest.mark.parametrize("name", ["model_post_init", "__init__"])
def test_an_error_of_a_plugins_own_start_names_its_line(tmp_path, name):
    given = "self, context" if name == "model_post_init" else "self, **given"
    (tmp_path / "started.py").write_text(
        "from calstudy.corrupt.interface import Effect\n\n\nclass Started(Effect):\n"
        f"    def {name}({given}):\n        {{}}['absent']\n\n"
        "    def apply(self, visibilities, observation, truth):\n        return visibilities\n"
    )
    with pytest.raises(InputError, match=rf"started\.py line 6, in {name}: KeyError: 'absent'"):
        Effect.registry.make("started.py", folder=tmp_path)


def test_the_notebooks_calibrator_finds_the_gains(template):
    """Without noise, and up to the phase that no visibility tells."""
    rng = np.random.default_rng(2)
    cube = (template.Ntimes, template.Nbls, template.Nfreqs, template.Npols, 2)
    sky = from_cube(template, rng.standard_normal(cube) @ (1, 1j))
    shape = (template.telescope.Nants, template.Nfreqs, template.Ntimes, 1)
    true = 1 + 0.2 * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    names = template.telescope.antenna_numbers
    first, second = (np.searchsorted(names, array[: sky.Nbls]) for array in (sky.ant_1_array, sky.ant_2_array))
    products = np.moveaxis(true[first] * true[second].conj(), 2, 0)
    data = from_cube(template, to_cube(sky) * products)
    calibrator = CALIBRATORS.make({"calibrator": str(OWN_CODE), "rounds": 400})
    result = run_calibrator(calibrator, data, sky)
    assert {record.status for record in result.solutions} == {"converged"}
    gains = result.gains.gain_array
    turn = np.exp(-1j * np.angle((gains * true.conj()).sum(axis=0)))
    np.testing.assert_allclose(gains * turn, true, atol=1e-6)
    hasty = run_calibrator(calibrator.model_copy(update={"rounds": 2}), data, sky)
    assert {record.status for record in hasty.solutions} == {"max-steps"}


@pytest.mark.chain
def test_a_study_of_own_code_runs_and_plays_no_part_of_the_paper(tmp_path):
    content = tiny(tmp_path)
    content["outputs"]["figures"] = []
    content["papers"] = ["calamity2022"]
    content["calibration"] = {"calibrator": str(OWN_CODE), "chunks": 2}
    sky = {"kind": "code", "path": str(OWN_CODE), "function": "few_bright"}
    content["sky"] = {**content["sky"], "foregrounds": sky}
    path = tmp_path / "own.yaml"
    path.write_text(yaml.safe_dump(content))
    study = load_study(path)
    result = run_study(study, Budget(workers=1))
    assert '"supported"' not in (result.folder / "claims.json").read_text()
    manifest = json.loads((result.folder / "manifest.json").read_text())
    assert any("own_code.py, not GLEAM" in text for text in manifest["stand_ins"])
    graph, store = study.graph, Store(study.outputs.store)
    variants = study.experiment.variants
    wanted = {
        "residual.uvh5": calibration.calibration(graph, variants["residual_without_eor"], "even"),
        "data.uvh5": corruption.data(graph, variants["noise"], "even"),
    }
    residual, thermal = (
        read_visibilities(store.find(task.stage.name, task.key).path / file).data_array for file, task in wanted.items()
    )
    # The sky model is the truth, so that what is left is the noise less what the gains absorb of it.
    assert 0.4 < np.std(residual) / np.std(thermal) < 1.0


@pytest.mark.parametrize("changed", ["mine", "beside"])
def test_code_that_changes_within_a_second_to_the_same_size_is_run_anew(tmp_path, changed):
    # Modules of equal names are one to Python.
    beside = f"beside_{changed}"
    texts = {"mine": f"from {beside} import X\n\nY = 1\n", beside: "X = 1\n"}
    for number in (1, 2):
        name = changed if changed in texts else beside
        texts[name] = texts[name].replace("= 1", f"= {number}")
        for stem, text in texts.items():
            path = tmp_path / f"{stem}.py"
            path.write_text(text, encoding="utf-8")
            # Python takes compiled code for that of a file of the same second and size.
            os.utime(path, ns=(10**18 + number, 10**18 + number))
        module = load_file(tmp_path / "mine.py")
        assert {"mine": module.Y, "beside": module.X}[changed] == number


@pytest.mark.parametrize("form", ["module", "package"])
def test_files_import_the_modules_of_their_own_folders(tmp_path, monkeypatch, form):
    # The folder of a third one is on the path of Python, as the current folder is.
    monkeypatch.syspath_prepend(tmp_path / "elsewhere")
    for number, place in enumerate(["elsewhere", "first", "second"]):
        (tmp_path / place).mkdir()
        beside = tmp_path / place / {"module": "same_name.py", "package": "same_name/__init__.py"}[form]
        beside.parent.mkdir(exist_ok=True)
        beside.write_text(f"from other_name import OTHER\n\nX = {number}\n", encoding="utf-8")
        (tmp_path / place / "other_name.py").write_text(f"OTHER = {number}\n", encoding="utf-8")
        (tmp_path / place / "mine.py").write_text("from same_name import OTHER, X\n", encoding="utf-8")
    found = [load_file(tmp_path / place / "mine.py") for place in ("first", "second")]
    assert [(module.X, module.OTHER) for module in found] == [(1, 1), (2, 2)]


def test_a_function_imports_the_module_of_its_own_folder_when_it_is_called(tmp_path):
    texts = {
        "first": "from third_beside import Z\n",
        "second": "def x():\n    import called_beside\n\n    return called_beside.X\n",
    }
    for number, (place, text) in enumerate(texts.items()):
        (tmp_path / place).mkdir()
        (tmp_path / place / "other_beside.py").write_text(f"Y = {number}\n", encoding="utf-8")
        (tmp_path / place / "third_beside.py").write_text("Z = 0\n", encoding="utf-8")
        (tmp_path / place / "called_beside.py").write_text("from other_beside import Y\n\nX = Y\n", encoding="utf-8")
        (tmp_path / place / "mine.py").write_text(text, encoding="utf-8")
    load_file(tmp_path / "first" / "mine.py")
    assert load_file(tmp_path / "second" / "mine.py").x() == 1


@pytest.mark.parametrize("order", [("late", "early"), ("early", "late")])
def test_imports_in_functions_of_modules_with_one_name_are_refused(tmp_path, order):
    name = f"beside_{order[0]}"
    texts = {"late": f"def x():\n    import {name}\n\n    return {name}.X\n", "early": f"from {name} import X\n"}
    for number, place in enumerate(order):
        (tmp_path / place).mkdir()
        (tmp_path / place / f"{name}.py").write_text(f"X = {number}\n", encoding="utf-8")
        (tmp_path / place / "mine.py").write_text(texts[place], encoding="utf-8")
    load_file(tmp_path / order[0] / "mine.py")
    with pytest.raises(InputError, match=f"import {name} at the top of both files, or rename it"):
        load_file(tmp_path / order[1] / "mine.py")
    # The same content in another folder is the same code.
    (tmp_path / order[1] / f"{name}.py").write_text("X = 0\n", encoding="utf-8")
    assert load_file(tmp_path / order[1] / "mine.py")
