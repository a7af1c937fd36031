"""Resources of the machine, and the cost of a piece of work."""

from __future__ import annotations

import ctypes
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
    found = re.fullmatch(r"\s*([0-9.]+)\s*([MGT]B)\s*", text)
    try:
        number = float(found[1]) * BYTES[found[2]] if found else 0.0
    except ValueError:
        number = 0.0
    if number <= 0:
        raise InputError(f"--max-memory {text!r}: write a positive number and a unit (MB, GB or TB), such as '6 GB'")
    return number


def resident_memory() -> int:
    """Return the resident memory of this process in bytes."""
    return psutil.Process().memory_info().rss


ALLOCATION = {
    "GLIBC_TUNABLES": ":".join(
        f"glibc.malloc.{name}={value}"
        for name, value in {"mmap_threshold": 1 << 29, "trim_threshold": 1 << 40, "arena_max": 1, "hugetlb": 1}.items()
    )
}
"""Environment of a process whose arrays of up to half a GB take the memory of freed ones, by glibc 2.35 and later.

By default glibc asks the system for the memory of each array above some MB. To hand it out takes 0.1 s per GB, on
virtual machines up to 2.5 s: more than the arithmetic of stages that go through all visibilities. Larger arrays may be
zeros that nobody reads, as the polarization of a sky, and take no memory of the system. `release_memory` gives back
what is free."""


def release_memory() -> None:
    """Give memory that this process has freed back to the system, where the C library can (glibc)."""
    if (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(0)


def cpu_time() -> float:
    """Return the CPU time in seconds of this process so far, and of the finished programs that it started."""
    # os.times counts the process itself in steps of 10 ms on Linux, which is more than some solves take.
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


@dataclass
class Usage:
    """Elapsed seconds, CPU seconds and peak resident memory (bytes) of a block of code.

    Use it as a context manager; the values are available after the block. CPU seconds are those of all threads of this
    process, and of programs that it started, once it has waited for their end; these are counted in steps of 10 ms on
    Linux, and not at all on Windows. The memory is that of this process alone, sampled every 50 ms.
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
