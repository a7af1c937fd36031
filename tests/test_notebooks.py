"""The notebooks are stored without outputs, and run from top to bottom."""

import ast
import json
import re
from pathlib import Path

import nbformat
import numpy as np
import pandas
import pytest

import calstudy
from calstudy.experiment.files import parse_override

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
EXPERIMENTS = NOTEBOOKS.parent / "experiments"
REDUCED = {
    "first-study": ["instrument.times.count=3", "sky.foregrounds.count=500", "sky.eor.nside=16"],
    "hera19": [
        "observed.select.antennas='9,10,20,22,31,43,53,64,65,72'",
        "observed.select.frequencies=138.5 MHz..144 MHz",
        "injection.eor.nside=16",
        "injection.simulation.chunks=1",
    ],
    "own-calibrator": ["instrument.times.count=2", "sky.eor.nside=16", "outputs.figures=[]"],
    "signal-loss": [
        "instrument.times.count=2",
        "sky.foregrounds.count=300",
        "sky.eor.nside=16",
        "sweep=["
        "{calibration.basis.buffer: [50 ns, 200 ns]},"
        "{instrument.channels.count: [64, 128]},"
        "{instrument.channels: [{width: 240 kHz, count: 128}, {width: 480 kHz, count: 64}]},"
        "{instrument.layout: [mwa-compact-minredundant], instrument.layout.count: [7, 10]},"
        "{instrument.layout: [mwa-compact-hex-east], instrument.layout.count: [10],"
        " calibration.calibrator: [calamity, calamity-redundant]},"
        "{corruption.eor_level: [-50 dB, -40 dB]},"
        "{sky.eor.seed: [2, 3]}]",
    ],
    "which-calibration": [
        "instrument.times.count=2",
        "worlds={ideal: {}, 'coupling: 0.001': {corruption.effects: [{kind: mutual-coupling, amplitude: 1.0e-3}]}}",
    ],
}
"""Fields that make each notebook's experiments quick, on top of what it does itself."""

notebooks = pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)


@notebooks
def test_a_notebook_is_stored_clean(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert code
    assert all(cell.outputs == [] and cell.execution_count is None for cell in code)
    assert sum("parameters" in cell.metadata.get("tags", []) for cell in code) == 1
    for cell in code:
        ast.parse(cell.source)


@pytest.mark.notebook
@notebooks
def test_a_notebook_runs(path, tmp_path, request):
    """Parameters are injected as papermill does: by a cell after the tagged one."""
    nbclient = pytest.importorskip("nbclient", reason="needs the extra [docs]")
    notebook = nbformat.read(path, as_version=4)
    place = next(i for i, cell in enumerate(notebook.cells) if "parameters" in cell.metadata.get("tags", []))
    overrides = [
        f"outputs.store={tmp_path / 'store'}",
        f"outputs.runs={tmp_path / 'runs'}",
        *REDUCED.get(path.stem, []),
    ]
    changes = dict(map(parse_override, overrides))
    values = f"EXPERIMENTS = {str(EXPERIMENTS)!r}\nOVERRIDES = {changes!r}\nWORKERS = 1"
    told = {"tags": ["injected-parameters"], "reduced": REDUCED.get(path.stem, [])}
    notebook.cells.insert(place + 1, nbformat.v4.new_code_cell(values, metadata=told))
    nbclient.NotebookClient(notebook, timeout=1200, resources={"metadata": {"path": str(tmp_path)}}).execute()
    images = [
        output
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
        if "image/png" in output.get("data", {})
    ]
    assert images
    if folder := request.config.getoption("--notebook-outputs"):
        Path(folder).mkdir(parents=True, exist_ok=True)
        # Outputs name folders of the test where a reader's lie beside the notebooks.
        text = nbformat.writes(notebook).replace(str(tmp_path), "..")
        (Path(folder) / path.name).write_text(text, encoding="utf-8")


def test_a_calibrator_is_chosen_only_if_its_bias_is_known_to_be_small(tmp_path, capsys):
    """The cells after the run, on scores that are made up; the limit is 0.1: with an error of 0.04 all is open."""

    def case(transfer, bias, error):
        measured = {"transfer": transfer, "transfer_error": 0.01, "bias": bias, "bias_error": error}
        bands = [{"k": k, **measured} for k in ([0.1, 0.2], [0.2, 0.5], [0.5, 1.0])]
        return {"bands": bands, "by_status": {"converged": 4}, "sky_model_error": 0.25}

    good = {"small": case(0.5, 0.01, 0.01), "larger": case(0.6, -0.01, 0.01), "noisy": case(0.9, 0.05, 0.04)}
    table = {
        "ideal": good | {"biased": case(0.95, 0.0, 0.01)},
        "missing": good | {"biased": case(0.95, 3.0, 0.2), "small": case(0.4, 0.01, 0.01)},
        "coupling: 0.001": {name: case(0.9, 1e6, 1.0) for name in (*good, "biased")},
    }
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "comparison.json").write_text(json.dumps(table))
    rows = [
        (world, calibrator, band["k"][0], *list(band.values())[1:], 0.25, "4 converged")
        for world, found in table.items()
        for calibrator, one in found.items()
        for band in one["bands"]
    ]
    columns = ("world", "calibrator", "k from [h/Mpc]", "transfer", "transfer error", "bias", "bias error")
    written = pandas.DataFrame(rows, columns=[*columns, "sky model error", "solves"])
    written.to_csv(tmp_path / "tables" / "comparison.csv", index=False)
    (tmp_path / "manifest.json").write_text(json.dumps({"name": "made-up"}))
    cells = {cell.id: cell.source for cell in nbformat.read(NOTEBOOKS / "which-calibration.ipynb", as_version=4).cells}
    names = {"run": calstudy.open_run(tmp_path), "rows": range(18), "np": np}
    for cell in ("which-09", "which-15"):
        exec(cells[cell], names)
    chosen = names["chosen"].loc[(0.1, 0.2)]
    assert dict(chosen.standing) == {"small": "passes", "larger": "passes", "noisy": "open", "biased": "fails"}
    assert dict(chosen.worlds)["biased"] == ["missing"]
    assert chosen.transfer["small"] == 0.4
    everywhere = eval(cells["which-11"], names).loc[(0.1, 0.2)]
    assert set(everywhere.standing) == {"fails"}
    capsys.readouterr()
    exec(cells["which-17"], names)
    told = capsys.readouterr().out
    assert "missing: the sky model is off by 25.0 %" in told
    assert re.search(r"biased +3 +0\.2 +0\.95 +3 +0\.2 +0\.95", told)
