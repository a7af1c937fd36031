"""Code is parsed while threads of other packages parse, which some releases of Python do not survive."""

import ast
import contextlib
import gc
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

import pytest

import calstudy
from calstudy.base.user_code import parse

CODES = [path.read_text(encoding="utf-8") for path in sorted(Path(calstudy.__file__).parent.rglob("*.py"))][::3]


class Garbage:
    """An object of a cycle: Python collects it while it parses, and lets another thread go on."""

    def __init__(self):
        self.itself = self

    def __del__(self):
        sum(range(100))


@pytest.fixture
def busy():
    """Threads that change often, with a garbage collector that is always at work."""
    interval, thresholds = sys.getswitchinterval(), gc.get_threshold()
    sys.setswitchinterval(1e-6)
    gc.set_threshold(10)
    yield
    sys.setswitchinterval(interval)
    gc.set_threshold(*thresholds)


@pytest.mark.chain
def test_code_is_parsed_while_another_thread_parses(busy):
    ended = Event()

    def parse_otherwise():
        while not ended.is_set():
            for code in CODES[:20]:
                [Garbage() for _ in range(20)]
                with contextlib.suppress(SystemError):
                    ast.parse(code)

    def parse_here(code):
        [Garbage() for _ in range(20)]
        return len(parse(code).body)

    with ThreadPoolExecutor(4) as threads:
        threads.submit(parse_otherwise)
        try:
            found = list(threads.map(parse_here, CODES))
        finally:
            ended.set()
    assert found == [len(parse(code).body) for code in CODES]
