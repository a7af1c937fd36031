"""Hashes of files and of JSON, and files that are written completely or not at all."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache, wraps
from pathlib import Path
from typing import IO, Any, Concatenate, ParamSpec, TypeVar
from uuid import uuid4

P = ParamSpec("P")
R = TypeVar("R")
FileReader = Callable[Concatenate[Path, P], R]


def kept_while_unchanged(size: int) -> Callable[[FileReader[P, R]], FileReader[P, R]]:
    """Keep the last results of a function of a file, its first argument, while the file does not change."""

    def decorate(function: FileReader[P, R]) -> FileReader[P, R]:
        @lru_cache(size)
        def kept(modified: int, n_bytes: int, path: Path, *args: P.args, **options: P.kwargs) -> R:
            del modified, n_bytes
            return function(path, *args, **options)

        @wraps(function)
        def read(path: Path, *args: P.args, **options: P.kwargs) -> R:
            state = path.stat()
            # The type of lru_cache does not know that all arguments can be hashed.
            return kept(state.st_mtime_ns, state.st_size, path, *args, **options)  # type: ignore[arg-type]

        return read

    return decorate


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file's content, in hexadecimal, without a cache."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def digest_json(value: Any) -> str:
    """Return a 32-digit key of any JSON-able value, which does not depend on the order of keys in it."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def json_number(value: float) -> float | None:
    """Return a number for JSON: None if it is not finite."""
    return float(value) if math.isfinite(value) else None


def rounded(values: Iterable[float]) -> list[float | None]:
    """Return numbers for JSON with five digits: None where they are not finite."""
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in values]


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Open a stream whose content replaces `path` when the block ends without error."""
    partial_file = path.with_name(f".{path.name[:100]}-{uuid4().hex}")
    try:
        with partial_file.open("xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        partial_file.replace(path)
    finally:
        partial_file.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file completely or not at all; what is no file, such as a pipe, is written as it is."""
    target = path.resolve()
    if target.exists() and not target.is_file():
        target.write_text(text, encoding="utf-8")
        return
    with replacing(target) as stream:
        stream.write(text.encode())
