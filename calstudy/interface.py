"""The Python interface: load, plan and run a study, read its results, and calibrate measured data.

The command line calls the same functions. Results are labelled arrays of xarray with units in their attributes, tables
of pandas, and the objects of pyuvdata::

    import calstudy

    study = calstudy.load("quickstart", **{"instrument.times.count": 8})
    study.plan()
    run = study.run(workers=2)
    run.spectra["residual"]

    calstudy.calibrate_data("data.uvh5", calibrator="calamity").gains
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, wraps
from html import escape
from io import StringIO
from numbers import Integral, Real
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar, cast, get_origin, get_type_hints

from rich.console import Console

from calstudy.base.errors import ExperimentError, InputError, nearest
from calstudy.base.gains import draw_gains, read_gain_errors
from calstudy.base.schema import alternatives
from calstudy.experiment.files import StudyFile, dump_yaml
from calstudy.figures import Draw
from calstudy.products import calibration, corruption
from calstudy.products.corruption import PARITIES
from calstudy.products.files import (
    COMPARISON,
    DATA,
    GAINS,
    MODEL,
    RESIDUAL,
    SOLUTION,
    quiet_libraries,
    read_json,
    read_visibilities,
)
from calstudy.products.gain_errors import ERRORS
from calstudy.products.gain_errors import gain_errors as errors_of_gains
from calstudy.report.headline import read_headline
from calstudy.results.reader import (
    EXPERIMENT,
    RunFolder,
    Tables,
    by_length_and_delay,
    by_wavenumber,
    gain_errors,
    undamaged,
)
from calstudy.run.execution import Budget
from calstudy.run.store import Store
from calstudy.run.task import Task
from calstudy.studies.calibration import DataCalibration, calibration_file, require_free
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.load import load_study, study_of
from calstudy.studies.show import describe_plan, show_plan
from calstudy.studies.study import Study, run_study
from calstudy.verdicts.standing import LIMIT
from calstudy.verdicts.statement import Unevaluated

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.figure import Figure
    from pyuvdata import UVCal, UVData

    from calstudy.experiment.model import Experiment, Folders, Variant
    from calstudy.power.transfer import TransferFunction

P = ParamSpec("P")
R = TypeVar("R")
Half = Literal["even", "odd"]
REGIONS = ("outside-wedge", "inside-wedge")
ONE_T = "transfer function of one calibration"
SMOOTHING = ("smooth_gains", "gain_delay", "smoothness")
"""Fields of calibrators that make gains smooth."""


def _typed(function: Callable[P, R]) -> Callable[P, R]:
    """Refuse arguments of other types than the function's own, with a sentence that names the argument."""
    signature = inspect.signature(function)

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        hints = get_type_hints(function)
        for name, value in signature.bind_partial(*args, **kwargs).arguments.items():
            kinds = [Integral if kind is int else get_origin(kind) or kind for kind in alternatives(hints[name])]
            if Any not in kinds and not isinstance(value, tuple(kinds)):
                raise InputError(f"{name} = {value!r}: must be of the type {signature.parameters[name].annotation}")
        return function(*args, **kwargs)

    return checked


@_typed
def load(source: str | Path | Mapping[str, Any], /, scale: str | None = None, **changes: Any) -> LoadedStudy:
    """Load a study; raises InputError if the file cannot be read, or a field is unknown or has a wrong value.

    Parameters
    ----------
    source
        A YAML file, the name of a published experiment, such as "quickstart", or the content of a file, whose relative
        paths start at the working directory.
    scale
        Name of a set of overrides in the file's `scales`.
    **changes
        Fields that are changed, by dotted path: ``**{"instrument.times.count": 8}``. Values are those that the file
        could have: numbers, texts with units, lists and mappings.
    """
    texts = _overrides(changes)
    if isinstance(source, Mapping):
        return LoadedStudy(study_of(StudyFile(Path("study.yaml"), _plain(source), scale, texts)))
    return LoadedStudy(load_study(Path(source), scale, texts))


@_typed
def open_run(folder: str | Path) -> OpenRun:
    """Open the folder of a finished run; raises InputError for another folder."""
    return OpenRun(RunFolder(Path(folder).resolve()))


@_typed
def calibrate_data(
    data: str | Path | Iterable[str | Path],
    output: str | Path = "calibrated",
    observed: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    quiet: bool = False,
    gain_errors: bool | int = True,
    **changes: Any,
) -> CalibratedData:
    """Calibrate measured data, as the command ``calstudy calibrate`` does; an interrupted calibration is resumed.

    Raises InputError if the data cannot be used, a field is unknown or has a value that is not allowed, or the folder
    has results.

    Parameters
    ----------
    data
        Files in any format that pyuvdata reads.
    output
        Folder for the results.
    observed
        Fields of the section `observed` of a study of measured data: `select`, `sky_model`, `flag_interference`.
    overwrite
        Whether results of an earlier calibration may be replaced.
    quiet
        If true, no progress is printed.
    gain_errors
        Whether gains get their errors by noise, as without ``--no-gain-errors``. A number is that of
        ``--gain-error-realizations``, for calibrators whose gains have no errors of their own.
    **changes
        Fields of the section `calibration` by dotted path: ``calibrator="sky-based"``, ``**{"basis.buffer": "50 ns"}``.
    """
    paths = [data] if isinstance(data, str | Path) else data
    section = {"data": [str(path) for path in paths], **(observed or {})}
    sections = {"observed": section, "gain_errors": gain_errors if isinstance(gain_errors, bool) else int(gain_errors)}
    folder = Path(output)
    require_free(folder, overwrite)
    with quiet_libraries():
        file = calibration_file(sections, folder, _overrides(changes, "calibration."))
        DataCalibration.load(file).sized_to(Budget(workers=1))[0].run(Console(quiet=quiet))
    return CalibratedData(folder)


class CalibratedData:
    """The results of `calibrate_data`, which are read from their folder when they are asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder = folder.resolve()
        self.solution: Mapping[str, Any] = read_json(folder / SOLUTION)
        """Content of solution.json: settings, changes of the data, what stands out, and every solve."""

    @property
    def gains(self) -> UVCal:
        """Fitted gains g, with V = g_a g_b* F."""
        from pyuvdata import UVCal

        return UVCal.from_file(self.folder / GAINS)

    @property
    def gain_errors(self) -> xarray.Dataset:
        """Standard deviations of gains by noise, `amplitude` and `phase`; InputError if the calibration has none."""
        return gain_errors(self.folder / GAINS)

    def draw_gains(self, seed: int) -> UVCal:
        """Return the gains with a draw of their errors, for errors of baselines that were not fitted.

        The noise of fitted baselines is not independent of that of their gains, and needs no draws. Raises InputError
        if the calibration has no errors, or smooth gains: draws are independent by channel, and such errors are not.
        """
        if smoothed := [name for name in SMOOTHING if self.solution["settings"].get(name) is not None]:
            raise InputError(
                f"calibration.{smoothed[0]} = {self.solution['settings'][smoothed[0]]!r}: gains are smooth, so that "
                "their errors are not independent by channel and integration, as those that are drawn are; calibrate "
                f"with {smoothed[0]}: null to draw errors"
            )
        records = self.solution["records"]
        solves = [slice(at := record["integration"], at + record["n_integrations"]) for record in records]
        return draw_gains(self.gains, read_gain_errors(self.folder / GAINS), solves, seed)

    @property
    def model(self) -> UVData:
        """Fitted foregrounds F."""
        return read_visibilities(self.folder / MODEL)

    @property
    def residual(self) -> UVData:
        """V / (g_a g_b*) - F."""
        return read_visibilities(self.folder / RESIDUAL)

    @property
    def solves(self) -> pandas.DataFrame:
        """Status, steps, loss and time of every solve."""
        import pandas

        return pandas.DataFrame(self.solution["records"])

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {status}" for status, count in self.solution["by_status"].items())
        warned = [f"warning: {text}" for text in self.solution["warnings"]]
        return "\n".join([f"calibrated data in {self.folder}", f"solves: {counts}", *warned])


class StudyPlan(dict[str, Any]):
    """The products and the cost of a run as plain values; it is printed as a table."""

    @property
    def stages(self) -> pandas.DataFrame:
        """Products, products to make, seconds on one core, and bytes of memory and disk, by stage."""
        import pandas

        return pandas.DataFrame(self["stages"]).set_index("stage")

    def __repr__(self) -> str:
        text = StringIO()
        show_plan(self, Console(width=120, highlight=False, file=text))
        return text.getvalue().rstrip()


class LoadedStudy:
    """A validated study: an experiment, a sweep, a collection, a comparison or measured data."""

    def __init__(self, study: Study) -> None:
        self._study = study

    @property
    def name(self) -> str:
        """Name of the study."""
        return self._study.name

    @property
    def folder(self) -> Path:
        """The folder that a run fills."""
        return self._study.folder

    @property
    def experiment(self) -> Experiment:
        """The validated experiment, whose quantities are numbers in SI units; InputError if there are several."""
        return _single(self._study).experiment

    @property
    def parts(self) -> dict[str, LoadedStudy]:
        """The members of a collection, or the points of a sweep, by name."""
        return {name: LoadedStudy(part) for name, part in self._study.parts.items()}

    def plan(self, workers: int | None = None, max_memory: str | None = None) -> StudyPlan:
        """Return the stages of a run with the estimated time, memory and disk.

        By default there is a worker process for each core, as far as the memory allows. `max_memory` is that of all
        workers together, such as "6 GB"; by default all free memory.
        """
        return StudyPlan(describe_plan(self._study, Budget(workers, max_memory)))

    def run(
        self,
        workers: int | None = None,
        max_memory: str | None = None,
        scheduler: str | None = None,
        quiet: bool = False,
    ) -> OpenRun:
        """Make all products that are not in the store, and fill the run folder; if `quiet`, without printed progress.

        Workers and memory are as for `plan`; `scheduler` is the address of a running dask scheduler in place of them.
        """
        finished = run_study(self._study, Budget(workers, max_memory, scheduler), Console(quiet=quiet))
        return open_run(finished.folder)

    def __repr__(self) -> str:
        figures = [task.label for task in self._study.figures]
        return "\n".join(
            (
                f"study {self.name!r}: {self._study.description}",
                *([self._study.setup] if self._study.setup else []),
                f"figures: {', '.join(figures) or 'none'}",
                f"run folder: {self.folder}",
            )
        )


class ByVariant(Mapping[str, Any]):
    """Results by variant of the data, which are read when they are asked for."""

    def __init__(self, names: list[str], read: Callable[[str], Any]) -> None:
        self._names, self._read = names, read

    def __getitem__(self, name: str) -> Any:
        if name not in self._names:
            raise KeyError(f"no variant {name!r}{nearest(name, self._names)} (there are: {', '.join(self._names)})")
        return self._read(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def _ipython_key_completions_(self) -> list[str]:
        return self._names

    def __repr__(self) -> str:
        return f"variants: {', '.join(self._names)}"


class OpenRun:
    """The results of a finished run.

    Lists of what a run has (`claims`, `figures`, `parts`, `products`, `tables`) are empty if it has none. All else
    raises InputError, with the reason, if the run does not have what it returns.
    """

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder
        self.name = folder.name

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self._folder.path

    @property
    def spectra(self) -> ByVariant:
        """Spherical power spectra outside the wedge, by variant: datasets with `power` and errors against `k`."""
        return self._spherical("outside-wedge")

    @property
    def spectra_of_all_modes(self) -> ByVariant:
        """Spherical power spectra of all modes, by variant."""
        return self._spherical("all-modes")

    @property
    def cylindrical(self) -> ByVariant:
        """Cylindrical power spectra, by variant: datasets with `power` against `baseline_length` and `delay`."""
        return self._by_variant(lambda name: by_length_and_delay(self._folder.tables.wedge(name)))

    @property
    def transfer(self) -> xarray.Dataset:
        """The transfer function T of the calibration against `region` ("outside-wedge", "inside-wedge") and `k`."""
        return self._of_one(lambda tables: self._by_region(tables.transfer), ONE_T)

    @property
    def transfer_in_bands(self) -> xarray.Dataset:
        """The same in four wide bands of k."""
        return self._of_one(lambda tables: self._by_region(tables.transfer_in_bands), ONE_T)

    @property
    def transfer_map(self) -> xarray.Dataset:
        """The transfer function against `baseline_length` and `delay`."""
        return by_length_and_delay(self._of_one(lambda tables: tables.transfer_map(), ONE_T))

    @property
    def scores(self) -> pandas.DataFrame:
        """T and bias of the calibration in bands of k, with errors from leaving out antennas; one row for each band."""
        import pandas

        bands = self._of_one(lambda tables: tables.summary, "scores of one calibration")["bands"]
        rows = [{"k_from": band["k"][0], "k_to": band["k"][1], **band} for band in bands]
        return pandas.DataFrame(rows).drop(columns="k").set_index(["k_from", "k_to"])

    def standings(self, limit: float = LIMIT, worlds: Sequence[str] | None = None) -> pandas.DataFrame:
        """Return which calibrators of a comparison have a bias below a limit in all, or some, worlds, by band of k.

        Columns are `standing` ("passes", "open" or "fails"), `worlds`, those that decide, `bias_below`, the 95 % upper
        limit in all worlds in units of the EoR, and `transfer`, the smallest T, of the linear response where that is
        lower by more than the error of T.
        """
        import pandas

        missing = "the run is no comparison, and has no standings; `scores` has its T and bias"
        self._folder.tables.path(COMPARISON, missing)
        if not (isinstance(limit, Real) and limit > 0):
            raise InputError(f"limit = {limit!r}: must be greater than 0, in units of the power of the EoR")
        if isinstance(worlds, str):
            raise InputError(f"worlds = {worlds!r}: must be a list of names, such as [{worlds!r}]")
        found = self._folder.standings(limit, worlds)
        columns = ["k_from", "k_to", "calibrator", "standing", "worlds", "bias_below", "transfer"]
        worlds_of = [[world.world for world in entry.decisive] for entry in found]
        rows = [
            (*entry.band, entry.calibrator, entry.standing, decisive, entry.upper_limit, entry.transfer)
            for entry, decisive in zip(found, worlds_of, strict=True)
        ]
        return pandas.DataFrame(rows, columns=columns).set_index(columns[:3])

    @property
    def claims(self) -> pandas.DataFrame:
        """Statements of papers with the measured number and the verdict, by name; empty without papers."""
        import pandas

        columns = ("verdict", "measured", "uncertainty", "threshold", "quantity", "section", "sentence", "reason")
        claims = self._folder.claims
        rows = [[getattr(claim, column) for column in columns] for claim in claims]
        return pandas.DataFrame(rows, pandas.Index([claim.name for claim in claims], name="claim"), columns)

    @property
    def products(self) -> pandas.DataFrame:
        """The products of the run with the time that each took, and whether this run made it."""
        import pandas

        columns = ["stage", "label", "seconds", "cpu_seconds", "peak_memory_bytes", "made_by_this_run"]
        return pandas.DataFrame([{name: entry.get(name) for name in columns} for entry in self._folder.products])

    @property
    def tables(self) -> list[str]:
        """Names of the tables that `table` reads."""
        return sorted(path.stem for path in (self.folder / "tables").glob("*.csv"))

    def table(self, name: str) -> pandas.DataFrame:
        """Return a table of the run, such as "comparison" or "eor.outside-wedge"."""
        listed = f"{nearest(name, self.tables)} (there are: {', '.join(self.tables)})"
        path = self._folder.tables.path(f"{name}.csv", f"the run has no table {name!r}{listed}")
        return undamaged(path, _read_table)

    @property
    def parts(self) -> dict[str, OpenRun]:
        """The members of a collection, or the points of a sweep, by name."""
        return {name: OpenRun(folder) for name, folder in self._folder.parts.items()}

    def gains(self, variant: str = "residual", half: Half = "even") -> UVCal:
        """Return the gains of a calibrated variant, of one of the two noise realizations, or the "true" gains."""
        from pyuvdata import UVCal

        is_true = variant == "true"
        task = corruption.gains(self._experiment.graph) if is_true else self._calibration(variant, half)
        return UVCal.from_file(self._product(task) / GAINS)

    def gain_errors(self, variant: str = "residual", half: Half = "even") -> xarray.Dataset:
        """Compute standard deviations of gains by noise, `amplitude` and `phase`, from the products in the store.

        Variant and half are as for `gains`. Raises InputError, with the reason, if the errors are not known for the
        calibrator or the size of the array.
        """
        self._calibration(variant, half)
        task = errors_of_gains(self._experiment.graph, self._variant(variant), half)
        with TemporaryDirectory() as folder:
            task.given(self._inputs(task)).make(Path(folder))
            reasons = {record.get("reason") for record in read_json(Path(folder) / ERRORS)["records"]}
            if None not in reasons:
                raise InputError(f"{variant}: no errors of gains: {'; '.join(sorted(reasons))}")
            return gain_errors(Path(folder) / GAINS)

    def visibilities(self, variant: str, half: Half = "even") -> UVData:
        """Return the visibilities of a variant, such as "uncalibrated", of one of the two noise realizations.

        These are the residual if the variant is calibrated, else the simulated data.
        """
        if self._variant(variant).calibrate:
            return read_visibilities(self._product(self._calibration(variant, half)) / RESIDUAL)
        data = corruption.data(self._experiment.graph, self._variant(variant), _half(half))
        return read_visibilities(self._product(data) / DATA)

    @property
    def figures(self) -> list[str]:
        """Names of the figures."""
        return sorted(path.stem for path in self._folder.figures.glob("*.png"))

    def plot(self, name: str) -> Figure:
        """Draw a figure of the study again from the products in the store; raises InputError if they are not there."""
        tasks = {task.label: task for task in self._study.figures}
        if name not in tasks:
            raise InputError(
                f"{name!r}: no figure of this study{nearest(name, list(tasks))}; it has {', '.join(tasks)}"
            )
        task = cast(Draw, tasks[name])
        # Some figures also write tables, which are in the folder of the run already.
        with TemporaryDirectory() as folder:
            return task.given(self._inputs(task)).drawing(Path(folder)).figure

    def __repr__(self) -> str:
        numbers = ", ".join(f"{number.name} {number.text}" for number in read_headline(self._folder))
        finished = self._folder.manifest.get("finished", "at an unknown time")
        lines = [f"run {self.name!r}, finished {finished}, in {self.folder}", f"figures: {', '.join(self.figures)}"]
        setup = [self._folder.manifest["setup"]] if "setup" in self._folder.manifest else []
        return "\n".join([*lines, *setup, *([numbers] if numbers else [])])

    def _repr_html_(self) -> str:
        return f"<pre>{escape(repr(self))}</pre>"

    @cached_property
    def _study(self) -> Study:
        try:
            return load_study(self.folder / EXPERIMENT)
        except ExperimentError as error:
            # The version that wrote the file accepted it.
            commit = self._folder.manifest.get("git_commit")
            writer = f"calstudy at commit {commit[:7]}" if commit else "another version of calstudy"
            raise InputError(
                f"{self.folder / EXPERIMENT}: written on {self._folder.finished:%d %B %Y} by {writer}; this version "
                f"refuses it, so run the experiment again, or read the run with that version ({error})"
            ) from None

    @property
    def _experiment(self) -> ExperimentStudy:
        return _single(self._study)

    def _has_no(self, wanted: str) -> InputError:
        has_tables = "its numbers are in its tables" if self.tables else "run the experiment again"
        return InputError(f"{self.name}: has no {wanted}; {'take one of its parts' if self.parts else has_tables}")

    def _of_one(self, read: Callable[[Tables], R], wanted: str) -> R:
        """Read what a run of one experiment has; raises InputError, with where it is, of a run of several."""
        tables = self._folder.tables
        try:
            return read(tables)
        except Unevaluated:
            if tables.variants or tables.lost:
                raise
            raise self._has_no(wanted) from None

    def _by_variant(self, read: Callable[[str], Any]) -> ByVariant:
        if not (names := self._folder.tables.variants):
            raise self._has_no("spectra by variant")
        return ByVariant(names, read)

    def _spherical(self, modes: str) -> ByVariant:
        return self._by_variant(lambda name: by_wavenumber(self._folder.tables.spherical(name, modes)))

    def _by_region(self, read: Callable[[str], TransferFunction]) -> xarray.Dataset:
        import xarray

        found = [by_wavenumber(read(region)) for region in REGIONS]
        return xarray.concat(found, xarray.IndexVariable("region", list(REGIONS)), combine_attrs="override")

    def _variant(self, name: str) -> Variant:
        variants = self._experiment.experiment.variants
        if name not in variants:
            raise InputError(f"no variant {name!r}{nearest(name, list(variants))} (there are: {', '.join(variants)})")
        return variants[name]

    def _calibration(self, variant: str, half: Half) -> Task:
        if not self._variant(variant).calibrate:
            raise InputError(f"{variant!r} is not calibrated")
        return calibration.calibration(self._experiment.graph, self._variant(variant), _half(half))

    def _inputs(self, task: Task) -> dict[str, Path]:
        return {name: self._product(needed) for name, needed in task.needs.items()}

    def _product(self, task: Task) -> Path:
        stores = self._stores(self._study.outputs)
        # Keys of today differ if code or a file that the run used was changed since.
        name = (task.stage.name, task.label)
        keys = [entry["key"] for entry in self._folder.products if (entry["stage"], entry["label"]) == name]
        key = keys[0] if len(keys) == 1 else task.key
        for store in stores:
            if (product := store.find(task.stage.name, key)) is not None:
                return product.path
        missing = f"{task.stage.name} ({task.label}): is not in the store {stores[-1].root}"
        if not keys:
            raise InputError(
                f"{missing}, since nothing in this run needed it; add a figure or table that does, and run"
            )
        raise InputError(
            f"{missing}, or was made by another version; start Python in the folder in which the study was run, or run "
            "it again"
        )

    def _stores(self, outputs: Folders) -> list[Store]:
        """Return the store from the working directory and, if its path is relative, from where the run was started."""
        store, runs = Path(outputs.store), Path(outputs.runs)
        above = self.folder.resolve().parents
        if store.is_absolute() or runs.is_absolute() or len(above) <= len(runs.parts):
            return [Store(store)]
        # A point is deeper in the folder of runs, which may also have been renamed.
        started = next((folder for folder in above if folder / runs in above), above[len(runs.parts)])
        return [Store(store), Store(started / store)]


def _read_table(path: Path) -> pandas.DataFrame:
    import pandas

    text = path.read_text(encoding="utf-8")
    # A line above the header describes the sky model; cells may have the sign as well.
    return pandas.read_csv(StringIO(text), skiprows=int(text.startswith("# ")))


def _overrides(changes: Mapping[str, Any], section: str = "") -> list[str]:
    plain = _plain(changes)
    return [f"{section}{path}={dump_yaml(value, in_line=True)}" for path, value in plain.items()]


def _plain(value: Any, path: str = "") -> Any:
    """Return a value as YAML has it: numbers and arrays of numpy, quantities of astropy, and paths, as plain ones."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{path}.{key}" if path else str(key)) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, path) for item in value]
    if hasattr(value, "unit") and hasattr(value, "value"):
        if getattr(value, "shape", ()):
            return [_plain(item, path) for item in value]
        # astropy.cosmology.units.littleh
        unit = str(value.unit).replace("littleh / Mpc", "h/Mpc")
        return f"{_plain(value.value, path)!r} {unit}" if unit else _plain(value.value, path)
    if hasattr(value, "tolist"):
        return _plain(value.tolist(), path)
    if isinstance(value, PurePath):
        return str(value)
    if value is None or isinstance(value, str | int | float | bool):
        return value
    raise InputError(f"{path} = {value!r}: a {type(value).__name__} cannot be in a file; give a number, text or list")


def _half(half: str) -> str:
    if half not in PARITIES:
        raise InputError(f"half = {half!r}: must be one of {', '.join(PARITIES)}")
    return half


def _single(study: Study) -> ExperimentStudy:
    if not isinstance(study, ExperimentStudy):
        remedy = "take one of its parts" if study.parts else "its numbers are in its tables and scores"
        raise InputError(f"{study.name}: has several experiments; {remedy}")
    return study
