"""Keep page faults out of measured times."""

from __future__ import annotations

import ctypes
import sys

TRIM_THRESHOLD, MMAP_MAX = -1, -4
"""Parameters of mallopt in the GNU C library."""


def keep_freed_memory() -> bool:
    """Let the C library keep what is freed, so that the next temporary of its size is there at once.

    A step with large temporaries is otherwise given fresh pages by the operating system at every call, which takes a
    fifth of the step's arithmetic on one day and three times as much on another.

    Returns
    -------
    Whether the C library can be told so; it is that of GNU/Linux.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and all((mallopt(MMAP_MAX, 0), mallopt(TRIM_THRESHOLD, 2**31 - 1)))
