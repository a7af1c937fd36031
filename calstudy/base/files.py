"""The hash of a file, and files that are written completely or not at all."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO
from uuid import uuid4


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file's content, in hexadecimal, without a cache."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Open a stream whose content replaces `path` when the block ends without error."""
    partial_file = path.with_name(f".{path.name}-{uuid4().hex}")
    try:
        with partial_file.open("xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        partial_file.replace(path)
    finally:
        partial_file.unlink(missing_ok=True)
