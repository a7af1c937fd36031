"""What the fit of one integration is expected to leave of the EoR, from its own tangent space."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from calstudy.base.errors import InputError
from calstudy.base.resources import LIBRARIES_MEMORY, Cost
from calstudy.calibrate.cost import PAPER_SAMPLES
from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS
from calstudy.products import calibration
from calstudy.products.files import DATA, MODEL, integration_times, read_visibilities
from calstudy.products.graph import Graph, once, size_of
from calstudy.run.task import Job, Stage, Task

if TYPE_CHECKING:
    import numpy as np

    from calstudy.calibrate.expected_loss import ExpectedTransfer
    from calstudy.power.expected import ExpectedBins
    from calstudy.power.settings import PowerSettings

EXPECTED = "expected-loss.h5"
# Random vectors for the stochastic diagonal: its scatter, 6 % of the mode's power over their root, is averaged down
# further within a bin.
PROBES = 16


@once
def expected_loss(graph: Graph) -> Task:
    """Return the task that predicts T for the middle integration of the variant `residual`."""
    residual = graph.experiment.variants[SIGNAL_LOSS_VARIANTS[0]]
    inputs = calibration.calibration_inputs(graph, residual, "even")
    inputs["calibration"] = calibration.calibration(graph, residual, "even")
    settings = {
        "calibration": graph.experiment.calibration.reset("assumed"),
        "power": graph.experiment.power.reset("pairs", "redundancy_tolerance", "coherent_time"),
        "integration": graph.experiment.instrument.times.count // 2,
        "probes": PROBES,
    }
    return Task(EXPECTED_LOSS, "expected signal loss", settings, inputs)


def expect(job: Job) -> Mapping[str, Any]:
    """Write the expected T of one calibrated integration, in bins of k and of baseline length and delay."""
    import numpy as np

    from calstudy.base.observation import Observation
    from calstudy.base.visibilities import to_cube
    from calstudy.calibrate.expected_loss import DelayModes, expected_transfer
    from calstudy.calibrate.interface import Assumed
    from calstudy.calibrate.preparation import prepare, problem_at
    from calstudy.power.tables import save_spectrum
    from calstudy.products.selection import read_gains

    settings, power = job.settings["calibration"], job.settings["power"]
    index = job.settings["integration"]
    times = integration_times(job.inputs["data"] / DATA)[[index]]
    data, sky, noise = calibration.read_calibrated(job.inputs, times)
    assumed = Assumed(None if sky is None else Observation(sky), noise=noise)
    prepared = prepare(Observation(data), settings, assumed)
    fitted = read_gains(job.inputs["calibration"])
    gains = fitted.at(index, prepared.data.numbers)
    problem = problem_at(prepared, settings, slice(0, 1), 0, gains)
    if isinstance(problem, str) or fitted.flags[index].any():
        raise InputError(
            f"expected-loss: integration {index} was not calibrated in all antennas and channels, and flagged data are "
            "not supported"
        )
    model = to_cube(read_visibilities(job.inputs["calibration"] / MODEL))[index, ..., 0]
    frequency = np.asarray(data.freq_array, float)
    modes = DelayModes(frequency, power.taper)
    expected = expected_transfer(problem, gains, model, modes, job.settings["probes"])
    save_spectrum(job.output / EXPECTED, binned(expected, prepared.data.lengths, float(frequency.mean()), power))
    return {"integration": index, "probes": job.settings["probes"]}


def binned(expected: ExpectedTransfer, lengths: np.ndarray, centre: float, power: PowerSettings) -> ExpectedBins:
    """Return an expected T in bins of k and of baseline length and delay.

    Parameters
    ----------
    expected
        Per baseline and delay.
    lengths
        Of the baselines, m, (Nbls,).
    centre
        Of the band, Hz.
    power
        Bins, buffer of the wedge, cosmology.
    """
    from calstudy.power.cosmology import k_parallel, k_perpendicular, make_cosmology
    from calstudy.power.expected import BaselineModes, bin_expected
    from calstudy.power.spherical import make_bin_edges

    cosmology = make_cosmology(power.cosmology)
    return bin_expected(
        BaselineModes(
            transfer=expected.transfer,
            error=expected.error,
            length=lengths,
            k_perp=k_perpendicular(cosmology, lengths, centre),
            delay=expected.delay,
            k_parallel=k_parallel(cosmology, expected.delay, centre),
        ),
        make_bin_edges(power.bins),
        power.wedge_buffer,
        power.length_bin,
    )


def _cost(task: Task) -> Cost:
    size = size_of(task)
    work = size.baselines * size.channels.count / PAPER_SAMPLES
    return Cost(6 + 0.8 * task.settings["probes"] * work, LIBRARIES_MEMORY + 1.5e9 * work, 1e6)


EXPECTED_LOSS = Stage(name="expected-loss", version=4, make=expect, cost=_cost)
