"""The graph: a changed field changes the keys of what reads it, and of nothing else."""

from pathlib import Path

import pytest

from calstudy.experiment.files import override, validate
from calstudy.graph.tasks import Graph, identify

BASE = {"name": "keys", "instrument": {"layout": {"kind": "hex", "side": 2}, "beam": "gaussian"}}


def keys(path: str | None = None, value: object = None) -> dict[tuple[str, str], str]:
    data = BASE if path is None else override(BASE, path, value)
    return {(task.stage, task.label): task.key for task in Graph(validate(data, Path())).tasks}


def changed_stages(path: str, value: object) -> set[str]:
    before, after = keys(), keys(path, value)
    return {stage for (stage, label), key in after.items() if before.get((stage, label)) != key}


TRANSFER = {"transfer", "transfer-figure"}
AVERAGED = {"power", "spectra", "figure", "claims"} | TRANSFER
DOWNSTREAM = {"levels", "corrupt", "calibrate-chunk", "calibrate", "average", "difference", "agreement"} | AVERAGED


@pytest.mark.parametrize(
    ("path", "value", "stages"),
    [
        ("name", "other", {"claims"}),
        ("description", "words", set()),
        ("outputs.store", "elsewhere", set()),
        ("power.wedge_buffer", "200 ns", {"spectra", "figure", "agreement", "claims"} | TRANSFER),
        ("power.bins.width", "0.1 h/Mpc", {"spectra", "figure", "claims"} | TRANSFER),
        ("power.taper", "hann", AVERAGED),
        ("calibration.basis.buffer", "80 ns", DOWNSTREAM - {"levels", "corrupt"}),
        ("corruption.gains.seed", 99, {"gains"} | DOWNSTREAM - {"levels"}),
        ("corruption.noise.seeds", [8, 9], DOWNSTREAM - {"levels"}),
        ("corruption.noise.factor", 5.0, DOWNSTREAM),
        ("sky.eor.seed", 99, {"simulate-chunk", "simulate"} | DOWNSTREAM),
        ("instrument.channels.first", "150 MHz", {"simulate-chunk", "simulate", "gains"} | DOWNSTREAM),
    ],
)
def test_a_changed_field_remakes_only_what_reads_it(path, value, stages):
    assert changed_stages(path, value) == stages


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


def test_every_task_comes_after_its_inputs_and_once():
    tasks = Graph(validate(BASE, Path())).tasks
    position = {task.key: index for index, task in enumerate(tasks)}
    assert len(position) == len(tasks)
    assert all(position[needed.key] < position[task.key] for task in tasks for needed in task.inputs.values())


def test_even_and_odd_share_what_has_no_noise():
    graph = Graph(validate(BASE, Path()))
    eor, noisy = graph.experiment.variants["eor"], graph.experiment.variants["noise"]
    assert graph.data(eor, "even").key == graph.data(eor, "odd").key
    assert graph.data(noisy, "even").key != graph.data(noisy, "odd").key


def test_an_input_file_counts_by_its_content(tmp_path):
    first, second = tmp_path / "a.csv", tmp_path / "b.csv"
    first.write_text("1")
    second.write_text("1")
    same = identify({"path": str(first)}), identify({"path": str(second)})
    second.write_text("22")
    assert same[0] == same[1] != identify({"path": str(second)})
