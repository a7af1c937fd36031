"""The graph of an experiment: which products it needs, and what each is made from."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from calstudy.calibrate.settings import MODELS_AT_ONCE
from calstudy.experiment.model import Component, Experiment, Variant
from calstudy.running.store import digest_file, digest_json
from calstudy.simulate.settings import SimulationSettings

PARITIES = ("even", "odd")
# Inputs of the spectra besides the variants, whose names cannot hold a colon.
EOR_REFERENCE, NOISE_REFERENCE = "reference:eor", "reference:noise"
BEAMS = ("beam", "antenna_beams")
DEFAULT_CHUNKS = SimulationSettings().chunks


@lru_cache(maxsize=64)
def _digest_of(path: str, modified: int, size: int) -> str:
    return digest_file(Path(path))


def identify(settings: Any) -> Any:
    """Replace the path of every input file in nested settings by the digest of its content.

    The same file elsewhere gives the same key, and a changed file under the same name another one.
    """
    if isinstance(settings, Mapping):
        return {key: _identify_item(key, value) for key, value in settings.items()}
    if isinstance(settings, list | tuple):
        return [identify(item) for item in settings]
    return settings


def _identify_item(key: str, value: Any) -> Any:
    if key == "path" and isinstance(value, str):
        status = Path(value).stat()
        return f"sha256:{_digest_of(value, status.st_mtime_ns, status.st_size)}"
    return identify(value)


@dataclass(frozen=True, eq=False)
class Task:
    """One product to be made.

    Attributes
    ----------
    stage
        Name of the stage, an entry of `calstudy.stages.registry.STAGES`.
    label
        What the product is, in a few words.
    settings
        JSON-able: all that the stage reads from the experiment.
    inputs
        The tasks whose products it reads, by the names it knows them under.
    temporary
        Whether the product may be dropped once what needs it is made.
    equivalent
        The task whose product this one's is, to rounding, though made from other pieces: it has that one's key.
    """

    stage: str
    label: str
    settings: Mapping[str, Any]
    inputs: Mapping[str, Task] = field(default_factory=dict)
    temporary: bool = False
    equivalent: Task | None = None

    @cached_property
    def key(self) -> str:
        """The content address: a digest of stage, its version, settings, and the inputs' keys."""
        from calstudy.stages.registry import STAGES

        if self.equivalent is not None:
            return self.equivalent.key
        inputs = {name: task.key for name, task in self.inputs.items()}
        version = STAGES[self.stage].version
        return digest_json([self.stage, version, identify(self.settings), inputs])


def unique(tasks: Iterable[Task]) -> list[Task]:
    """Return tasks and all they need, once each, every task after its inputs."""
    found: dict[str, Task] = {}

    def visit(task: Task) -> None:
        if task.key not in found:
            for needed in task.inputs.values():
                visit(needed)
            found[task.key] = task

    for task in tasks:
        visit(task)
    return list(found.values())


class Graph:
    """The tasks of one experiment.

    Parameters
    ----------
    experiment
        Validated; every section is turned into the settings of the stages that read it, and of no other.
    """

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self._sections = experiment.model_dump(mode="json")
        if experiment.calibration.code is None:
            # A field that came later: products made before it are still the same.
            del self._sections["calibration"]["code"]
        self._models_at_once = self._sections["calibration"].pop("models_at_once")

    @property
    def sections(self) -> Mapping[str, Any]:
        """The whole experiment as JSON-able settings, section by section."""
        return self._sections

    def _section(self, *names: str) -> dict[str, Any]:
        return {name: self._sections[name] for name in names}

    @property
    def _frame(self) -> dict[str, Any]:
        """The instrument without its beams: antennas, channels, times and polarizations."""
        return {key: value for key, value in self._sections["instrument"].items() if key not in BEAMS}

    @cached_property
    def foregrounds(self) -> Task | None:
        """The foreground visibilities F, or None if the sky has none."""
        if self.experiment.sky.foregrounds.kind == "none":
            return None
        return self._simulation("foregrounds", self._sections["sky"]["foregrounds"])

    @cached_property
    def eor(self) -> Task:
        """The EoR visibilities S, in absolute units."""
        return self._simulation("eor", self._sections["sky"]["eor"])

    def _simulation(self, component: str, sky: Mapping[str, Any]) -> Task:
        """Return a simulation in as many chunks as asked for, under the key that it has in the default number."""
        chunks = self.experiment.simulation.chunks
        equivalent = None if chunks == DEFAULT_CHUNKS else self._simulation_in(component, sky, DEFAULT_CHUNKS)
        return self._simulation_in(component, sky, chunks, equivalent)

    def _simulation_in(
        self, component: str, sky: Mapping[str, Any], chunks: int, equivalent: Task | None = None
    ) -> Task:
        simulation = {**self._sections["simulation"], "chunks": chunks}
        settings = {**self._section("instrument"), "simulation": simulation, "component": component, "sky": sky}
        if component == "eor":
            settings["cosmology"] = self._sections["power"]["cosmology"]
        count = min(chunks, self.experiment.instrument.channels.count)
        pieces = {
            f"chunk{index:03d}": Task(
                "simulate-chunk",
                f"{component} {index + 1}/{count}",
                {**settings, "index": index},
                temporary=True,
            )
            for index in range(count)
        }
        return Task("simulate", component, settings, pieces, equivalent=equivalent)

    @cached_property
    def gains(self) -> Task:
        """The true gains."""
        return Task("gains", "true gains", {"instrument": self._frame, "gains": self._sections["corruption"]["gains"]})

    @cached_property
    def levels(self) -> Task:
        """How the EoR and the noise are scaled."""
        corruption = self._sections["corruption"]
        noise = {key: value for key, value in corruption["noise"].items() if key != "seeds"}
        inputs = {"eor": self.eor}
        if self.foregrounds is not None:
            inputs["foregrounds"] = self.foregrounds
        return Task("levels", "levels", {"eor_level": corruption["eor_level"], "noise": noise}, inputs)

    def data(self, variant: Variant, parity: str) -> Task:
        """Return the measurement of one noise realization of a variant, before any calibration."""
        settings: dict[str, Any] = {"components": sorted(variant.components), "instrument": self._frame}
        inputs = {"levels": self.levels}
        label = "+".join(variant.components)
        if "noise" in variant.components:
            settings["noise_seed"] = self._sections["corruption"]["noise"]["seeds"][PARITIES.index(parity)]
            label = f"{label} {parity}"
        if "foregrounds" in variant.components and self.foregrounds is not None:
            inputs["foregrounds"] = self.foregrounds
        if "eor" in variant.components:
            inputs["eor"] = self.eor
        if variant.gains:
            inputs["gains"] = self.gains
            label = f"gains x ({label})"
        return Task("corrupt", label, settings, inputs)

    def calibration(self, variant: Variant, parity: str) -> Task:
        """Return the calibration of one noise realization of a variant."""
        data = self.data(variant, parity)
        settings = self._section("calibration")
        calibration = self.experiment.calibration
        solves = -(-self.experiment.instrument.times.count // calibration.integrations_per_solve)
        count = min(calibration.chunks, solves)
        inputs = {"data": data}
        if self.foregrounds is not None:
            inputs["sky_model"] = self.foregrounds
        label = f"{data.label} {{}}/{count}"
        chunks = {
            f"chunk{index:03d}": self._calibration_chunk(
                label.format(index + 1), {**settings, "index": index, "count": count}, inputs
            )
            for index in range(count)
        }
        return Task("calibrate", data.label, {}, chunks)

    def _calibration_chunk(self, label: str, settings: Mapping[str, Any], inputs: Mapping[str, Task]) -> Task:
        """Return the calibration of some integrations, under the key that it has however little is held at a time."""
        usual = Task("calibrate-chunk", label, settings, inputs, temporary=True)
        if self._models_at_once == MODELS_AT_ONCE:
            return usual
        calibration = {**settings["calibration"], "models_at_once": self._models_at_once}
        return replace(usual, settings={**settings, "calibration": calibration}, equivalent=usual)

    def average(self, variant: Variant, parity: str) -> Task:
        """Return one realization of a variant, fringe-stopped and averaged over the run."""
        source = self.calibration(variant, parity) if variant.calibrate else self.data(variant, parity)
        label = f"R of {source.label}" if variant.calibrate else source.label
        return Task("average", label, {"file": "residual.uvh5" if variant.calibrate else "data.uvh5"}, {"data": source})

    def power(self, name: str) -> Task:
        """Return the delay power spectra of a variant, even x odd."""
        variant = self.experiment.variants[name]
        return self.crossed(name, {parity: self.average(variant, parity) for parity in PARITIES})

    def crossed(self, label: str, averages: Mapping[str, Task]) -> Task:
        """Return the delay power spectra of two averaged data sets, "even" x "odd"."""
        instrument = self._sections["instrument"]
        # Bins and masks are applied later, to the spectra.
        later = ("bins", "wedge_buffer", "length_bin")
        settings = {
            "beam": instrument["beam"],
            "channels": instrument["channels"],
            "power": {key: value for key, value in self._sections["power"].items() if key not in later},
        }
        return Task("power", label, settings, averages)

    @cached_property
    def spectra(self) -> Task:
        """The wedge and spherical spectra of all variants, with errors."""
        variants = self._sections["variants"]
        inputs = {name: self.power(name) for name in variants}
        inputs[EOR_REFERENCE] = self._reference("eor")
        if any("noise" in variant.components for variant in self.experiment.variants.values()):
            inputs[NOISE_REFERENCE] = self._reference("noise")
        return Task("spectra", "wedge and spherical", {**self._section("power"), "variants": variants}, inputs)

    def _reference(self, component: Component) -> Task:
        """Return the spectra of one component alone, which give the errors of all variants that contain it."""
        variant = Variant(components=(component,))
        return self.crossed(component, {parity: self.average(variant, parity) for parity in PARITIES})

    @cached_property
    def agreement(self) -> Task | None:
        """How far the calibration agrees with the truth, or None if the experiment has no such comparison."""
        from calstudy.graph.claims import agreement_task

        return agreement_task(self)

    @cached_property
    def claims(self) -> Task:
        """The paper's claims, evaluated on this experiment alone."""
        from calstudy.graph.claims import claims_task

        return claims_task(self)

    @cached_property
    def figures(self) -> list[Task]:
        """The figures asked for."""
        from calstudy.graph.convergence import convergence_figure
        from calstudy.graph.figures import figure_task
        from calstudy.graph.transfers import expected_loss_figure, transfer_figure

        own = {
            "signal-loss": transfer_figure,
            "expected-loss": expected_loss_figure,
            "convergence": convergence_figure,
        }
        names = self.experiment.outputs.figures
        return [own[name](self) if name in own else figure_task(self, name) for name in names]

    @cached_property
    def transfer(self) -> Task | None:
        """The signal loss, or None if the experiment does not calibrate the data with the EoR and without."""
        from calstudy.graph.transfers import transfer_task

        return transfer_task(self) if self.experiment.measures_signal_loss else None

    @cached_property
    def tables(self) -> list[Task]:
        """The products whose files are the tables of a run."""
        return [task for task in (self.spectra, self.agreement, self.transfer) if task is not None]

    @cached_property
    def footnotes(self) -> tuple[str, ...]:
        """What must be printed on every figure: what was used in place of the paper's own ingredients."""
        from calstudy.standins import footnotes

        return footnotes(self.experiment)

    @cached_property
    def targets(self) -> list[Task]:
        """The products a run is for; the others are made on the way."""
        return [*self.figures, *self.tables, self.claims]

    @cached_property
    def tasks(self) -> list[Task]:
        """All tasks, every one after its inputs."""
        return unique(self.targets)
