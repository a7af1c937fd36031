"""Run the benchmarks alternately on a commit and on the working tree, and print the ratios of their processor times.

Usage: ``python benchmarks/compare.py COMMIT [--rounds N] [-k EXPRESSION]``. Each commit runs its own benchmarks.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]


def run(tree: Path, result: Path, chosen: str) -> dict[str, float]:
    """Return the shortest time of each benchmark of a checkout, s."""
    command = [sys.executable, "-m", "pytest", "-q", "benchmarks", "-k", chosen, f"--benchmark-json={result}"]
    # Run as a module, Python finds the package of the current folder before the installed one.
    found = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False)
    if found.returncode:
        sys.exit(f"the benchmarks of {tree} failed:\n{found.stdout}{found.stderr}")
    return {item["name"]: item["stats"]["min"] for item in json.loads(result.read_text())["benchmarks"]}


def show(pairs: list[tuple[dict[str, float], dict[str, float]]]) -> None:
    """Print the median times of every benchmark that both have, and the median and the range of their ratios."""
    print("| benchmark | before, CPU s | now, CPU s | now / before (median, range) |")
    print("| --- | --: | --: | --: |")
    for name in pairs[0][0]:
        if name not in pairs[0][1]:
            continue
        before, now = ([pair[index][name] for pair in pairs] for index in (0, 1))
        ratios = [new / old for old, new in zip(before, now, strict=True)]
        print(
            f"| {name} | {statistics.median(before):.3g} | {statistics.median(now):.3g} "
            f"| {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f}) |"
        )


def main() -> None:
    """Check out the commit in a temporary folder, and compare it with the working tree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("commit")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("-k", dest="chosen", default="", help="as for pytest: which benchmarks")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        before = Path(folder) / "before"
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", before, options.commit], cwd=ROOT, check=True)
        try:
            # The order alternates, so that a machine that becomes slower or faster favours neither.
            pairs = []
            for number in range(options.rounds):
                trees = (before, ROOT) if number % 2 == 0 else (ROOT, before)
                times = {tree: run(tree, Path(folder) / "result.json", options.chosen) for tree in trees}
                pairs.append((times[before], times[ROOT]))
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", before], cwd=ROOT, check=True)
    show(pairs)


if __name__ == "__main__":
    main()
