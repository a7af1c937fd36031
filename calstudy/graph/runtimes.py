"""The graph of a run-time study: one product of measurements per array and device, and what is made of them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

from calstudy.experiment.runtime import RuntimeStudy
from calstudy.graph.tasks import Task, unique

PANELS = ("rows", "line")
"""Families of arrays, each with a figure: rows of eight of growing number, lines of growing length."""


class RuntimeGraph:
    """The tasks of a run-time study.

    Parameters
    ----------
    study
        Validated.
    machine
        What the measurements belong to: part of their keys, so that those of another machine are not taken for them.
    """

    def __init__(self, study: RuntimeStudy, machine: Mapping[str, Any]) -> None:
        self.study = study
        self.machine = dict(machine)
        self._settings = study.model_dump(mode="json")["runtime"]

    def _array(self, layout: Mapping[str, Any]) -> dict[str, Any]:
        return {"layout": dict(layout), "channels": self._settings["channels"], "basis": self._settings["basis"]}

    def _rows(self, antennas: int) -> dict[str, Any]:
        rows = self._settings["rows"]
        layout = {"kind": "rectangular", "count": antennas}
        return self._array({**layout, "spacing": rows["spacing"], "max_baseline": rows["max_baseline"]})

    def _line(self, length: float) -> dict[str, Any]:
        count = self._settings["line"]["count"]
        return self._array({"kind": "linear", "count": count, "spacing": f"{length / (count - 1):.15g} m"})

    @cached_property
    def arrays(self) -> dict[str, tuple[str, float, dict[str, Any]]]:
        """What is timed: panel, size, and the array's sections, by a name that sorts."""
        settings = self.study.runtime
        rows = {f"rows-{count:05d}": ("rows", float(count), self._rows(count)) for count in settings.rows.antennas}
        line = {f"line-{length:09.3f}": ("line", float(length), self._line(length)) for length in settings.line.lengths}
        return rows | line

    @cached_property
    def timings(self) -> dict[str, Task]:
        """The measurements, by name of the array and device."""
        return {f"{name}-{device}": self._timing(name, device) for name in self.arrays for device in self.devices}

    @property
    def devices(self) -> tuple[str, ...]:
        """On which is measured."""
        return self.study.runtime.devices

    def _timing(self, name: str, device: str) -> Task:
        panel, size, array = self.arrays[name]
        label = f"{size:g} antennas" if panel == "rows" else f"line of {size:g} m"
        settings = {
            "machine": self.machine,
            "panel": panel,
            "size": size,
            "longest": self.study.runtime.rows.max_baseline if panel == "rows" else size,
            "array": array,
            "samples": self._settings["samples"],
            "device": device,
        }
        return Task("step-times", f"{label}, {device}", settings)

    @cached_property
    def descent(self) -> Task:
        """How the paper's solver approaches the minimum."""
        descent = self._settings["descent"]
        settings = {"array": self._rows(descent["antennas"]), "max_steps": descent["max_steps"]}
        return Task("descent", f"Adamax, {descent['antennas']} antennas", settings)

    @cached_property
    def summary(self) -> Task:
        """The table of all measurements."""
        return Task("runtime", "run times", {"machine": self.machine}, {**self.timings, "descent": self.descent})

    @cached_property
    def figures(self) -> list[Task]:
        """Time per step against the number of antennas, and against the longest baseline."""
        return [
            Task(
                "runtime-figure", f"run time, {panel}", {"panel": panel, "notes": list(self.footnotes)}, self._of(panel)
            )
            for panel in PANELS
        ]

    def _of(self, panel: str) -> dict[str, Task]:
        return {name: task for name, task in self.timings.items() if task.settings["panel"] == panel}

    @property
    def tables(self) -> list[Task]:
        """The products whose files are the tables of a run."""
        return [self.summary]

    @cached_property
    def claims(self) -> Task:
        """The paper's claims on run time."""
        return Task(
            "runtime-claims",
            "claims",
            {"title": self.study.name, "notes": list(self.footnotes)},
            {"runtime": self.summary},
        )

    @property
    def footnotes(self) -> tuple[str, ...]:
        """What is used in place of the paper's own ingredients; nothing that a run time depends on."""
        return ()

    @cached_property
    def targets(self) -> list[Task]:
        """The products a run is for."""
        return [*self.figures, self.summary, self.claims]

    @cached_property
    def tasks(self) -> list[Task]:
        """All tasks, every one after its inputs."""
        return unique(self.targets)
