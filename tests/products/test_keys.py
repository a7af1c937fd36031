"""The graph: a changed field changes the keys of what reads it, and of nothing else."""

from pathlib import Path

import pytest
from tiny import tiny

from calstudy.base.identity import identity
from calstudy.base.user_code import load_file, load_function
from calstudy.corrupt.interface import Effect
from calstudy.experiment.files import override, validate
from calstudy.products import calibration, corruption, signal_loss, simulation, spectra
from calstudy.products.graph import Graph
from calstudy.run.task import Task, unique
from calstudy.studies.kinds.experiment import ExperimentStudy

BASE = {
    "name": "keys",
    "instrument": {"layout": {"kind": "hex", "side": 2}, "beam": "gaussian"},
    "papers": ["calamity2022"],
}


def tasks_of(data: dict) -> list[Task]:
    return ExperimentStudy(validate(data, Path())).tasks


def keys(path: str | None = None, value: object = None) -> dict[tuple[str, str], str]:
    data = BASE if path is None else override(BASE, path, value)
    return {(task.stage.name, task.label): task.key for task in tasks_of(data)}


def changed_stages(path: str, value: object) -> set[str]:
    before, after = keys(), keys(path, value)
    return {stage for (stage, label), key in after.items() if before.get((stage, label)) != key}


AVERAGED = {"power", "spectra", "figure", "claims", "transfer", "score"}
DOWNSTREAM = {
    "levels",
    "corrupt",
    "calibrate-chunk",
    "calibrate",
    "average",
    "difference",
    "agreement",
    "flux-scale",
    "response",
    "linear-response",
} | AVERAGED


@pytest.mark.parametrize(
    ("path", "value", "stages"),
    [
        ("name", "other", {"claims"}),
        ("description", "words", set()),
        ("outputs.store", "elsewhere", set()),
        ("outputs.figures", ["layout"], set()),
        (
            "power.wedge_buffer",
            "200 ns",
            {"spectra", "figure", "agreement", "claims", "transfer", "linear-response", "score"},
        ),
        ("power.bins.width", "0.1 h/Mpc", {"spectra", "figure", "claims", "transfer", "score"}),
        ("power.taper", "hann", AVERAGED | {"flux-scale", "response", "linear-response"}),
        ("calibration.basis.buffer", "80 ns", DOWNSTREAM - {"levels", "corrupt"}),
        ("corruption.effects.0.seed", 99, {"effect", "gains"} | DOWNSTREAM - {"levels"}),
        ("corruption.effects.0.drift", {"kind": "jumps"}, {"effect", "gains"} | DOWNSTREAM - {"levels"}),
        ("corruption.noise.seeds", [8, 9], DOWNSTREAM - {"levels"}),
        ("corruption.noise.factor", 5.0, DOWNSTREAM),
        ("sky.eor.seed", 99, {"simulate-chunk", "simulate"} | DOWNSTREAM),
        ("instrument.channels.first", "150 MHz", {"simulate-chunk", "simulate", "effect", "gains"} | DOWNSTREAM),
    ],
)
def test_a_changed_field_remakes_only_what_reads_it(path, value, stages):
    assert changed_stages(path, value) == stages


def test_another_figure_setting_remakes_figures_alone():
    assert changed_stages("outputs.inspect.antennas", [0, 2]) == {"figure"}


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("instrument.times", {}),
        ("instrument.channels.width", "80 kHz"),
        ("simulation.nodes.enabled", True),
        ("sky.eor.seed", 2),
        ("corruption.eor_level", "-40 dB"),
        ("corruption.noise", "times-eor"),
        ("corruption.effects", ["per-channel-gains"]),
        ("corruption.effects.0.sigma", 0.1),
        ("corruption.effects.0.drift", None),
        ("calibration.basis.buffer", "50 ns"),
        ("calibration.calibrator", "calamity"),
        ("calibration.solver", {"name": "gauss-newton", "max_steps": 100}),
        ("power.bins", {}),
        ("outputs.inspect.integration", 0),
    ],
)
def test_a_field_that_is_set_to_its_default_changes_no_key(path, value):
    assert keys() == keys(path, value)


def test_every_default_that_is_written_out_changes_no_key():
    resolved = validate(BASE, Path()).model_dump(mode="json")
    assert {(task.stage.name, task.label): task.key for task in tasks_of(resolved)} == keys()


@pytest.mark.parametrize("count", [1, 3, 16, 100])
def test_how_simulations_are_cut_changes_the_keys_of_the_pieces_alone(count):
    before, after = keys(), keys("simulation.chunks", count)
    assembled = {address for address in before if address[0] != "simulate-chunk"}
    assert {address: before[address] for address in assembled} == {address: after[address] for address in assembled}
    pieces = ({key for (stage, _), key in found.items() if stage == "simulate-chunk"} for found in (before, after))
    assert set.isdisjoint(*pieces) == (count != validate(BASE, Path()).simulation.chunks)


def test_how_many_models_are_worked_on_at_a_time_changes_no_key():
    assert keys() == keys("calibration.models_at_once", 32)


def test_a_changed_buffer_keeps_every_variant_that_is_not_calibrated():
    before, after = keys(), keys("calibration.basis.buffer", "80 ns")
    for name in ("uncorrupted", "uncalibrated", "eor", "noise"):
        assert before["power", name] == after["power", name]
    for name in ("residual", "residual_without_eor"):
        assert before["power", name] != after["power", name]


def test_a_changed_eor_keeps_the_foregrounds():
    before, after = keys(), keys("sky.eor.seed", 99)
    assert before["simulate", "foregrounds"] == after["simulate", "foregrounds"]
    assert before["simulate", "eor"] != after["simulate", "eor"]


def test_the_same_field_in_another_unit_is_the_same_product():
    assert keys("instrument.channels.width", "80 kHz") == keys("instrument.channels.width", "0.08 MHz")


def behind(task: Task) -> set[str]:
    """Return the names of all stages that a product is made by."""
    return {found.stage.name for found in unique([task])}


@pytest.mark.parametrize("name", sorted({task.stage.name for task in tasks_of(BASE)}))
def test_another_version_of_a_stage_alone_changes_everything_made_from_its_products(name, monkeypatch):
    made_from = {(task.stage.name, task.label): name in behind(task) for task in tasks_of(BASE)}
    kind = next(type(task) for task in tasks_of(BASE) if task.stage.name == name)
    before = keys()
    monkeypatch.setattr(kind, "stage", kind.stage._replace(version=kind.stage.version + 1))
    after = keys()
    assert {address: before[address] != after[address] for address in before} == made_from


def test_every_task_comes_after_what_it_needs_and_once():
    tasks = tasks_of(BASE)
    position = {task.key: index for index, task in enumerate(tasks)}
    assert len(position) == len(tasks)
    assert any(task.pieces for task in tasks)
    assert all(position[needed.key] < position[task.key] for task in tasks for needed in task.needs.values())


def test_even_and_odd_share_what_has_no_noise():
    graph = Graph(validate(BASE, Path()))
    eor, noisy = graph.experiment.variants["eor"], graph.experiment.variants["noise"]
    assert corruption.data(graph, eor, "even") is corruption.data(graph, eor, "even")
    assert corruption.data(graph, eor, "even").key == corruption.data(graph, eor, "odd").key
    assert corruption.data(graph, noisy, "even").key != corruption.data(graph, noisy, "odd").key


LAYOUT = "east_m,north_m,up_m\n0,0,0\n14,0,0\n0,28,0\n"


def layout_file(folder: Path, name: str, text: str = LAYOUT) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def simulated(folder: Path, layout: Path) -> str:
    data = override(tiny(folder), "instrument.layout", {"kind": "csv", "path": str(layout)})
    data = override(data, "instrument.location", "mwa")
    return simulation.eor(Graph(validate(data, folder))).key


def test_an_input_file_counts_by_its_content(tmp_path):
    first, second = layout_file(tmp_path, "a.csv"), layout_file(tmp_path, "b.csv")
    assert identity(first) == identity(second)
    before = simulated(tmp_path, first)
    assert simulated(tmp_path, second) == before
    layout_file(tmp_path, "b.csv", LAYOUT + "42,0,0\n")
    assert identity(first) != identity(second)
    assert simulated(tmp_path, second) != before


def test_a_path_that_names_a_file_among_plain_settings_counts_by_content_too(tmp_path):
    first, second = layout_file(tmp_path, "a.csv"), layout_file(tmp_path, "b.csv")
    assert identity({"files": [first, None]}) == identity({"files": [second, None]})


def test_a_plug_in_counts_by_the_content_of_its_file(tmp_path):
    code = (
        "from calstudy.corrupt.interface import Effect\n\n\nclass Quieter(Effect):\n    share: float = 0.5\n\n"
        "    def apply(self, visibilities, observation, truth):\n        return self.share * visibilities\n"
    )
    path = tmp_path / "quieter.py"
    path.write_text(code)

    def key(**changes: object) -> str:
        effects = [{"kind": str(path), **changes}]
        graph = Graph(validate(override(tiny(tmp_path), "corruption.effects", effects), tmp_path))
        return corruption.data(graph, graph.experiment.variants["residual"], "even").key

    before = key()
    assert key(share=0.5) == before
    assert key(share=0.4) != before
    path.write_text(code.replace("0.5", "0.25"))
    assert key() != before


def test_a_plug_in_counts_with_the_modules_that_it_imports_from_its_folder(tmp_path):
    files = {
        "quieter": "from calstudy.corrupt.interface import Effect\nfrom shares import share\n\n\n"
        "class Quieter(Effect):\n    def apply(self, visibilities, observation, truth):\n"
        "        return share() * visibilities\n",
        "shares": "from parts import half\n\n\ndef share():\n    return half\n",
        "parts": "half = 0.5\n",
        "unused": "half = 0.5\n",
    }
    for name, code in files.items():
        (tmp_path / f"{name}.py").write_text(code)

    def effect() -> Effect:
        return validate(override(tiny(tmp_path), "corruption.effects", ["quieter.py"]), tmp_path).corruption.effects[0]

    before = identity(effect())
    assert effect().apply(1.0, None, {}) == 0.5
    (tmp_path / "unused.py").write_text("half = 0.25\n")
    assert identity(effect()) == before
    (tmp_path / "parts.py").write_text("half = 0.25\n")
    assert identity(effect()) != before
    assert effect().apply(1.0, None, {}) == 0.25


@pytest.mark.parametrize("line", ["from .amount import half", "from . import amount\n\nhalf = amount.half"])
def test_a_plug_in_counts_with_the_modules_that_a_package_of_its_folder_imports(tmp_path, line):
    (tmp_path / "sizes").mkdir()
    (tmp_path / "sizes" / "__init__.py").write_text("from .inner import share\n")
    (tmp_path / "sizes" / "inner").mkdir()
    (tmp_path / "sizes" / "inner" / "__init__.py").write_text(f"from ..amount import half as _\n{line}\nshare = half\n")
    for place in ("amount.py", "inner/amount.py"):
        (tmp_path / "sizes" / place).write_text("half = 0.5\n")
    (tmp_path / "quieter.py").write_text(
        "from sizes import share\nfrom calstudy.corrupt.interface import Effect\n\n\nclass Quieter(Effect):\n"
        "    def apply(self, visibilities, observation, truth):\n        return share * visibilities\n"
    )

    def effect() -> Effect:
        return validate(override(tiny(tmp_path), "corruption.effects", ["quieter.py"]), tmp_path).corruption.effects[0]

    before = identity(effect())
    assert effect().apply(1.0, None, {}) == 0.5
    (tmp_path / "sizes" / "inner" / "amount.py").write_text("half = 0.25\n")
    between = identity(effect())
    assert effect().apply(1.0, None, {}) == 0.25
    (tmp_path / "sizes" / "amount.py").write_text("half = 0.25\n")
    assert len({str(found) for found in (before, between, identity(effect()))}) == 3


def test_a_file_that_a_plug_in_names_by_default_counts_by_its_content(tmp_path):
    (tmp_path / "table.txt").write_text("0.5")
    (tmp_path / "quieter.py").write_text(
        "from pathlib import Path\nfrom calstudy.corrupt.interface import Effect\n\n\n"
        f"class Quieter(Effect):\n    table: Path = Path({str(tmp_path / 'table.txt')!r})\n\n"
        "    def apply(self, visibilities, observation, truth):\n        return visibilities\n"
    )

    def key() -> object:
        settings = validate(override(tiny(tmp_path), "corruption.effects", ["quieter.py"]), tmp_path)
        return identity(settings.corruption.effects[0])

    before = key()
    (tmp_path / "table.txt").write_text("0.25")
    assert key() != before


def test_a_product_of_a_file_counts_with_the_content_of_the_file(tmp_path):
    code = (
        "from calstudy.run.task import Task\n\n\nclass Answer(Task, stage='answer'):\n"
        "    def make(self, output):\n        return {'answer': 42}\n"
    )
    keys = []
    for name, text in (("first", code), ("second", code.replace("42", "43")), ("third", code)):
        (tmp_path / f"{name}.py").write_text(text)
        keys.append(load_file(tmp_path / f"{name}.py").Answer("").key)
    assert keys[0] != keys[1]
    assert keys[0] == keys[2]


def test_sources_from_code_count_with_the_modules_that_it_imports_from_its_folder(tmp_path):
    (tmp_path / "fluxes.py").write_text("FLUX = 10.0\n")
    (tmp_path / "mine.py").write_text("from fluxes import FLUX\n\n\ndef sources(frequencies):\n    return FLUX\n")
    block = {"kind": "code", "path": "mine.py", "function": "sources"}

    def found() -> tuple[object, float]:
        settings = validate(override(tiny(tmp_path), "sky.foregrounds", block), tmp_path).sky.foregrounds
        return identity(settings), load_function(settings.path, "sources")(None)

    before = found()
    (tmp_path / "fluxes.py").write_text("FLUX = 20.0\n")
    after = found()
    assert before[0] != after[0]
    assert (before[1], after[1]) == (10.0, 20.0)


def test_a_calibration_is_one_task_however_many_products_need_it():
    graph = Graph(validate(BASE, Path()))
    residual = graph.experiment.variants["residual"]
    found = calibration.calibration(graph, residual, "even")
    assert calibration.calibration(graph, residual, "even") is found
    assert spectra.average(graph, residual, "even").inputs["data"] is found


def test_a_plan_counts_the_blocks_of_averages_differences_and_spectra():
    """Two blocks have twice the averages and differences, and another pass of the estimator."""
    study = override(BASE, "instrument.times", {"integration": "60 s", "count": 4})
    found = []
    for power in ({}, {"coherent_time": "2 min"}):
        transfer = signal_loss.transfer(Graph(validate({**study, "power": power}, Path())))
        assert transfer is not None
        response = transfer.inputs["response"]
        difference, average = response.inputs["even"], transfer.inputs["signal"].inputs["even"]
        found.append((difference.cost.disk, average.cost.disk, response.cost.seconds))
    whole, halves = found
    assert halves[:2] == (2 * whole[0], 2 * whole[1])
    assert halves[2] > whole[2]


def test_a_product_of_a_module_beside_a_file_counts_with_its_content(tmp_path):
    (tmp_path / "table.py").write_text("from beside import Answer\n\n\ndef made():\n    return Answer('')\n")
    keys = []
    for number in (42, 43):
        (tmp_path / "beside.py").write_text(
            "from calstudy.run.task import Task\n\n\nclass Answer(Task, stage='answer'):\n"
            f"    def make(self, output):\n        return {{'answer': {number}}}\n"
        )
        keys.append(load_file(tmp_path / "table.py").made().key)
    assert keys[0] != keys[1]


@pytest.mark.parametrize("place", ["absolute", "beside the experiment"])
def test_a_file_that_an_option_of_a_sky_names_counts_by_its_content(tmp_path, place):
    name = str(tmp_path / "flux.txt") if place == "absolute" else "flux.txt"
    (tmp_path / "sky.py").write_text("def sky(frequencies, data, names):\n    return None\n")
    options = {"data": {"flux": name}, "names": ["no such file.txt", 3]}
    foregrounds = {"kind": "code", "path": "sky.py", "function": "sky", "options": options}
    found = []
    for text in ("10", "99"):
        (tmp_path / "flux.txt").write_text(text)
        found.append(identity(validate(override(tiny(tmp_path), "sky.foregrounds", foregrounds), tmp_path).sky))
    assert found[0] != found[1]
    assert found[0]["foregrounds"]["options"]["names"] == ["no such file.txt", 3]
