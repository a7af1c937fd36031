"""The table of golden keys, ``golden_keys.txt``: what the published experiments make, and what their plans say.

    python tests/golden_keys.py       writes it again

It has a line for each experiment and stage: how many products there are, a digest of the labels and keys of all of
them, and their cost in a plan: seconds, the largest memory and the disk, bytes. A change of the code that moves no line
makes the same products with the same names from the same settings. Run times are left out: they have the machine in
their keys. So are comparisons with a calibrator whose package is not installed.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

from calstudy.base.files import digest_json
from calstudy.base.package_files import experiment_names
from calstudy.run.task import Task
from calstudy.studies.load import load_study

TABLE = Path(__file__).with_suffix(".txt")
HEADING = (
    "# experiment, stage, products, digest of their labels and keys, seconds, memory, disk; by tests/golden_keys.py"
)


def now() -> dict[tuple[str, str], str]:
    """Return the lines of the table as they are now, by experiment and stage, in the order of the stages."""
    studies = {name: load_study(Path(name)) for name in experiment_names() if name != "runtime"}
    return {
        (name, stage): _line(tasks)
        for name, study in studies.items()
        if not any("not installed" in reason for reason in getattr(study, "refusals", {}).values())
        for stage, tasks in _by_stage(study.tasks).items()
    }


def _by_stage(tasks: list[Task]) -> dict[str, list[Task]]:
    found = defaultdict(list)
    for task in tasks:
        found[task.stage.name].append(task)
    return found


def _line(tasks: list[Task]) -> str:
    digest = digest_json(sorted([task.label, task.key] for task in tasks))[:12]
    costs = [task.cost for task in tasks]
    seconds, disk = (sum(getattr(cost, name) for cost in costs) for name in ("seconds", "disk"))
    # A plan is good to a few digits.
    return f"{len(tasks)} {digest} {seconds:.3g} {max(cost.memory for cost in costs):.3g} {disk:.3g}"


def read() -> dict[tuple[str, str], str]:
    """Read the committed table."""
    lines = (line.split(" ", 2) for line in TABLE.read_text(encoding="utf-8").splitlines()[1:])
    return {(name, stage): rest for name, stage, rest in lines}


if __name__ == "__main__":
    lines = [f"{name} {stage} {rest}" for (name, stage), rest in now().items()]
    TABLE.write_text("\n".join([HEADING, *lines]) + "\n", encoding="utf-8")
