"""Configuration of the documentation site: ``sphinx-build -W -c docs . build/site`` in the root of a checkout."""

from __future__ import annotations

import re
from functools import cached_property
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

import nbformat

from calstudy.studies.reference import field_reference
from calstudy.studies.scores import leaderboard

NOTEBOOK_OUTPUTS = Path(__file__).parents[1] / "build" / "notebooks"
"""Where `pytest -m notebook --notebook-outputs build/notebooks` leaves the notebooks as it ran them."""

project = "calstudy"
author = "The calstudy developers"
copyright = author
version = release = version_of("calstudy")

extensions = [
    "myst_nb",
    "sphinx.ext.apidoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
]
# The root of the checkout is the source, so that pages may link experiments, figures and notebooks.
root_doc = "docs/index"
include_patterns = [
    "docs/**",
    "notebooks/*.ipynb",
    "benchmarks/README.md",
    "figures/*.md",
    "figures/*/*.md",
    "experiments/validation/README.md",
    "data/README.md",
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
]
exclude_patterns = ["docs/api/modules.rst"]

html_theme = "furo"
html_title = "calstudy"
html_static_path = ["static"]
html_css_files = ["dark.css"]
html_search_scorer = str(Path(__file__).parent / "static" / "search.js")

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
# Notebooks are run by tests, at a reduced scale; see `show_outputs`.
nb_execution_mode = "off"

apidoc_modules = [
    {
        "path": "../calstudy",
        "destination": "docs/api",
        "exclude_patterns": [
            f"**/{name}/**" for name in ("published", "cli", "papers", "regression", "report", "validation")
        ],
        # Attributes of a class are described in its docstring, and not once more as its members.
        "automodule_options": ["members", "show-inheritance"],
        "separate_modules": True,
        "module_first": True,
        "implicit_namespaces": True,
    }
]
autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_rtype = False
suppress_warnings = ["ref.python"]


def escape_mathematics(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Let bars and stars of formulas, such as ``|b|`` and ``g_a g_b*``, stand for themselves outside literals."""
    for number, line in enumerate(lines):
        parts = re.split(r"(``.*?``)", line)
        lines[number] = "".join(
            part if part.startswith("``") else re.sub(r"(?<!\\)([|*])", r"\\\1", part) for part in parts
        )


def skip_values(app: Any, what: str, name: str, thing: Any, skip: bool, options: Any) -> bool | None:
    """Leave out attributes of classes other than methods and properties: the class describes them."""
    computed = callable(thing) or isinstance(thing, property | cached_property)
    return None if computed or what != "class" else True


def show_outputs(app: Any, docname: str, source: list[str]) -> None:
    """Give a notebook the outputs that its test left, if any, and say on the page at which scale they were made."""
    if not docname.startswith("notebooks/"):
        return
    executed = NOTEBOOK_OUTPUTS / f"{Path(docname).name}.ipynb"
    app.env.note_dependency(str(executed))
    notebook = nbformat.reads(source[0], as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    told = "The cells of this page were not run when the site was built, so that there are no outputs."
    if executed.is_file():
        ran = [cell for cell in nbformat.read(executed, as_version=4).cells if cell.cell_type == "code"]
        given = [cell for cell in ran if "injected-parameters" in cell.metadata.get("tags", [])]
        ran = [cell for cell in ran if cell not in given]
        # Outputs of an earlier version of the notebook are not shown.
        if [cell.source for cell in ran] == [cell.source for cell in code]:
            for cell, its in zip(code, ran, strict=True):
                cell.outputs, cell.execution_count = its.outputs, its.execution_count
            told = _scale(given[0].metadata["reduced"])
    notebook.cells.insert(1, nbformat.v4.new_markdown_cell(f"```{{note}}\n{told}\n```"))
    source[0] = nbformat.writes(notebook)


def _scale(reduced: list[str]) -> str:
    """Say at which scale outputs were made."""
    if not reduced:
        return "The outputs on this page are those of the notebook as it is."
    listed = "\n".join(f"- `{field}`" for field in reduced)
    return (
        "The outputs on this page were made at a reduced scale, for which these fields were set besides. Numbers and "
        f"conclusions in the text are those of the notebook as it is.\n\n{listed}"
    )


def write_generated_pages(app: Any) -> None:
    """Write the reference of fields and the leaderboard, unless they are there as they should be."""
    docs = Path(__file__).parent
    pages = {"experiments.md": field_reference(), "leaderboard.md": leaderboard(docs / "challenge")}
    for name, text in pages.items():
        page = docs / name
        if not page.is_file() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def setup(app: Any) -> None:
    """Register what happens to generated pages, notebooks and docstrings."""
    app.connect("builder-inited", write_generated_pages)
    app.connect("source-read", show_outputs)
    app.connect("autodoc-skip-member", skip_values)
    app.connect("autodoc-process-docstring", escape_mathematics, priority=100)
