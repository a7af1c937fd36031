"""The notebooks are stored without outputs, and run from top to bottom."""

import ast
from pathlib import Path

import nbclient
import nbformat
import pytest

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
    notebook = nbformat.read(path, as_version=4)
    place = next(i for i, cell in enumerate(notebook.cells) if "parameters" in cell.metadata.get("tags", []))
    overrides = [
        f"outputs.store={tmp_path / 'store'}",
        f"outputs.runs={tmp_path / 'runs'}",
        *REDUCED.get(path.stem, []),
    ]
    values = f"EXPERIMENTS = {str(EXPERIMENTS)!r}\nOVERRIDES = {overrides!r}\nWORKERS = 1"
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
