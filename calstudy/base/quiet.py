"""Detection of TensorFlow, and its import without start-up messages and without Keras."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

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
    if "tensorflow" in sys.modules:
        return
    with _without_keras(), _silent():
        importlib.import_module("tensorflow")


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
def _silent() -> Iterator[None]:
    """Discard output to standard error within the block."""
    sys.stderr.flush()
    kept = os.dup(2)
    silence = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(silence, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(silence)
