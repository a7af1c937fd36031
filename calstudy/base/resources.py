"""Resources of the machine, and the cost of a piece of work."""

from __future__ import annotations

import os
import re
import threading
import time
from dataclasses import dataclass

import psutil

from calstudy.base.errors import InputError

BYTES = {"MB": 1e6, "GB": 1e9, "TB": 1e12}


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def free_memory() -> int:
    """Return the memory in bytes that is available without swapping."""
    return psutil.virtual_memory().available


def total_memory() -> int:
    """Return the memory of the machine in bytes."""
    return psutil.virtual_memory().total


def parse_memory(text: str) -> float:
    """Return the number of bytes in a text such as ``6 GB`` or ``500MB``.

    Raises InputError if it is not a positive number with one of the units MB, GB, TB.
    """
    found = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*([MGT]B)\s*", text, flags=re.ASCII)
    number = float(found[1]) * BYTES[found[2]] if found else 0.0
    if number <= 0:
        raise InputError(f"--max-memory {text!r}: write a positive number and a unit (MB, GB or TB), such as '6 GB'")
    return number


def resident_memory() -> int:
    """Return the resident memory of this process in bytes."""
    return psutil.Process().memory_info().rss


def cpu_time() -> float:
    """Return the CPU time in seconds of this process so far, and of the finished programs that it started."""
    # os.times counts the process itself in steps of 10 ms on Linux, which is more than some solves take.
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


@dataclass
class Usage:
    """Elapsed seconds, CPU seconds (see `cpu_time`) and peak resident memory (bytes) of a block of code.

    Use it as a context manager; the values are available after the block. The memory is that of this process alone,
    sampled every 50 ms.
    """

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_memory: int = 0

    def __enter__(self) -> Usage:
        self._process = psutil.Process()
        self._done = threading.Event()
        self._start, self._cpu_start = time.perf_counter(), cpu_time()
        self._sampler = threading.Thread(target=self._sample, daemon=True)
        self._sampler.start()
        return self

    def _sample(self) -> None:
        while True:
            self.peak_memory = max(self.peak_memory, self._process.memory_info().rss)
            if self._done.wait(0.05):
                return

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._sampler.join()
        self.seconds = time.perf_counter() - self._start
        self.cpu_seconds = cpu_time() - self._cpu_start


LIBRARIES_MEMORY = 0.8e9
"""Memory in bytes of a process with Python and the libraries alone."""
COMPLEX128, COMPLEX64 = 16, 8
"""Bytes of a complex number."""


@dataclass(frozen=True)
class Cost:
    """Seconds on one core, bytes of memory and bytes of disk, each an estimate within a factor of about two."""

    seconds: float
    memory: float = LIBRARIES_MEMORY
    disk: float = 0.0
