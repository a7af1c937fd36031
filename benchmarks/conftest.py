"""One thread for every library, and results without the name of the machine or of the folder."""

from __future__ import annotations

import os
from typing import Any

# Before the libraries are imported. Threads that wait for one another use processor time, too.
os.environ.update(
    {
        **{f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")},
        "TF_NUM_INTRAOP_THREADS": "1",
        "TF_NUM_INTEROP_THREADS": "1",
        "TF_CPP_MIN_LOG_LEVEL": "3",
        "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    }
)

import pytest

import calstudy


def pytest_report_header() -> str:
    """Print which copy of the package is measured."""
    return f"calstudy: {calstudy.__file__}"


def pytest_benchmark_update_machine_info(config: pytest.Config, machine_info: dict[str, Any]) -> None:
    """Keep what a run time depends on."""
    processor = machine_info["cpu"].get("brand_raw", "unknown")
    kept = {name: machine_info[name] for name in ("machine", "system", "python_version")}
    machine_info.clear()
    machine_info.update(kept, cpu={"brand_raw": processor})


def pytest_benchmark_update_commit_info(config: pytest.Config, commit_info: dict[str, Any]) -> None:
    """Leave out the name of the checkout's folder and branch."""
    commit_info.pop("project", None)
    commit_info.pop("branch", None)
