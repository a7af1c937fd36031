"""Keep the start-up messages of libraries off the terminal."""

from __future__ import annotations

import importlib
import os
import sys


def load_tensorflow() -> None:
    """Import TensorFlow without what its native code writes to standard error before any setting is heeded."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    if "tensorflow" in sys.modules:
        return
    sys.stderr.flush()
    kept = os.dup(2)
    silence = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(silence, 2)
        importlib.import_module("tensorflow")
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(silence)
