"""Import TensorFlow without its start-up messages, and without Keras."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

KERAS = "TF_USE_LEGACY_KERAS"


def load_tensorflow() -> None:
    """Import TensorFlow without what its native code writes to standard error before any setting is heeded.

    Its import would import Keras, and with it scikit-learn. `tf.keras` imports it when it is used.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    if "tensorflow" in sys.modules:
        return
    with _without_keras(), _silent():
        importlib.import_module("tensorflow")


@contextmanager
def _without_keras() -> Iterator[None]:
    """Let TensorFlow look for the Keras of old, which is not installed; not so later, when `tf.keras` is used."""
    given = KERAS in os.environ
    os.environ.setdefault(KERAS, "1")
    try:
        yield
    finally:
        if not given:
            del os.environ[KERAS]


@contextmanager
def _silent() -> Iterator[None]:
    """Discard what is written to standard error within the block."""
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
