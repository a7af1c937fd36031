"""The site shows the outputs that the tests of the notebooks left, and says at which scale they were made."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace

import nbformat
import pytest

pytest.importorskip("myst_nb")
CONF = Path(__file__).parents[2] / "docs" / "conf.py"
NOTEBOOK = CONF.parents[1] / "notebooks" / "first-study.ipynb"
REDUCED = ["instrument.times.count=3"]


def shown(folder: Path, docname: str = "notebooks/first-study") -> nbformat.NotebookNode:
    """Return the notebook as the site reads it, with executed ones in a folder."""
    noted: list[str] = []
    app = SimpleNamespace(env=SimpleNamespace(note_dependency=noted.append))
    source = [NOTEBOOK.read_text(encoding="utf-8")]
    show = runpy.run_path(str(CONF))["show_outputs"]
    show.__globals__["NOTEBOOK_OUTPUTS"] = folder
    show(app, docname, source)
    assert noted == [str(folder / NOTEBOOK.name)]
    return nbformat.reads(source[0], as_version=4)


def executed(folder: Path) -> nbformat.NotebookNode:
    """Write the notebook as a test of it does, each cell with its number as output."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for number, cell in enumerate(code):
        cell.outputs = [nbformat.v4.new_output("stream", text=f"output {number}")]
    told = {"tags": ["injected-parameters"], "reduced": REDUCED}
    notebook.cells.insert(2, nbformat.v4.new_code_cell("WORKERS = 1", metadata=told))
    nbformat.write(notebook, folder / NOTEBOOK.name)
    return notebook


def outputs(notebook: nbformat.NotebookNode) -> list[str]:
    return [output.text for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def test_outputs_are_shown_with_their_scale(tmp_path):
    executed(tmp_path)
    page = shown(tmp_path)
    code = [cell for cell in page.cells if cell.cell_type == "code"]
    assert outputs(page) == [f"output {number}" for number in range(len(code))]
    assert "WORKERS = 1" not in [cell.source for cell in code]
    assert f"- `{REDUCED[0]}`" in page.cells[1].source
    nbformat.validate(page)


def test_outputs_of_another_version_are_not_shown(tmp_path):
    notebook = executed(tmp_path)
    next(cell for cell in notebook.cells if cell.cell_type == "code").source += "\n# changed"
    nbformat.write(notebook, tmp_path / NOTEBOOK.name)
    page = shown(tmp_path)
    assert outputs(page) == []
    assert "were not run" in page.cells[1].source


def test_a_page_without_outputs_says_so(tmp_path):
    page = shown(tmp_path)
    assert outputs(page) == []
    assert "were not run" in page.cells[1].source
