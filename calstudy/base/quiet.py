"""TensorFlow: whether it is there, and its import without start-up messages."""

from __future__ import annotations

import importlib
import os
import sys
from importlib.util import find_spec

from calstudy.base.errors import InputError


def require_tensorflow() -> None:
    """Raise InputError if TensorFlow is not installed; imports nothing."""
    if find_spec("tensorflow") is None:
        raise InputError(
            "TensorFlow is not installed: pip install 'calstudy[cpu]', or 'calstudy[gpu]' for TensorFlow with CUDA"
        )


def load_tensorflow(threads: int | None = None) -> None:
    """Import TensorFlow without what its native code writes to standard error before any setting is heeded.

    Parameters
    ----------
    threads
        Processor cores that it, and numerical libraries loaded from now on, may use; all by default.

    Raises
    ------
    InputError
        If it is not installed.
    """
    require_tensorflow()
    if threads is not None:
        for name in ("OMP_NUM_THREADS", "TF_NUM_INTRAOP_THREADS", "TF_NUM_INTEROP_THREADS"):
            os.environ[name] = str(threads)
        if threads == 1:
            os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
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
