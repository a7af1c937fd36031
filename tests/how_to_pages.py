"""The pages of docs/how-to as a user follows them: files are written, and commands run, as they are printed.

``python tests/how_to_pages.py FOLDER [PAGE ...]`` follows them in FOLDER and replaces their figures in docs/figures.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from PIL import Image

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(path for path in (DOCS / "how-to").glob("*.md") if path.stem != "index")
BLOCK = re.compile(r"(?:^`(?P<name>[\w.-]+)`:\n\n)?^```(?P<language>\w+)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL)
AFTER = re.compile(r"^In the folder of \[[^\]]+\]\((?P<page>[\w-]+\.md)\), after its run:$", re.MULTILINE)
FIGURE = re.compile(r"`(?P<made>\S+\.png)`:\n\n!\[[^\]]+\]\((?P<shown>\.\./figures/\S+\.png)\)")
WIDTH = 1000
"""Of a figure on a page, in pixels."""
COLOURS = 128


@dataclass(frozen=True)
class HowTo:
    """What a page tells its reader to do.

    Attributes
    ----------
    name
        Of the page.
    files
        Contents of the files that it shows, by their names, which stand before the blocks; and of those of the page in
        whose folder it goes on.
    script
        Its blocks of bash, in order, after those of that page.
    figures
        Where a figure of the page is made (a pattern), by the file that the page shows.
    """

    name: str
    files: dict[str, str]
    script: str
    figures: dict[Path, str]


def read_page(path: Path) -> HowTo:
    """Return what a page tells its reader to do."""
    text = path.read_text(encoding="utf-8")
    blocks = list(BLOCK.finditer(text))
    files = {block["name"]: block["text"] for block in blocks if block["name"]}
    script = "".join(block["text"] for block in blocks if block["language"] == "bash")
    if after := AFTER.search(text):
        first = read_page(path.with_name(after["page"]))
        files, script = {**first.files, **files}, first.script + script
    figures = {(path.parent / found["shown"]).resolve(): found["made"] for found in FIGURE.finditer(text)}
    return HowTo(path.stem, files, script, figures)


def follow(page: HowTo, folder: Path, store: Path) -> dict[Path, Path]:
    """Write the files of a page into a folder, run its commands there, and return its figures as they were made.

    Parameters
    ----------
    page
        The page.
    folder
        New or empty.
    store
        Of the products, which pages share.
    """
    folder.mkdir(parents=True, exist_ok=True)
    store.mkdir(parents=True, exist_ok=True)
    (folder / "store").symlink_to(store.resolve())
    for name, text in page.files.items():
        (folder / name).write_text(text, encoding="utf-8")
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    subprocess.run(["bash", "-ec", page.script], cwd=folder, env={**os.environ, "PATH": path}, check=True)
    made = {}
    for shown, pattern in page.figures.items():
        [made[shown]] = folder.glob(pattern)
    return made


def publish(made: Path, shown: Path) -> None:
    """Write a figure as the page shows it: of moderate size, and with few colours."""
    picture = Image.open(made).convert("RGB")
    if picture.width > WIDTH:
        picture = picture.resize((WIDTH, round(picture.height * WIDTH / picture.width)), Image.Resampling.LANCZOS)
    buffer = BytesIO()
    picture.quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(buffer, "png", optimize=True)
    shown.parent.mkdir(parents=True, exist_ok=True)
    shown.write_bytes(buffer.getvalue())


def main(folder: str, *names: str) -> None:
    """Follow pages, by default all, and replace their figures."""
    for path in PAGES:
        if not names or path.stem in names:
            page = read_page(path)
            for shown, made in follow(page, Path(folder, page.name), Path(folder, "store")).items():
                publish(made, shown)
                print(f"{made} -> {shown}")


if __name__ == "__main__":
    main(*sys.argv[1:])
