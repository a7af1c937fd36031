"""The command line, run in the process of a test."""

from __future__ import annotations

import sys

from calstudy.cli import main as cli


def run_command(capsys, *arguments: object) -> tuple[int, str]:
    """Run ``calstudy ARGUMENTS``; return its exit status and what it wrote to standard error."""
    before = sys.argv
    sys.argv = ["calstudy", *map(str, arguments)]
    try:
        cli.main()
        status = 0
    except SystemExit as end:
        status = int(end.code or 0)
    finally:
        sys.argv = before
    return status, capsys.readouterr().err
