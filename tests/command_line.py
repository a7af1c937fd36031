"""The command line, run in the process of a test."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from calstudy.cli import main as cli


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in the block if it takes longer: a command that hangs fails its test, and not the suite."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"not done after {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def run_command(capsys, *arguments: object) -> tuple[int, str]:
    """Run ``calstudy ARGUMENTS``; return its exit status and what it wrote to standard error."""
    status, written = run_and_read(capsys, *arguments)
    return status, written.err


def run_and_read(capsys, *arguments: object):
    """Run ``calstudy ARGUMENTS``; return its exit status and what it wrote to standard output and error."""
    before = sys.argv
    sys.argv = ["calstudy", *map(str, arguments)]
    try:
        cli.main(leave=sys.exit)
        status = 0
    except SystemExit as end:
        status = int(end.code or 0)
    finally:
        sys.argv = before
    return status, capsys.readouterr()
