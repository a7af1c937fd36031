"""One run on several MPI ranks: the first leads it, and the others help where the work can be divided.

Under ``mpiexec -n 8 python -m calstudy run FILE`` rank 0 is an ordinary run in one process. The others wait in `serve`,
sleeping between checks, until rank 0 calls `share`, and leave when rank 0 leaves `leading`, however that ends. All
MPI calls are made in the main thread, so any level of thread support is sufficient.
"""

from __future__ import annotations

import atexit
import logging
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Any

from calstudy.base.errors import InputError

if TYPE_CHECKING:
    from mpi4py import MPI

# Variables in which the launchers of MPICH and Open MPI give a process its rank and the number of ranks.
LAUNCHERS = (("PMI_RANK", "PMI_SIZE"), ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"))
WORK, END = 1, 2
PAUSE = 0.02
"""Seconds between two checks for work: short compared with any simulation, and no load on a core."""
FLUSHED = 1.0
"""Seconds in which the launcher forwards the output of a rank before it aborts."""

EXPECTED = (InputError, MemoryError, OSError)
"""Errors that all ranks survive and rank 0 reports; any other ends all of them."""


def _place() -> tuple[int, int]:
    for rank, size in LAUNCHERS:
        if rank in os.environ and size in os.environ:
            return int(os.environ[rank]), int(os.environ[size])
    return 0, 1


def count() -> int:
    """Return the number of ranks that a launcher started, 1 without a launcher, without importing anything."""
    return _place()[1]


def is_helper() -> bool:
    """Return whether this process is not rank 0, without importing anything."""
    return _place()[0] > 0


def share(work: Callable[..., Any], *arguments: Any) -> list[Any]:
    """Run ``work(rank, size, *arguments)`` on all ranks, and return the results in the order of the ranks.

    `work` is a function of a module. Without a launcher it is run in this process only. Raises InputError if the work
    raises an InputError, MemoryError or OSError on any rank. Any other error is a defect: it shows its traceback and
    ends all ranks.
    """
    if count() == 1:
        return [work(0, 1, *arguments)]
    communicator = _communicator()
    for rank in range(1, communicator.size):
        communicator.send((work, arguments), dest=rank, tag=WORK)
    return _contribute(communicator, work, arguments)


def serve() -> None:
    """Help rank 0 until it leaves `leading`; rank 0 reports the errors that occur here."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Rank 0 gets the same signal, and decides.
    logging.captureWarnings(True)
    communicator = _communicator()
    with _AllOrNone(communicator):
        while True:
            tag = _next_tag(communicator)
            work = communicator.recv(source=0, tag=tag)
            if tag == END:
                return
            try:
                _contribute(communicator, *work)
            except InputError as error:
                logging.getLogger(__name__).info("%s", error)


@contextmanager
def leading() -> Iterator[None]:
    """Release the other ranks when the block ends, with or without an error; without a launcher do nothing."""
    try:
        yield
    finally:
        if count() > 1:
            communicator = _communicator()
            for rank in range(1, communicator.size):
                communicator.send(None, dest=rank, tag=END)


def _communicator() -> MPI.Comm:
    # pyuvsim keeps mpi4py from initializing MPI at import.
    from mpi4py import MPI

    if not MPI.Is_initialized():
        MPI.Init()
        atexit.register(MPI.Finalize)
    return MPI.COMM_WORLD


def _next_tag(communicator: MPI.Comm) -> int:
    from mpi4py import MPI

    status = MPI.Status()
    while not communicator.iprobe(source=0, tag=MPI.ANY_TAG, status=status):
        time.sleep(PAUSE)
    return status.Get_tag()


def _contribute(communicator: MPI.Comm, work: Callable[..., Any], arguments: tuple) -> list[Any]:
    with _AllOrNone(communicator):
        part, fault = None, None
        try:
            part = work(communicator.rank, communicator.size, *arguments)
        except EXPECTED as error:
            fault = str(error) or type(error).__name__
        faults = [reason for reason in communicator.allgather(fault) if reason is not None]
        if faults:
            raise InputError(faults[0])
        return communicator.gather(part, root=0) or []


class _AllOrNone:
    """End all ranks if one has an error that the others do not receive, because they would wait for it forever."""

    def __init__(self, communicator: MPI.Comm) -> None:
        self._communicator = communicator

    def __enter__(self) -> None:
        return None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and not issubclass(kind, InputError):
            if not issubclass(kind, KeyboardInterrupt):
                traceback.print_exception(kind, error, trace)
                # The launcher ends all ranks at once, and output that is not yet written is lost.
                sys.stderr.flush()
                time.sleep(FLUSHED)
            self._communicator.Abort(1)
