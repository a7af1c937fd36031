"""Stages `convergence` and `convergence-figure`: the bias of P^R against the steps that a solver took."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from calstudy.calibrate.agreement import Baselines
from calstudy.calibrate.bias import Realization, cross_power, ratio_over_antennas
from calstudy.calibrate.calamity import make_solver
from calstudy.calibrate.measured import make_problem, measure
from calstudy.calibrate.problem import gain_products
from calstudy.calibrate.settings import CalibrationSettings
from calstudy.calibrate.trace import Checkpoint, trace
from calstudy.errors import InputError
from calstudy.figures.convergence import ConvergencePath, draw_convergence
from calstudy.stages.files import read_json, read_visibilities, write_json
from calstudy.stages.registry import Job
from calstudy.stages.selection import read_gains
from calstudy.visibilities import antenna_pairs, baseline_vectors, to_cube

PARITIES = ("even", "odd")
PATHS = "convergence.json"
COLUMNS = ("solver", "steps", "bias", "bias error", "with EoR", "with EoR error", "predicted")


def follow(job: Job) -> Mapping[str, Any]:
    """Solve one integration of both realizations, and write what they have in common after so many steps.

    Powers are sums over the delays outside the wedge, one per baseline, of the first polarization.
    """
    paths, realizations = {}, {}
    for parity in PARITIES:
        realizations[parity], paths[parity], baselines = _solved(job, parity)
    signal = _integration(job, "eor/data.uvh5")
    rows = []
    for even, odd in _abreast(paths["even"], paths["odd"], job.settings["steps"]):
        left = [
            realizations[parity].left(gain_products(point.gains, baselines.antennas), point.model)
            for parity, point in zip(PARITIES, (even, odd), strict=True)
        ]
        rows.append(
            {
                "steps": [even.n_steps, odd.n_steps],
                "power": cross_power(*left, baselines).tolist(),
                "remaining": [even.remaining, odd.remaining],
                "remaining_rms": [even.remaining_rms, odd.remaining_rms],
            }
        )
    power = cross_power(signal, signal, baselines)
    write_json(
        job.output / PATHS,
        {
            "checkpoints": rows,
            "antennas": baselines.antennas.tolist(),
            "signal": power.tolist(),
            "signal_rms": float(np.sqrt(np.mean(np.abs(signal) ** 2))),
        },
    )
    return {"steps": [row["steps"][0] for row in rows]}


def _abreast(
    even: list[Checkpoint], odd: list[Checkpoint], steps: Sequence[int]
) -> Iterator[tuple[Checkpoint, Checkpoint]]:
    """Yield what both realizations held after the same numbers of steps; one that has ended stays where it is."""
    last = max(even[-1].n_steps, odd[-1].n_steps)
    seen = -1
    for step in sorted({step for step in steps if step < last} | {last}):
        first, second = (next((point for point in path if point.n_steps >= step), path[-1]) for path in (even, odd))
        if max(first.n_steps, second.n_steps) > seen:
            seen = max(first.n_steps, second.n_steps)
            yield first, second


def _integration(job: Job, path: str) -> np.ndarray:
    """Return one integration of the first polarization, (Nbls, Nfreqs)."""
    name, file = path.split("/")
    return to_cube(read_visibilities(job.inputs[name] / file))[job.settings["integration"], ..., 0]


def _solved(job: Job, parity: str) -> tuple[Realization, list[Checkpoint], Baselines]:
    """Return a realization, what the solver held on the way, as often as is asked for, and the baselines."""
    settings = CalibrationSettings.model_validate(job.settings["calibration"])
    index, steps = job.settings["integration"], job.settings["steps"]
    data = read_visibilities(job.inputs[f"data {parity}"] / "data.uvh5")
    chosen = np.arange(index * data.Nbls, (index + 1) * data.Nbls)
    data = data.select(blt_inds=chosen, inplace=False, run_check=False)
    sky = None
    if "sky_model" in job.inputs:
        sky = read_visibilities(job.inputs["sky_model"] / "visibilities.uvh5")
        sky = sky.select(blt_inds=chosen, inplace=False, run_check=False)
    measured = measure(data, settings, sky)
    problem = make_problem(measured, settings, slice(0, 1), 0)
    if isinstance(problem, str):
        raise InputError(f"outputs.convergence: integration {index} cannot be calibrated: {problem}")
    antennas = measured.structure.antennas
    products = np.ones(problem.visibilities.shape, complex)
    if "gains" in job.inputs:
        products = gain_products(read_gains(job.inputs["gains"]).of(measured.numbers)[0], antennas)
    noise = np.zeros_like(products)
    if f"noise {parity}" in job.inputs:
        noise = _integration(job, f"noise {parity}/data.uvh5")
    lengths = np.linalg.norm(baseline_vectors(measured.data), axis=1)
    baselines = Baselines(antennas, lengths, np.asarray(data.freq_array, float), job.settings["buffer"])
    if not np.array_equal(measured.numbers[antennas], antenna_pairs(data)):
        raise InputError("outputs.convergence: autocorrelations cannot be among the data")
    found = trace(problem, make_solver(settings), steps)
    return Realization(problem.visibilities, noise, products), found, baselines


def draw(job: Job) -> Mapping[str, Any]:
    """Put the integrations of every solver together, write convergence.csv, and draw the figure."""
    from calstudy.figures.save import figure_arrays, save_figure

    paths = [_path(job, label) for label in job.settings["solvers"]]
    with (job.output / "convergence.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for path in paths:
            columns = (path.steps, path.bias, path.bias_error, path.with_eor, path.with_eor_error, path.predicted)
            writer.writerows([path.solver, *row] for row in zip(*(part.tolist() for part in columns), strict=True))
    figure = draw_convergence(paths, job.settings["integrations"], stand_ins=job.settings["notes"])
    save_figure(figure, figure_arrays({"paths": paths}), job.output, "convergence")
    return {path.solver: {"steps": int(path.steps[-1]), "bias": round(float(path.bias[-1]), 4)} for path in paths}


def _path(job: Job, label: str) -> ConvergencePath:
    """Return the path of a solver, all integrations together: their baselines' powers add up."""
    found = {
        variant: [read_json(job.inputs[f"{label} {variant} {index}"] / PATHS) for index in job.settings["integrations"]]
        for variant in ("without", "with")
    }
    # Those that end early stay where they are.
    longest = {name: max(items, key=lambda item: len(item["checkpoints"])) for name, items in found.items()}
    count = max(len(item["checkpoints"]) for item in longest.values())
    steps = max(longest.values(), key=lambda item: len(item["checkpoints"]))["checkpoints"]
    ratios = {name: [_ratio(items, row) for row in range(count)] for name, items in found.items()}
    predicted = [np.mean([_predicted(item, row) for item in found["without"]]) for row in range(count)]
    columns = {name: np.array(values).T for name, values in ratios.items()}
    return ConvergencePath(
        solver=label,
        steps=np.array([max(row["steps"]) for row in steps]),
        bias=columns["without"][0],
        bias_error=columns["without"][1],
        with_eor=columns["with"][0],
        with_eor_error=columns["with"][1],
        predicted=np.array(predicted),
    )


def _checkpoint(item: Mapping[str, Any], row: int) -> Mapping[str, Any]:
    return item["checkpoints"][min(row, len(item["checkpoints"]) - 1)]


def _ratio(items: Sequence[Mapping[str, Any]], row: int) -> tuple[float, float]:
    power = np.sum([_checkpoint(item, row)["power"] for item in items], axis=0)
    return ratio_over_antennas(
        power, np.sum([item["signal"] for item in items], axis=0), np.array(items[0]["antennas"])
    )


def _predicted(item: Mapping[str, Any], row: int) -> float:
    """Return the power that the solver says it leaves, as if all of it were common, over that of the EoR."""
    even, odd = _checkpoint(item, row)["remaining_rms"]
    return even * odd / item["signal_rms"] ** 2
