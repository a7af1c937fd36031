"""The rungs by name: which products each needs, where its code is, and its version."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

from calstudy.experiment.model import Component, Variant
from calstudy.graph.tasks import PARITIES, Graph, Task

if TYPE_CHECKING:
    from calstudy.validation.evidence import Evidence, Measurement

Needs = Callable[[Graph], dict[str, Task]]


def _power(graph: Graph, *components: Component) -> Task:
    """Return the spectra of components that no gains have touched."""
    variant = Variant(components=components)
    return graph.crossed("+".join(components), {parity: graph.average(variant, parity) for parity in PARITIES})


def _nothing(graph: Graph) -> dict[str, Task]:
    del graph
    return {}


def _noise(graph: Graph) -> dict[str, Task]:
    return {"noise": _power(graph, "noise"), "levels": graph.levels}


def _signal(graph: Graph) -> dict[str, Task]:
    return {"eor": _power(graph, "eor"), "levels": graph.levels}


def _foregrounds(graph: Graph) -> dict[str, Task]:
    return {
        "eor": _power(graph, "eor"),
        "foregrounds": _power(graph, "foregrounds"),
        "both": _power(graph, "foregrounds", "eor"),
    }


def _truth(graph: Graph) -> dict[str, Task]:
    return {"foregrounds": graph.foregrounds, "gains": graph.gains, "levels": graph.levels}


def _corrupted(graph: Graph) -> dict[str, Task]:
    variant = Variant(components=("foregrounds", "noise"), gains=True, calibrate=True)
    data = {parity: graph.data(variant, parity) for parity in PARITIES}
    return {**_truth(graph), **data}


def _spectra(graph: Graph) -> dict[str, Task]:
    return {"spectra": graph.spectra}


def _chain(graph: Graph) -> dict[str, Task]:
    variant = Variant(components=("eor",))
    return {
        "spectra": graph.spectra,
        "transfer": graph.transfer,
        "levels": graph.levels,
        "data": graph.data(variant, "even"),
        "eor": _power(graph, "eor"),
        "residual": graph.power("residual"),
        "left": graph.power("residual_without_eor"),
        "response": graph.transfer.inputs["response"],
    }


@dataclass(frozen=True)
class Rung:
    """How a step is measured.

    Attributes
    ----------
    module
        Of `calstudy.validation`; its function `measure` is imported only when it runs.
    needs
        The products of one experiment that it reads.
    version
        Raised when its results change.
    sections
        Sections of the experiments that it reads.
    """

    module: str
    needs: Needs
    version: int = 1
    sections: tuple[str, ...] = ("calibration", "corruption", "power")

    def load(self) -> Callable[[Evidence], Measurement]:
        """Import and return the function that measures."""
        return import_module(f"calstudy.validation.{self.module}").measure


WITH_SKY = ("calibration", "corruption", "power", "instrument", "sky")

RUNGS: Mapping[str, Rung] = {
    "engines": Rung("engines", _nothing),
    "noise": Rung("noise", _noise, sections=WITH_SKY),
    "flat-signal": Rung("flat_signal", _signal, sections=WITH_SKY),
    "steep-signal": Rung("steep_signal", _signal, sections=WITH_SKY),
    "foregrounds": Rung("foregrounds", _foregrounds, version=2),
    "noiseless": Rung("noiseless", _truth),
    "degeneracies": Rung("degeneracies", _corrupted),
    "basin": Rung("basin", _truth),
    "flags": Rung("flags", _corrupted),
    "low-snr": Rung("low_snr", _spectra),
    "end-to-end": Rung("end_to_end", _spectra),
    "ledger": Rung("ledger", _chain, version=2, sections=WITH_SKY),
}
