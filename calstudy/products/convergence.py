"""Foregrounds that two noise realizations have in common, as a function of the number of steps of a solver."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.resources import LIBRARIES_MEMORY, Cost
from calstudy.base.visibilities import to_cube
from calstudy.calibrate.agreement import Baselines, Realization, cross_power
from calstudy.calibrate.cost import ADAMAX_STEP, PAPER_SAMPLES
from calstudy.calibrate.problem import gain_products
from calstudy.experiment.model import Variant
from calstudy.products import corruption, sky_model
from calstudy.products.calibration import prepared_fit
from calstudy.products.corruption import PARITIES
from calstudy.products.files import DATA, VISIBILITIES, integration_times, read_visibilities, write_json
from calstudy.products.graph import Graph, size_of
from calstudy.run.task import Input, Inputs, Task

if TYPE_CHECKING:
    from calstudy.calibrate.settings import Solver
    from calstudy.calibrate.solvers.interface import Checkpoint

PATHS = "convergence.json"


def followed(graph: Graph, name: str, solver: Solver, integration: int) -> Task:
    """Return the task that follows a solver, in place of the experiment's own, on one integration of a variant.

    Both realizations are solved; integrations are counted from 0.
    """
    experiment = graph.experiment
    variant = experiment.variants[name]
    noise = Variant(components=("noise",))
    data = {f"data {parity}": corruption.data(graph, variant, parity) for parity in PARITIES}
    if "noise" in variant.components:
        data |= {f"noise {parity}": corruption.data(graph, noise, parity) for parity in PARITIES}
    return Convergence(
        f"{solver.name} on {name}, integration {integration}",
        calibration=experiment.calibration.with_defaults("assumed").model_copy(update={"solver": solver}),
        integration=integration,
        steps=list(experiment.outputs.convergence.steps),
        buffer=experiment.power.wedge_buffer,
        data=data,
        eor=corruption.data(graph, Variant(components=("eor",)), "even"),
        gains=corruption.gains(graph) if variant.effects else None,
        sky_model=sky_model.sky_model(graph),
    )


class Convergence(Task, stage="convergence", version=4):
    """The path of a solver on one integration of both realizations; `data` are their sums and their noise, if any."""

    calibration: Any
    integration: int
    steps: Sequence[int]
    buffer: float
    data: Inputs
    eor: Input
    gains: Input = None
    sky_model: Input = None

    def make(self, output: Path) -> Mapping[str, Any]:
        """Solve, and write the power that the realizations have in common after numbers of steps.

        Powers are sums over the delays outside the wedge, one per baseline, of the first polarization.
        """
        paths, realizations = {}, {}
        for parity in PARITIES:
            realizations[parity], paths[parity], baselines = self._solved(parity)
        signal = self._integration(self.eor)
        rows = []
        for even, odd in _abreast(paths["even"], paths["odd"], self.steps):
            left = [
                realizations[parity].residual_without_noise(gain_products(point.gains, baselines.antennas), point.model)
                for parity, point in zip(PARITIES, (even, odd), strict=True)
            ]
            rows.append(
                {
                    "steps": [even.n_steps, odd.n_steps],
                    "power": cross_power(left[0], left[1], baselines).tolist(),
                    "newton_decrement": [even.newton_decrement, odd.newton_decrement],
                    "decrement_rms": [even.decrement_rms, odd.decrement_rms],
                }
            )
        power = cross_power(signal, signal, baselines)
        write_json(
            output / PATHS,
            {
                "checkpoints": rows,
                "antennas": baselines.antennas.tolist(),
                "signal": power.tolist(),
                "signal_rms": float(np.sqrt(np.mean(np.abs(signal) ** 2))),
            },
        )
        return {"steps": [row["steps"][0] for row in rows]}

    def _integration(self, folder: Path) -> np.ndarray:
        """Return one integration of the first polarization of data, (Nbls, Nfreqs)."""
        return to_cube(read_visibilities(folder / DATA))[self.integration, ..., 0]

    def _solved(self, parity: str) -> tuple[Realization, list[Checkpoint], Baselines]:
        """Return a realization, the states of the solver after the numbers of steps, and the baselines."""
        from calstudy.calibrate.calamity import make_solver
        from calstudy.calibrate.preparation import make_problem
        from calstudy.calibrate.solvers.interface import trace
        from calstudy.products.selection import read_gains

        settings = self.calibration
        index = self.integration
        path = self.data[f"data {parity}"] / DATA
        times = integration_times(path)[[index]]
        sky = None if self.sky_model is None else read_visibilities(self.sky_model / VISIBILITIES, times)
        prepared = prepared_fit(settings, read_visibilities(path, times), sky, None)
        problem = make_problem(prepared, settings, slice(0, 1), 0)
        if isinstance(problem, str):
            raise InputError(f"outputs.convergence: integration {index} cannot be calibrated: {problem}")
        if (problem.weights == 0).any():
            raise InputError("outputs.convergence: some data are flagged, which the figure does not support")
        antennas = prepared.structure.antennas
        products = np.ones(problem.visibilities.shape, complex)
        if self.gains is not None:
            products = gain_products(read_gains(self.gains).at(index, prepared.data.numbers), antennas)
        noise = np.zeros_like(products)
        if f"noise {parity}" in self.data:
            noise = self._integration(self.data[f"noise {parity}"])
        baselines = Baselines(antennas, prepared.data.lengths, prepared.data.frequencies, self.buffer)
        if not prepared.fitted.all():
            raise InputError("outputs.convergence: autocorrelations cannot be among the data")
        found = trace(problem, make_solver(settings), self.steps)
        return Realization(problem.visibilities, noise, products), found, baselines

    def _cost(self) -> Cost:
        size, solver = size_of(self), self.calibration.solver
        work = size.baselines * size.channels.count / PAPER_SAMPLES
        step = 0.3 if solver.name == "gauss-newton" else ADAMAX_STEP
        steps = 10 if solver.name == "gauss-newton" else min(solver.max_steps, max(self.steps))
        data = 4 * size.samples * 8
        return Cost(20 + 2 * steps * step * work, LIBRARIES_MEMORY + 1.5e9 * work + data, 1e6)


def _abreast(
    even: list[Checkpoint], odd: list[Checkpoint], steps: Sequence[int]
) -> Iterator[tuple[Checkpoint, Checkpoint]]:
    """Yield the states of both realizations after the same numbers of steps; one that has ended does not change."""
    last = max(even[-1].n_steps, odd[-1].n_steps)
    seen = -1
    for step in sorted({step for step in steps if step < last} | {last}):
        first, second = (next((point for point in path if point.n_steps >= step), path[-1]) for path in (even, odd))
        if max(first.n_steps, second.n_steps) > seen:
            seen = max(first.n_steps, second.n_steps)
            yield first, second
