"""The report of a run as one self-contained HTML page."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any
from uuid import uuid4

from calstudy.base.errors import InputError
from calstudy.report.contents import Contents, read_contents
from calstudy.report.pair import Pair, read_pair
from calstudy.results.folder import RunFolder

REPORT = "report.html"


def render(contents: Contents) -> str:
    """Return the page with its pictures, style and script."""
    return _page("page.html", contents=contents, images=_images(contents))


def render_pair(pair: Pair) -> str:
    """Return the page of two runs side by side."""
    return _page("pair.html", pair=pair, images=[_images(pair.first), _images(pair.second)])


def _page(template: str, **values: Any) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("calstudy.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    css, script = ((Path(__file__).parent / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    return environment.get_template(template).render(css=css, script=script, **values)


def _images(contents: Contents) -> dict[str, str]:
    return {picture.name: base64.b64encode(picture.path.read_bytes()).decode("ascii") for picture in contents.pictures}


def write_report(folder: Path) -> Path:
    """Write report.html into the folder of a finished run, completely or not at all, and return its path.

    Raises InputError for other folders.
    """
    return _write(render(read_contents(RunFolder(folder))), folder / REPORT)


def write_pair(first: Path, second: Path, output: Path, overwrite: bool = False) -> Path:
    """Write the page of two runs, completely or not at all, and return its path.

    Raises InputError if a folder is not that of a finished run, or the file exists and `overwrite` is false.
    """
    if output.exists() and not overwrite:
        raise InputError(f"{output}: exists; choose another --output, or --overwrite it")
    return _write(render_pair(read_pair((first, second))), output)


def _write(page: str, path: Path) -> Path:
    partial = path.with_name(f".{path.name}-{uuid4().hex}")
    try:
        partial.write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    partial.replace(path)
    return path
