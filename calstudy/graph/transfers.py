"""The signal loss of an experiment as tasks: the response of the residual to the EoR, its power, and T = P^R / P^S."""

from __future__ import annotations

from calstudy.experiment.model import SIGNAL_LOSS_VARIANTS
from calstudy.graph.tasks import PARITIES, Graph, Task

# Random vectors for the stochastic diagonal: its scatter, 6 % of the mode's power over their root, is averaged down
# further within a bin.
PROBES = 16
EXPECTED_POWER = ("taper", "cosmology", "bins", "wedge_buffer", "length_bin")


def transfer_task(graph: Graph) -> Task:
    """Return the task that measures T of an experiment that `measures_signal_loss`."""
    residual, without, eor = (graph.experiment.variants[name] for name in SIGNAL_LOSS_VARIANTS)
    responses = {
        parity: Task(
            "difference",
            f"response to the EoR {parity}",
            {},
            {"with_signal": graph.average(residual, parity), "without_signal": graph.average(without, parity)},
        )
        for parity in PARITIES
    }
    signals = {parity: graph.average(eor, parity) for parity in PARITIES}
    inputs = {
        "signal": graph.power("eor"),
        "response": graph.crossed("response to the EoR", responses),
        "cross": graph.crossed("EoR x response", {"even": signals["even"], "odd": responses["odd"]}),
        "spectra": graph.spectra,
    }
    return Task("transfer", "signal loss", {"power": graph.sections["power"]}, inputs)


def transfer_figure(graph: Graph) -> Task:
    """Return the task that draws T of an experiment that `measures_signal_loss`."""
    settings = {"notes": list(graph.footnotes), "wedge_buffer": graph.experiment.power.wedge_buffer}
    return Task("transfer-figure", "signal-loss", settings, {"transfer": transfer_task(graph)})


def expected_loss_figure(graph: Graph) -> Task:
    """Return the task that draws what the fit of the middle integration is expected to leave, against injection."""
    residual, power = graph.experiment.variants[SIGNAL_LOSS_VARIANTS[0]], graph.sections["power"]
    inputs = {"data": graph.data(residual, "even"), "calibration": graph.calibration(residual, "even")}
    if graph.foregrounds is not None:
        inputs["sky_model"] = graph.foregrounds
    settings = {
        "calibration": graph.sections["calibration"],
        "power": {name: power[name] for name in power if name in EXPECTED_POWER},
        "integration": graph.experiment.instrument.times.count // 2,
        "probes": PROBES,
    }
    expected = Task("expected-loss", "expected signal loss", settings, inputs)
    shown = {"notes": list(graph.footnotes), "wedge_buffer": graph.experiment.power.wedge_buffer}
    return Task(
        "expected-loss-figure", "expected-loss", shown, {"expected": expected, "transfer": transfer_task(graph)}
    )
