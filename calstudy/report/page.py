"""The report of a run as one HTML page that needs nothing besides itself."""

from __future__ import annotations

import base64
from pathlib import Path
from uuid import uuid4

from jinja2 import Environment, PackageLoader, StrictUndefined

from calstudy.report.contents import Contents, read_contents

REPORT = "report.html"


def render(contents: Contents) -> str:
    """Return the page; pictures are part of it."""
    environment = Environment(
        loader=PackageLoader("calstudy.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    images = {
        picture.name: base64.b64encode(picture.path.read_bytes()).decode("ascii") for picture in contents.pictures
    }
    return environment.get_template("page.html").render(contents=contents, images=images)


def write_report(folder: Path) -> Path:
    """Write report.html into a run folder, whole or not at all, and return its path.

    Raises
    ------
    InputError
        If it is not the folder of a finished run.
    """
    page = render(read_contents(folder))
    path = folder / REPORT
    partial = folder / f".{REPORT}-{uuid4().hex}"
    partial.write_text(page, encoding="utf-8")
    partial.replace(path)
    return path
