"""The content of an experiment file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain, combinations
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, SerializeAsAny, model_validator

from calstudy.base.constants import HYDROGEN_LINE
from calstudy.base.errors import InputError
from calstudy.base.plugins import Plugin, Registry, refusal_of
from calstudy.base.schema import UNKEYED, Section, fault
from calstudy.calibrate.interface import CALIBRATORS, Calibrator
from calstudy.calibrate.settings import AdamaxSettings, GaussNewtonSettings, Solver
from calstudy.corrupt.noise import Autocorrelations
from calstudy.corrupt.settings import CorruptionSettings
from calstudy.instrument.settings import InstrumentSettings
from calstudy.power.settings import PowerSettings
from calstudy.simulate.settings import SimulationSettings
from calstudy.sky.settings import SkySettings, SyntheticDiffuse

Component = Literal["foregrounds", "eor", "noise"]
SIGNAL_LOSS_VARIANTS = ("residual", "residual_without_eor", "eor")
FIGURES: Registry[Any] = Registry("figure", "calstudy.figures", "calstudy.figures:StudyFigure", families=True)
TABLES: Registry[Any] = Registry("table", "calstudy.products", "calstudy.products.table:StudyTable", families=True)
PAPERS: Registry[Any] = Registry("paper", "calstudy.papers", "calstudy.claims.paper:Paper")
DEFAULT_FIGURES = ("layout", "gains", "model", "data", "baselines", "wedge", "spherical", "signal-loss")

FIGURE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
STUDY_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
TABLE_NAME = re.compile(r"(?!(as-built|sky-model)$)[A-Za-z0-9][A-Za-z0-9_-]*")
"""Of a table of one's own: built-in ones have all names with dots and these two."""
VARIANT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


Figures = tuple[Annotated[SerializeAsAny[Plugin], FIGURES.field()], ...]
StudyTables = tuple[Annotated[SerializeAsAny[Plugin], TABLES.field()], ...]
Scales = Annotated[
    dict[str, dict[str, Any]],
    Field(description="Named sets of overrides (dotted path: value), chosen with --scale."),
]
Papers = tuple[Annotated[SerializeAsAny[Plugin], PAPERS.field()], ...]


class Variant(Section):
    """One version of the data that is carried to a power spectrum."""

    components: Annotated[tuple[Component, ...], Field(min_length=1)] = Field(
        description="What is added up before any effect."
    )
    effects: bool = Field(False, description="Let the effects of `corruption.effects` happen to the data.")
    calibrate: bool = Field(False, description="Calibrate, and use the residual R.")

    @model_validator(mode="after")
    def _components_are_unique(self) -> Variant:
        if len(set(self.components)) != len(self.components):
            raise fault("components", f"names a component twice: {', '.join(self.components)}")
        return self


def _paper_variants() -> dict[str, Variant]:
    everything: tuple[Component, ...] = ("foregrounds", "eor", "noise")
    return {
        "uncorrupted": Variant(components=everything),
        "uncalibrated": Variant(components=everything, effects=True),
        "residual": Variant(components=everything, effects=True, calibrate=True),
        "residual_without_eor": Variant(components=("foregrounds", "noise"), effects=True, calibrate=True),
        "eor": Variant(components=("eor",)),
        "noise": Variant(components=("noise",)),
    }


Pair = tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]


class Inspection(Section):
    """Content of the figures of single gains and baselines; antennas are counted from 0 in the order of the layout."""

    antennas: Pair = Field((0, 1), description="Two antennas; the model and data figures show their baseline.")
    integration: int = Field(0, ge=0, description="Counted from 0.")
    realization: Literal["even", "odd"] = "even"
    baselines: Annotated[tuple[Pair, ...], Field(min_length=1)] | None = Field(
        None, description="Baselines of the `baselines` figure, such as [[0, 1], [0, 5]]; null: four, short to long."
    )

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """All named pairs of antennas."""
        return (self.antennas, *(self.baselines or ()))

    @model_validator(mode="after")
    def _pairs_are_baselines(self) -> Inspection:
        if any(first == second for first, second in self.pairs):
            raise fault("", "names an antenna twice in a pair: two different ones make a baseline")
        return self


def _followed_solvers() -> dict[str, Solver]:
    return {
        "Gauss-Newton (default)": GaussNewtonSettings(),
        "Adamax 0.01": AdamaxSettings(name="adamax", tolerance=0.0, max_steps=16_000),
    }


class Convergence(Section):
    """Settings of the figure `convergence`: the foregrounds that solvers leave after given numbers of steps."""

    integrations: int = Field(3, ge=1, description="How many, spread over the run; each is solved from the start.")
    solvers: Annotated[dict[str, Solver], Field(min_length=1, max_length=5)] = Field(
        default_factory=_followed_solvers, description="By the names that they have in the figure."
    )
    steps: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)] = Field(
        (1, 2, 3, 4, 6, 8, 10, 20, 50, 100, 200, 500, 1000, 2000, 4000, 8000, 16_000),
        description="After how many steps they are looked at, besides their end.",
    )


class Folders(Section):
    """Folders of products and runs."""

    holds_input_files: ClassVar[bool] = False

    store: Path = Field(
        Path("store"), description="Folder of products, shared by all studies.", json_schema_extra=UNKEYED
    )
    runs: Path = Field(
        Path("runs"), description="Folder in which each run gets its own folder.", json_schema_extra=UNKEYED
    )

    @model_validator(mode="after")
    def _folders_differ(self) -> Self:
        if self.store.absolute() == self.runs.absolute():
            raise fault("runs", f"{str(self.runs)!r} is also outputs.store; give each its own folder")
        return self


class Outputs(Folders):
    """Figures, tables, and the folders of products and runs."""

    figures: Figures = Field(
        default_factory=lambda: tuple(FIGURES.make(name) for name in DEFAULT_FIGURES),
        description="What is drawn: names of figures, or files of your own.",
    )
    tables: StudyTables = Field((), description="Tables besides those of every run: files of your own.")
    inspect: Inspection = Inspection()
    convergence: Convergence = Convergence()


SweepValues = Annotated[tuple[Any, ...], Field(min_length=1)]
SweepBlock = Annotated[dict[str, SweepValues], Field(min_length=1)]


def _as_list(blocks: Any) -> Any:
    return [blocks] if isinstance(blocks, dict) else blocks


class RealizationBlock(Section):
    """Realizations of an experiment, which differ in the seeds of random parts; the first is the experiment itself."""

    draw: tuple[Literal["eor", "gains", "noise"], ...] = Field(
        ("eor", "gains", "noise"), description="What is drawn again in every realization; the rest is common to all."
    )
    count: int = Field(10, ge=2, le=1000, description="Number of realizations, with the experiment itself.")

    @model_validator(mode="after")
    def _draws_are_unique(self) -> RealizationBlock:
        if not self.draw:
            raise fault("draw", "names nothing: all realizations would be the same")
        if len(set(self.draw)) != len(self.draw):
            raise fault("draw", f"names something twice: {', '.join(self.draw)}")
        return self


def _usable_name(text: str) -> str:
    if not STUDY_NAME.fullmatch(text):
        raise fault("", f"{text!r} cannot name a folder: use at most 64 letters, digits, '_', '.', '-'; no blank")
    return text


StudyName = Annotated[str, AfterValidator(_usable_name), Field(description="Names the run folder.")]


class Experiment(Section):
    """One study: instrument, sky, corruption of the data, calibration under test, and measured quantities."""

    name: StudyName
    description: str = ""
    instrument: InstrumentSettings = InstrumentSettings()
    sky: SkySettings = SkySettings()
    simulation: SimulationSettings = SimulationSettings()
    corruption: CorruptionSettings = CorruptionSettings()
    calibration: Annotated[SerializeAsAny[Calibrator], CALIBRATORS.field("calamity")] = Field(
        default_factory=lambda: CALIBRATORS.make("calamity")
    )
    power: PowerSettings = PowerSettings()
    variants: dict[str, Variant] = Field(
        default_factory=_paper_variants, min_length=1, description="By default the six of the paper's figures."
    )
    outputs: Outputs = Field(default_factory=Outputs)
    papers: Papers = Field(
        (),
        description="Published papers whose statements the run is compared with, such as [calamity2022]; none by "
        "default.",
    )
    sweep: Annotated[
        tuple[SweepBlock, ...],
        BeforeValidator(_as_list, json_schema_input_type=SweepBlock | tuple[SweepBlock, ...]),
    ] = Field(
        (),
        description="Fields to vary (dotted path: list of values; several fields: all combinations), or a list of such "
        "blocks; a run makes every point and compares their signal loss.",
    )
    realizations: Annotated[
        tuple[RealizationBlock, ...],
        BeforeValidator(_as_list, json_schema_input_type=RealizationBlock | tuple[RealizationBlock, ...]),
    ] = Field(
        (),
        description="Draw the EoR, the gains or the noise several times, and pool what is measured: a block, or a list "
        "of blocks that draw different things.",
    )
    scales: Scales = Field(default_factory=dict)

    @property
    def calibrates(self) -> bool:
        """Whether any variant is calibrated."""
        return any(variant.calibrate for variant in self.variants.values())

    @property
    def measures_signal_loss(self) -> bool:
        """Whether data are calibrated with and without the EoR, all else equal, so that its loss can be measured."""
        residual, without, eor = (self.variants.get(name) for name in SIGNAL_LOSS_VARIANTS)
        if residual is None or without is None or eor is None:
            return False
        return (
            set(residual.components) == {*without.components, "eor"} != set(without.components)
            and residual.calibrate
            and without.calibrate
            and residual.effects == without.effects
            and eor == Variant(components=("eor",))
        )

    @model_validator(mode="after")
    def _parts_fit_together(self) -> Experiment:
        # Each fault is the dotted path of a field, and a sentence.
        faults = chain(
            self._faults_of_variants(),
            self._faults_of_settings(),
            self._faults_of_seeds(),
            self._faults_of_autos(),
            self._faults_of_things("figures", "picture", FIGURE_NAME),
            self._faults_of_things("tables", "table", TABLE_NAME),
        )
        if (found := next(faults, None)) is not None:
            raise fault(*found)
        return self

    def _faults_of_variants(self) -> Iterator[tuple[str, str]]:
        lacking = {"noise": self.corruption.noise.kind == "none", "foregrounds": not self.sky.has_foregrounds}
        fields = {"noise": "corruption.noise", "foregrounds": "sky.foregrounds"}
        for name, variant in self.variants.items():
            for part in fields:
                if part in variant.components and lacking[part]:
                    yield f"variants.{name}.components", f"asks for {part}, but {fields[part]} is 'none'"
            if not VARIANT_NAME.fullmatch(name) or name == "transfer":
                yield f"variants.{name}", "is not a usable name: use letters, digits, '_', '-'; not 'transfer'"

    def _faults_of_seeds(self) -> Iterator[tuple[str, str]]:
        # All are drawn by NumPy's default generator from the seed alone: equal seeds draw the same numbers.
        noise, diffuse, eor = self.corruption.noise, self.sky.diffuse, self.sky.eor
        even_and_odd, twins = getattr(noise, "seeds", ()), getattr(noise, "seeds_without_eor", None) or ()
        if any(seed in twins and twins.index(seed) != place for place, seed in enumerate(even_and_odd)):
            yield "corruption.noise.seeds_without_eor", "has the seed of even data where seeds has that of odd data"
        built = self.instrument.as_built.drawn_seeds
        drawn: list[tuple[str, Any]] = [(f"instrument.as_built.{name}", seed) for name, seed in built.items()]
        drawn += [("corruption.noise", seed) for seed in {*even_and_odd, *twins}]
        for place, effect in enumerate(self.corruption.effects):
            drawn += [(f"corruption.effects.{place}.{name}", seed) for name, seed in effect.drawn_seeds.items()]
        for (other, its), (path, seed) in combinations(drawn, 2):
            # Effects are compared with each other, and with their drifts, by `CorruptionSettings`.
            if seed == its and not (other.startswith("corruption.effects") or other == path):
                yield path, f"is {seed}, as that of {other}: give one of them another"
        if isinstance(diffuse, SyntheticDiffuse) and eor.spectrum != "flat" and diffuse.seed == eor.seed:
            yield "sky.diffuse.seed", f"is {diffuse.seed}, as that of sky.eor: give one of them another"

    def _faults_of_things(self, field: str, what: str, names: re.Pattern[str]) -> Iterator[tuple[str, str]]:
        labels: list[str] = []
        for index, thing in enumerate(getattr(self.outputs, field)):
            path = f"outputs.{field}.{index}"
            if not names.fullmatch(thing.label) or thing.label in labels:
                yield path, f"{thing.label!r} cannot name a {what}, or does so already: use another file name"
            labels.append(thing.label)
            try:
                refusal = refusal_of(thing, self)
            except InputError as error:
                yield path, str(error)
            else:
                if refusal is not None:
                    yield f"outputs.{field}", f"asks for {thing.label!r}, which {refusal}"

    def _faults_of_settings(self) -> Iterator[tuple[str, str]]:
        noise, channels, count = self.corruption.noise.kind, self.instrument.channels, self.instrument.times.count
        integration, together = self.outputs.inspect.integration, self.calibration.integrations_per_solve
        last = channels.first + (channels.count - 1) * channels.width
        without = "is relative to foregrounds, but sky.foregrounds is 'none'"
        silent, empty = noise == "none", not self.sky.has_foregrounds
        refused = (
            (
                silent and self.calibration.needs_noise,
                "corruption.noise",
                "is 'none', and the finite deviations of calibration.foreground_prior are weighed against noise: give "
                "calibration.foreground_prior.noise, or let there be noise",
            ),
            (
                silent and self.calibration.needs_autos,
                "calibration.weights",
                "is 'autos', and without corruption.noise there are no autocorrelations: choose other weights, or let "
                "there be noise",
            ),
            (
                integration >= count,
                "outputs.inspect.integration",
                f"{integration} is not among the {count} integrations, counted from 0",
            ),
            (empty and self.corruption.eor_level is not None, "corruption.eor_level", f"{without}: use null"),
            (empty and noise == "times-foregrounds", "corruption.noise", without),
            (
                together > count and self.calibrates,
                "calibration.integrations_per_solve",
                f"{together} integrations cannot be solved together, for instrument.times.count is {count}; use at "
                f"most {count}",
            ),
            (
                last >= HYDROGEN_LINE,
                "instrument.channels",
                f"end at {last / 1e6:g} MHz, above the 21 cm line at redshift zero",
            ),
        )
        yield from ((path, sentence) for applies, path, sentence in refused if applies)

    def _faults_of_autos(self) -> Iterator[tuple[str, str]]:
        beam = self.instrument.beam
        own = beam.is_built_in and beam.label.startswith("mwa-")
        for place, effect in enumerate(() if own else self.corruption.effects):
            autos = getattr(effect, "autos", None)
            # The value alone does not tell a default from the same number given on purpose.
            if isinstance(autos, Autocorrelations) and "effective_area" not in autos.model_fields_set:
                yield (
                    f"corruption.effects.{place}.autos.effective_area",
                    f"must be given with the beam {beam.label!r}, such as 100 m2: the default, "
                    f"{autos.effective_area:g} m2, is that of an MWA tile; or autos: null, for no autocorrelations",
                )
