"""Modules that measure in a process of their own, with one thread, whose memory is that of the measured work alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

from calstudy.base.errors import InputError

THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "TF_NUM_INTRAOP_THREADS",
    "TF_NUM_INTEROP_THREADS",
)
ENVIRONMENT = {
    **dict.fromkeys(THREADS, "1"),
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "TF_CPP_MIN_LOG_LEVEL": "3",
    "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
}
"""One thread, no start-up messages, and huge pages for large temporaries where the system has them: handing them out in
small ones can take longer than what is measured."""


def run_module(module: str, request: Mapping[str, Any]) -> dict[str, Any]:
    """Run ``python -m MODULE REQUEST`` and return what it answers, its last line of output, as JSON.

    Raises
    ------
    InputError
        If the process fails, with the last line that it wrote.
    """
    result = subprocess.run(
        [sys.executable, "-m", module, json.dumps(request)],
        env={**os.environ, **ENVIRONMENT},
        capture_output=True,
        text=True,
        check=False,
    )
    if result.returncode:
        reason = (result.stderr.strip().splitlines() or [f"exit status {result.returncode}"])[-1]
        raise InputError(f"the measurement of {json.dumps(request)} failed: {reason}")
    return json.loads(result.stdout.splitlines()[-1])
