"""Errors that a user can correct: their text is one clear sentence, shown without a traceback."""

from __future__ import annotations

import difflib


class InputError(ValueError):
    """Something the user gave (a field, a file, a path) cannot be used; the message says what is allowed."""


class ExperimentError(InputError):
    """An experiment file has one or more faults, one sentence each in `faults`."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = faults

    def __reduce__(self) -> tuple:
        return type(self), (self.faults,)


def nearest(word: object, allowed: list[str]) -> str:
    """Return ``", did you mean 'x'?"`` for the closest allowed word, or an empty string if none is close."""
    close = difflib.get_close_matches(word, allowed, n=1, cutoff=0.6) if isinstance(word, str) else []
    return f", did you mean {close[0]!r}?" if close else ""
