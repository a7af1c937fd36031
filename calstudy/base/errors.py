"""Errors that a user can correct: their text is one clear sentence, shown without a traceback."""

from __future__ import annotations

import difflib
import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager

REFUSALS = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.ENAMETOOLONG,
    errno.ELOOP,
    errno.EIO,
    errno.ESTALE,
)
"""Errors of a file system that a program cannot foresee; a missing file is not one of them."""


class InputError(ValueError):
    """A user's input (a field, a file, a path) cannot be used; the message says what is allowed."""


class ExperimentError(InputError):
    """An experiment file has one or more faults, one sentence each in `faults`."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = faults

    def __reduce__(self) -> tuple:
        return type(self), (self.faults,)


class DiskError(InputError):
    """A file could not be written; files of HDF5 that were open cannot be closed any more, and crash at exit."""


class Terminated(KeyboardInterrupt):
    """The process was asked to end by SIGTERM, as batch systems do."""


def exit_status(error: BaseException | None) -> int:
    """Return the exit status of a command that ends with an error, or without one."""
    kinds = {Terminated: 143, KeyboardInterrupt: 130, InputError: 2, BaseException: 1}
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    return 0 if error is None else next(status for kind, status in kinds.items() if isinstance(error, kind))


@contextmanager
def errors_of_files(sentence: str) -> Iterator[None]:
    """Raise InputError, with a sentence and the reason, for an OSError in the block."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{sentence} ({error.strerror})") from None


def refusal_of_disk(error: OSError | RuntimeError) -> str | None:
    """Return the reason why a file could not be read or written, or None if the file system did not refuse it.

    HDF5 reports a failed write as a RuntimeError or an OSError without errno, with the number in its message.
    """
    number = error_number(error)
    return os.strerror(number) if number in REFUSALS else None


def error_number(error: OSError | RuntimeError) -> int | None:
    """Return the errno of an error, including HDF5 errors, or None if it has none."""
    found = re.search(r"errno = (\d+)", str(error))
    return getattr(error, "errno", None) or (int(found[1]) if found else None)


def nearest(word: object, allowed: list[str]) -> str:
    """Return ``", did you mean 'x'?"`` for the closest allowed word, or an empty string if none is close."""
    close = difflib.get_close_matches(word, allowed, n=1, cutoff=0.6) if isinstance(word, str) else []
    return f", did you mean {close[0]!r}?" if close else ""
