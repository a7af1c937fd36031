"""Errors that a user can mend: their text is one clear sentence, shown without a traceback."""

from __future__ import annotations


class InputError(ValueError):
    """Something the user gave (a field, a file, a path) cannot be used; the message says what is allowed."""


class ExperimentError(InputError):
    """An experiment file has one or more faults, one sentence each in `faults`."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = faults

    def __reduce__(self) -> tuple:
        return type(self), (self.faults,)
