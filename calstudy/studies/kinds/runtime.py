"""Run-time studies: the solvers' steps are timed on arrays of growing size, one after the other."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from calstudy.base.constants import SPEED_OF_LIGHT
from calstudy.base.errors import InputError
from calstudy.base.quiet import require_tensorflow
from calstudy.base.schema import Section, fault
from calstudy.base.units import Length
from calstudy.calibrate.settings import BasisSettings
from calstudy.claims.evaluation import RunTimeClaims
from calstudy.claims.paper import distinct_papers
from calstudy.experiment.files import StudyFile
from calstudy.experiment.model import FIGURES, Folders, Papers, Scales, StudyName
from calstudy.figures import draw_task
from calstudy.instrument.array_layouts.geometric import LinearLayout, RectangularLayout
from calstudy.instrument.settings import Channels
from calstudy.products.run_times import CountSteps, RunTimes, TimedArray, TimeSteps
from calstudy.run.execution import Budget
from calstudy.run.provenance import machine, package_versions
from calstudy.run.task import Task
from calstudy.studies.study import Study


def _increasing(sizes: tuple[float, ...]) -> tuple[float, ...]:
    if list(sizes) != sorted(set(sizes)):
        raise fault("", f"must increase, and name no size twice: {', '.join(f'{size:g}' for size in sizes)}")
    return sizes


class RowsOfEight(Section):
    """Rows of eight antennas, as far apart as the longest baseline allows (paper Fig. ANTPOS_RUNTIME)."""

    antennas: Annotated[
        tuple[Annotated[int, Field(ge=9)], ...],
        Field(min_length=3, description="Sizes, increasing."),
        AfterValidator(_increasing),
    ] = (16, 24, 32, 48, 64, 96, 128)
    spacing: Length = Field(2.0, gt=0, description="Distance between neighbours in a row.")
    max_baseline: Length = Field(100.0, gt=0)

    @model_validator(mode="after")
    def _rows_fit(self) -> RowsOfEight:
        if self.max_baseline <= 7 * self.spacing:
            raise fault(
                "max_baseline", f"{self.max_baseline:g} m must exceed the length of a row, {7 * self.spacing:g} m"
            )
        return self


class Line(Section):
    """Lines of equally spaced antennas of growing length (paper Fig. MAXBL_RUNTIME)."""

    lengths: Annotated[
        tuple[Annotated[Length, Field(gt=0)], ...],
        Field(min_length=3, description="Longest baselines, increasing."),
        AfterValidator(_increasing),
    ] = (20.0, 35.0, 50.0, 75.0, 100.0, 150.0, 200.0)
    count: int = Field(10, ge=3, description="Antennas of each.")


class SampleCounts(Section):
    """Number of samples of each measurement, for every array."""

    steps: int = Field(200, ge=10, description="Single steps of the paper's solver.")
    calls: int = Field(20, ge=3, description="Calls of our Adamax, of 50 compiled steps each; their means are samples.")
    solves: int = Field(10, ge=2, description="Whole solves of the default solver, from unity gains.")


class DescentSettings(Section):
    """A run of the paper's solver, Adamax at 0.01, to count the steps it needs."""

    antennas: int = Field(32, ge=9, description="Of a rectangular array like the others.")
    max_steps: int = Field(20_000, ge=50)


class RuntimeSettings(Section):
    """Run time of one step against the number of antennas and the longest baseline (paper §Computational Runtime).

    The channels are by default 200 of 300 kHz from 120.15 MHz.
    """

    rows: RowsOfEight = RowsOfEight()
    line: Line = Line()
    channels: Channels = Channels(first="120.15 MHz", width="300 kHz", count=200)
    basis: BasisSettings = BasisSettings()
    samples: SampleCounts = SampleCounts()
    descent: DescentSettings = DescentSettings()
    devices: Annotated[tuple[Literal["cpu", "gpu"], ...], Field(min_length=1)] = Field(
        ("cpu",), description="One core of the processor, in processor seconds; the first GPU, in elapsed seconds."
    )

    @model_validator(mode="after")
    def _channels_hold_the_basis(self) -> RuntimeSettings:
        longest = max(self.rows.max_baseline, *self.line.lengths)
        delay = max(self.basis.horizon * longest / SPEED_OF_LIGHT, self.basis.min_delay) + self.basis.buffer
        nyquist = 0.5 / self.channels.width
        if delay + self.basis.delay_step >= nyquist:
            raise fault(
                "channels.width",
                f"{self.channels.width / 1e3:g} kHz resolves {1e9 * nyquist:.0f} ns, and the foregrounds of a baseline "
                f"of {longest:g} m reach {1e9 * delay:.0f} ns",
            )
        return self


class RuntimeFile(Section):
    """Steps of the paper's solver, of our Adamax and of the default solver, timed side by side on this machine."""

    name: StudyName
    description: str = ""
    runtime: RuntimeSettings
    outputs: Folders = Folders()
    papers: Papers = Field(
        (), description="Published papers whose statements on run times are evaluated, such as [calamity2022]."
    )
    scales: Scales = Field(default_factory=dict)


PANELS = ("rows", "line")
"""Families of arrays, each with a figure: rows of eight of growing number, lines of growing length."""
TIMED_WITH = ("tensorflow", "numpy", "scipy")
"""Packages whose version may change a run time."""


class RuntimeStudy(Study):
    """Run times of solvers on this machine."""

    key = "runtime"
    model = RuntimeFile
    heading = "Run-time files"
    guide = (
        "A file with the key `runtime` is a run-time study. `python -m calstudy run` times the solvers here, "
        "one array after the other; what it measured is kept under a key that names the machine."
    )

    def __init__(self, file: RuntimeFile) -> None:
        self.file = file

    @classmethod
    def load(cls, file: StudyFile) -> RuntimeStudy:
        """Return the study of a file."""
        return cls(file.read(RuntimeFile))

    @cached_property
    def timed_on(self) -> Mapping[str, Any]:
        """The machine and versions of packages, part of the keys; InputError without TensorFlow or a GPU asked for."""
        require_tensorflow()
        versions = package_versions()
        found = {**machine(), **{name: versions[name] for name in TIMED_WITH}}
        return {**found, "gpu": _gpu()} if "gpu" in self.file.runtime.devices else found

    @property
    def content(self) -> Any:
        """The content of the file without outputs, and the machine."""
        return {**self.file.model_dump(mode="json", exclude={"outputs", "scales"}), "machine": self.timed_on}

    def sized_to(self, budget: Budget) -> tuple[Self, int]:
        """Return the study and one worker; raises InputError for other workers, or too little memory."""
        if budget.scheduler is not None or budget.workers not in (None, 1):
            raise InputError(
                "--workers and --scheduler: run times are measured on this machine, one after the other; leave both out"
            )
        largest = max(self.timings.values(), key=lambda task: task.cost.memory)
        if largest.cost.memory > budget.memory:
            raise InputError(
                f"run times of {largest.label}: the paper's solver needs about {largest.cost.memory / 1e9:.1f} GB, "
                f"and there are {budget.memory / 1e9:.1f} GB; name smaller arrays, or fewer channels"
            )
        return self, 1

    def _rows(self, antennas: int) -> TimedArray:
        settings = self.file.runtime
        spacing, longest = f"{settings.rows.spacing!r} m", f"{settings.rows.max_baseline!r} m"
        layout = RectangularLayout(kind="rectangular", count=antennas, spacing=spacing, max_baseline=longest)
        return TimedArray(layout=layout, channels=settings.channels, basis=settings.basis)

    def _line(self, length: float) -> TimedArray:
        settings = self.file.runtime
        count = settings.line.count
        layout = LinearLayout(kind="linear", count=count, spacing=f"{length / (count - 1):.15g} m")
        return TimedArray(layout=layout, channels=settings.channels, basis=settings.basis)

    @cached_property
    def arrays(self) -> dict[str, tuple[str, float, TimedArray]]:
        """Panel, size and array of every measurement, by a name that sorts."""
        settings = self.file.runtime
        rows = {f"rows-{count:05d}": ("rows", float(count), self._rows(count)) for count in settings.rows.antennas}
        line = {f"line-{length:09.3f}": ("line", float(length), self._line(length)) for length in settings.line.lengths}
        return rows | line

    @cached_property
    def timings(self) -> dict[str, TimeSteps]:
        """The measurements, by name of the array and device."""
        devices = self.file.runtime.devices
        return {f"{name}-{device}": self._timing(name, device) for name in self.arrays for device in devices}

    def _timing(self, name: str, device: str) -> TimeSteps:
        panel, size, array = self.arrays[name]
        settings = self.file.runtime
        rows = panel == "rows"
        return TimeSteps(
            f"{size:g} antennas, {device}" if rows else f"line of {size:g} m, {device}",
            machine=self.timed_on,
            panel=panel,
            size=size,
            longest=settings.rows.max_baseline if rows else size,
            array=array,
            samples=settings.samples.model_dump(mode="json"),
            device=device,
        )

    @cached_property
    def descent(self) -> Task:
        """The task of the descent of the paper's solver to the minimum."""
        descent = self.file.runtime.descent
        return CountSteps(
            f"Adamax, {descent.antennas} antennas",
            array=self._rows(descent.antennas),
            longest=self.file.runtime.rows.max_baseline,
            max_steps=descent.max_steps,
        )

    @cached_property
    def summary(self) -> Task:
        """The table of all measurements."""
        return RunTimes("run times", machine=self.timed_on, cases=self.timings, descent=self.descent)

    @cached_property
    def figures(self) -> list[Task]:
        """Time per step against the number of antennas, and against the longest baseline."""
        figures = []
        for panel in PANELS:
            shown = {name: task for name, task in self.timings.items() if task.panel == panel}
            figures.append(draw_task(FIGURES.make({"kind": "runtime", "panel": panel}), shown, self.stand_ins, {}))
        return figures

    @cached_property
    def claims(self) -> Task | None:
        """The papers' statements on run times, or None."""
        papers = distinct_papers(self.file.papers)
        return RunTimeClaims("claims", papers=papers, title=self.name, runtime=self.summary) if papers else None

    @property
    def tables(self) -> list[Task]:
        """The table of all measurements."""
        return [self.summary]

    @property
    def entries(self) -> Mapping[str, Any]:
        """The kind and the machine."""
        return {"kind": "runtime", "machine": self.timed_on}


def _gpu() -> str:
    from calstudy.base.tensorflow import tf

    devices = tf.config.list_physical_devices("GPU")
    if not devices:
        raise InputError("runtime.devices = [..., gpu]: TensorFlow finds no GPU on this machine; use [cpu]")
    return str(tf.config.experimental.get_device_details(devices[0]).get("device_name", "unnamed GPU"))
