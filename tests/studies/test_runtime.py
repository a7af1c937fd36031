"""Run-time studies: known times come out as known exponents, and belong to the machine they were measured on."""

from __future__ import annotations

import csv
import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from calstudy.base.errors import ExperimentError, InputError
from calstudy.claims.evaluation import evaluate_folder
from calstudy.products.run_times import machine_in_words
from calstudy.studies.kinds import runtime
from calstudy.studies.kinds.runtime import RuntimeStudy
from calstudy.studies.load import load_study
from calstudy.studies.show import describe_plan, show_plan
from calstudy.studies.study import Budget, run_study

DRAWN = True

FILE = Path(__file__).parents[2] / "experiments" / "runtime.yaml"
POWERS = {"paper-step": 2.1, "paper-sum": 2.1, "adamax-step": 1.9, "default-step": 1.5, "default-solve": 1.6}


def pretend_to_measure(array, **request):
    """Return times that grow with the array by known powers, ten times faster on a GPU, or a known descent."""
    if "max_steps" in request:
        losses = 1 + 100 / np.arange(1, request["max_steps"] + 2)
        return {"antennas": 9, "floor": 1.0, "losses": losses.tolist()}
    layout = array.layout
    count = layout.count
    longest = 100.0 if layout.kind == "rectangular" else (count - 1) * layout.spacing
    scatter = np.exp(0.1 * np.linspace(-1, 1, 101)) * (0.1 if request["device"] == "gpu" else 1)
    basis = int(1e5 * count**2)
    return {
        "antennas": count,
        "baselines": count * (count - 1) // 2,
        "longest": longest,
        "vectors": int(longest),
        "coefficients": 99,
        "seconds": {name: (1e-5 * count**power * longest * scatter).tolist() for name, power in POWERS.items()},
        "basis_bytes": basis,
        "paper_memory": 6 * basis,
    }


@pytest.fixture
def study(tmp_path, monkeypatch) -> RuntimeStudy:
    monkeypatch.setattr("calstudy.products.run_times.measured_apart", pretend_to_measure)
    places = [f"outputs.store={tmp_path / 'store'}", f"outputs.runs={tmp_path / 'runs'}"]
    monkeypatch.setattr(sys.modules[__name__], "PLACES", places)
    return reload()


PLACES: list[str] = []
"""Overrides that send products and runs to the folder of a test."""


def reload(*changes: str) -> RuntimeStudy:
    """Read the study again, on the machine as it is now."""
    return load_study(FILE, "small", [*PLACES, "runtime.descent.max_steps=9000", *changes])


def test_known_powers_come_back_in_figures_tables_and_claims(study):
    run = run_study(study, Budget(workers=1))
    for panel, exponent in (("rows", 2.1), ("line", 1.0)):
        with np.load(run.folder / "figures" / f"runtime-{panel}.npz", allow_pickle=False) as arrays:
            assert str(arrays["0.label"]) == "paper's Adamax, step"
            assert float(arrays["0.fit.exponent"]) == pytest.approx(exponent)
            np.testing.assert_allclose(arrays["0.high"] / arrays["0.median"], np.exp(0.095), rtol=1e-3)
    with (run.folder / "tables" / "runtime.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["panel"] == "rows" and row["timed"] == "default-solve"]
    assert [int(row["antennas"]) for row in rows] == [9, 12, 16]
    assert [float(row["median [s]"]) for row in rows] == pytest.approx([1e-3 * n**1.6 for n in (9, 12, 16)])
    claims = {claim.name: claim for claim in evaluate_folder(run.folder).verdicts}
    expected = {
        "paper-step-quadratic-in-antennas": (2.1, "supported"),
        "own-step-quadratic-in-antennas": (1.9, "supported"),
        "paper-step-linear-in-longest-baseline": (1.0, "supported"),
        "sum-dominates-step": (1.0, "supported"),
        "basis-dominates-memory": (1 / 6, "contradicted"),
        "memory-grows-like-basis": (1.0, "supported"),
        "thousands-of-steps-to-five-percent": (1999, "supported"),
        # A bound: 9000 steps are not enough, and take more than ten minutes.
        "gpu-critical-for-paper-solver": (9000 * 1e-3 * 9**2.1, "supported"),
    }
    for name, (value, verdict) in expected.items():
        assert claims[name].measured == pytest.approx(value, rel=1e-6), name
        assert claims[name].verdict == verdict, name
    steps = claims["thousands-of-steps-to-one-percent"]
    assert (steps.measured, steps.kind, steps.verdict) == (9000, "at least", "undecided")
    assert steps.runs == (f"{study.name} on {machine_in_words(study.timed_on)}",)
    assert "needs run times on a gpu" in claims["gpu-thirty-times-faster"].reason
    assert (run.folder / "report.html").stat().st_size > 1e5


def test_times_are_measured_once_on_a_machine_and_again_on_another(study, monkeypatch):
    first = run_study(study, Budget(workers=1))
    again = run_study(study, Budget(workers=1))
    assert (len(first.made.tasks), len(again.made.tasks)) == (11, 0)
    assert again.folder == first.folder
    here = runtime.machine()
    monkeypatch.setattr(runtime, "machine", lambda: {**here, "processor": "another"})
    elsewhere = run_study(reload(), Budget(workers=1))
    # The steps that a descent takes are no run time.
    assert len(elsewhere.made.tasks) == 10
    assert elsewhere.folder != first.folder
    assert json.loads((elsewhere.folder / "manifest.json").read_text())["machine"]["processor"] == "another"


def test_a_gpu_is_compared_with_the_processor(study, monkeypatch):
    monkeypatch.setattr(runtime, "_gpu", lambda: "some GPU")
    run = run_study(reload("runtime.devices=[cpu, gpu]"), Budget(workers=1))
    claims = {claim.name: claim for claim in evaluate_folder(run.folder).verdicts}
    assert claims["gpu-thirty-times-faster"].measured == pytest.approx(10)
    assert claims["gpu-step-constant-in-longest-baseline"].measured == pytest.approx(1)
    with np.load(run.folder / "figures" / "runtime-rows.npz", allow_pickle=False) as arrays:
        assert {str(arrays[f"{index}.label"]) for index in range(8)} >= {"paper's Adamax, step, GPU"}


def test_a_gpu_that_is_not_there_is_a_sentence(study, monkeypatch):
    monkeypatch.setattr("tensorflow.config.list_physical_devices", lambda kind: [])
    with pytest.raises(InputError, match="finds no GPU"):
        reload("runtime.devices=[gpu]").sized_to(Budget())


def test_what_would_spoil_the_times_is_refused(study):
    assert study.sized_to(Budget(1)) == (study, 1)
    for budget in (Budget(2), Budget(scheduler="tcp://somewhere:8786")):
        with pytest.raises(InputError, match="one after the other"):
            study.sized_to(budget)
    with pytest.raises(InputError, match=r"the paper's solver needs about \d+\.\d GB, and there are 0\.5 GB"):
        study.sized_to(Budget(max_memory="500 MB"))


def test_a_plan_names_what_will_be_timed(study):
    console = Console(file=io.StringIO(), width=100)
    show_plan(describe_plan(study, Budget()), console)
    told = console.file.getvalue()
    assert "step-times" in told
    assert "plan for 1 worker" in told


def test_full_scale_is_the_papers():
    study = load_study(FILE)
    channels = study.file.runtime.channels
    assert channels.count * channels.width == pytest.approx(60e6)
    assert max(size for panel, size, _ in study.arrays.values() if panel == "rows") >= 100
    lengths = [size for panel, size, _ in study.arrays.values() if panel == "line"]
    assert (min(lengths), max(lengths)) == (20.0, 200.0)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("runtime.rows.antennas=[16, 12, 20]", "runtime.rows.antennas: must increase"),
        ("runtime.rows.max_baseline=14 m", "runtime.rows.max_baseline: 14 m must exceed the length of a row, 14 m"),
        ("runtime.line.lengths=[20 m, 2 km, 3 km]", "runtime.channels.width: 300 kHz resolves 1667 ns"),
        ("runtime.devices=[tpu]", "runtime.devices.0 = 'tpu'"),
        ("runtime.sample=3", "runtime.sample: unknown key, did you mean 'samples'"),
    ],
)
def test_mistakes_are_sentences(change, sentence):
    with pytest.raises(ExperimentError) as caught:
        load_study(FILE, None, [change])
    assert any(fault.startswith(sentence) for fault in caught.value.faults), caught.value.faults


@pytest.mark.slow
def test_the_small_scale_runs(tmp_path):
    places = [f"outputs.store={tmp_path / 'store'}", f"outputs.runs={tmp_path / 'runs'}"]
    run = run_study(load_study(FILE, "small", places), Budget(workers=1))
    claims = {claim.name: claim for claim in evaluate_folder(run.folder).verdicts}
    assert 0 < claims["sum-dominates-step"].measured < 1
    assert claims["memory-grows-like-basis"].verdict != "not evaluated"
