"""What all tests share: small observations and runs."""

from __future__ import annotations

import base64
import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
if "PYTEST_XDIST_WORKER" in os.environ:
    # One core for each of pytest's processes: threads of several would wait for one another.
    for library in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "TF_NUM_INTRAOP_THREADS", "TF_NUM_INTEROP_THREADS"):
        os.environ.setdefault(library, "1")

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from observations import small_instrument
from pyuvdata import UVData

from calstudy.instrument.telescope import make_template

# How long an example takes is the machine's affair: a busy one fails hypothesis' deadline of 0.2 s, and no property.
# Fifty examples, other ones in every run.
settings.register_profile("any-machine", max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any-machine")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add where notebooks are left as they ran, from where the documentation takes their outputs."""
    parser.addoption("--notebook-outputs", metavar="FOLDER", help="write notebooks that were run to this folder")


LONGEST = {
    *("test_ladder.py", "test_comparison.py", "test_signal_loss.py", "test_observed.py", "test_regression.py"),
    *("test_cli.py", "test_golden_keys.py"),
}
"""Files that take longest, or long and come late: begun last, one would run alone when all others are done."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first; the processes of pytest-xdist take files in the order of collection."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


def pytest_collection_finish() -> None:
    """Take what is imported by now out of garbage collections, and collect more rarely than after 700 new objects.

    Collections would look at all objects of all libraries, and more are imported by tests: they took 7 % of the time.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR4nGP4z8DwHwAFAAH/iZk9HQAAAABJRU5ErkJggg=="
)


def save_blank(figure: Figure, stream: IO[bytes], **settings: Any) -> None:
    """Write a picture of one pixel."""
    stream.write(PNG)


def save_once(drawn: set[str]) -> Callable[..., None]:
    """Return what draws the first picture of each name and format, and writes pictures of one pixel after it."""
    draw = Figure.savefig

    def save(figure: Figure, stream: IO[bytes], **settings: Any) -> None:
        # `replacing` writes to a hidden file, the name of the picture followed by a dash and random digits.
        picture = Path(stream.name).name.rpartition("-")[0]
        if picture in drawn:
            save_blank(figure, stream)
        else:
            drawn.add(picture)
            draw(figure, stream, **settings)

    return save


@pytest.fixture(autouse=True, scope="module")
def blank_pictures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Save figures as pictures of one pixel, but for tests/figures; where `DRAWN` is true, each name is drawn once.

    Laying out and saving figures is most of what a small study takes. They are still made, from the same arrays. With
    `DRAWN`, all are laid out.
    """
    if request.path.parent.name == "figures":
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        if getattr(request.module, "DRAWN", False):
            patch.setattr(Figure, "savefig", save_once(set()))
        else:
            patch.setattr(Figure, "savefig", save_blank)
            # Figures are laid out before they are saved.
            patch.setattr(ConstrainedLayoutEngine, "execute", lambda engine, figure: None)
        yield


@pytest.fixture(scope="session")
def shared_store(tmp_path_factory) -> Path:
    """A store for runs of the tiny experiment that may find products made: those of all files share what is the same.

    Without it every run would simulate, and most would calibrate, the same again. Processes of pytest-xdist share it.
    """
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    folder = folder / "shared-store"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture
def template() -> UVData:
    """A small observation without data."""
    return make_template(small_instrument())


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in every run."""
    return np.random.default_rng(20220422)
