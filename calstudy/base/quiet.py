"""Libraries without their messages: TensorFlow's at its import, also without Keras, and warnings of others."""

from __future__ import annotations

import importlib
import logging
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from calstudy.base.errors import InputError

KERAS = "TF_USE_LEGACY_KERAS"


def require_tensorflow() -> None:
    """Raise InputError if TensorFlow is not installed, without importing it."""
    if find_spec("tensorflow") is None:
        raise InputError(
            "TensorFlow is not installed: pip install 'calstudy[cpu]', or 'calstudy[gpu]' for TensorFlow with CUDA"
        )


def load_tensorflow() -> None:
    """Import TensorFlow without the messages that its native code prints before any setting takes effect.

    Its import would import Keras, and with it scikit-learn. `tf.keras` imports it when it is used. Raises InputError if
    it is not installed.
    """
    require_tensorflow()
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # A process takes all memory of a GPU by default, and the workers of a run share one.
    os.environ.setdefault("TF_FORCE_GPU_ALLOW_GROWTH", "true")
    if "tensorflow" in sys.modules:
        return
    with _without_keras(), errors_written_to(Path(os.devnull)):
        importlib.import_module("tensorflow")
    logging.getLogger("tensorflow").addFilter(_is_not_about_tracing)


def _is_not_about_tracing(record: logging.LogRecord) -> bool:
    """Return False for a warning that does not apply: each fit structure is traced once, and TensorFlow counts all."""
    return "triggered tf.function retracing" not in record.getMessage()


@contextmanager
def _without_keras() -> Iterator[None]:
    """Let TensorFlow look for the legacy Keras, which is not installed; later uses of `tf.keras` are not affected."""
    given = KERAS in os.environ
    os.environ.setdefault(KERAS, "1")
    try:
        yield
    finally:
        if not given:
            del os.environ[KERAS]


@contextmanager
def without_warnings() -> Iterator[None]:
    """Ignore warnings within the block, such as those of a library that divides by zero, and replaces the result."""
    import numpy as np

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        yield


def write_errors_to(path: Path) -> None:
    """Append the standard error of this process and its libraries to a file from now on."""
    with path.open("a") as file:
        os.dup2(file.fileno(), 2)


@contextmanager
def errors_written_to(path: Path) -> Iterator[None]:
    """Append the standard error within the block to a file."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        write_errors_to(path)
        yield
    finally:
        sys.stderr.flush()
        os.dup2(kept, 2)
        os.close(kept)
