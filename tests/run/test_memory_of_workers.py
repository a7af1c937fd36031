"""Worker processes use the memory of freed arrays again, and give it back after a product."""

import platform
import resource

import numpy as np
import pytest

from calstudy.base.resources import release_memory, resident_memory
from calstudy.run.execution import _local_client

NUMBERS, BYTES = 25_000_000, 2e8


def allocate():
    """Page faults of five arrays after a first one, and the memory that is given back after them."""
    np.ones(NUMBERS)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(5):
        np.ones(NUMBERS)
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    kept = resident_memory()
    release_memory()
    return faults, kept - resident_memory()


def has_settings():
    """Whether the C library has the settings of `ALLOCATION`."""
    name, version = platform.libc_ver()
    return name == "glibc" and tuple(map(int, version.split("."))) >= (2, 35)


@pytest.mark.skipif(not has_settings(), reason="these are settings of glibc 2.35 and later")
def test_large_arrays_take_the_memory_of_freed_ones(tmp_path, monkeypatch):
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    with _local_client(2, tmp_path / "run.log") as client:
        faults, returned = client.submit(allocate).result()
    # New memory would be 100 huge pages for each array, or 49,000 of the usual ones.
    assert faults < 100
    assert returned > 0.9 * BYTES
