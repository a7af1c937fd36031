"""What the tests of plug-ins share."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_store(tmp_path_factory) -> Path:
    """A store for runs of the tiny experiment with plug-ins, which share all products that a plug-in does not change.

    Without it every run would simulate, and most would calibrate, the same again.
    """
    return tmp_path_factory.mktemp("plugins-store")
