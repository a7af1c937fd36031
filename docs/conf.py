"""Configuration of the documentation site: ``sphinx-build -W -c docs . build/site`` in the root of a checkout."""

from __future__ import annotations

import re
from functools import cached_property
from importlib.metadata import version as version_of
from typing import Any

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
    "figures/*.md",
    "figures/*/*.md",
    "data/README.md",
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
]
exclude_patterns = ["docs/api/modules.rst"]

html_theme = "furo"
html_title = "calstudy"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
# Notebooks are run by tests, at a reduced scale.
nb_execution_mode = "off"

apidoc_modules = [
    {
        "path": "../calstudy",
        "destination": "docs/api",
        "exclude_patterns": [
            f"**/{name}/**" for name in ("published", "bench", "cli", "papers", "regression", "report", "validation")
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


def setup(app: Any) -> None:
    """Register what happens to docstrings."""
    app.connect("autodoc-skip-member", skip_values)
    app.connect("autodoc-process-docstring", escape_mathematics, priority=100)
