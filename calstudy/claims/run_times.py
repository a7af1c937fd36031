"""Run times for statements of papers: the table of a run-time study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from calstudy.products.files import read_json
from calstudy.products.run_times import RUNTIME, PowerLaw, fit_power_law
from calstudy.results.reader import Tables
from calstudy.verdicts.criterion import Finding
from calstudy.verdicts.statement import Unevaluated

RUN_TIME = "run_time"
"""Role of a run-time study."""


@dataclass(frozen=True)
class RunTimes:
    """One run-time study: the name of the run with the machine, and the table of `calstudy.products.run_times`.

    The table has ``cases``, one per array and device, and ``descent``.
    """

    name: str
    table: Mapping[str, Any]

    @classmethod
    def of(cls, name: str, tables: Tables) -> RunTimes:
        """Read the table of a run."""
        table = read_json(tables.path(RUNTIME, "the run has no table of run times"))
        return cls(f"{name} on {machine_in_words(table['machine'])}", table)

    def cases(self, panel: str, device: str = "cpu") -> list[Mapping[str, Any]]:
        """Return the arrays of one panel, the smallest first; raises Unevaluated if that device was not timed."""
        found = [case for case in self.table["cases"] if (case["panel"], case["device"]) == (panel, device)]
        if not found:
            raise Unevaluated(f"needs run times on a {device}; run it with --scale {device} where there is one")
        return sorted(found, key=lambda case: case["size"])

    def medians(self, panel: str, kind: str, device: str = "cpu") -> np.ndarray:
        """Return the median seconds of a kind of step or solve for each array, (Nsizes,).

        The panel is "rows" or "line", the device "cpu" or "gpu".
        """
        return np.array([case["seconds"][kind]["median"] for case in self.cases(panel, device)])

    def column(self, panel: str, name: str, device: str = "cpu") -> np.ndarray:
        """Return a property of each array, (Nsizes,), such as "size"; panel and device as for `medians`."""
        return np.array([case[name] for case in self.cases(panel, device)], float)

    def scaling(self, panel: str, kind: str, against: str = "size", device: str = "cpu") -> PowerLaw:
        """Fit the medians as a power of a property of the arrays; panel, kind and device as for `medians`."""
        return fit_power_law(self.column(panel, against, device), self.medians(panel, kind, device))

    def steps_to(self, excess: str) -> Finding:
        """Return the steps of the paper's solver to within a fraction of the minimum, or its steps as a lower bound."""
        descent = self.table["descent"]
        steps = descent["steps_to"][excess]
        return Finding(descent["max_steps"], 0.0, "at least") if steps is None else Finding(steps, 0.0)


def machine_in_words(machine: Mapping[str, Any]) -> str:
    """Return processor, cores and memory of a machine, and its GPU if it was timed."""
    words = f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gb']} GB"
    return f"{words}, {machine['gpu']}" if machine.get("gpu") else words
