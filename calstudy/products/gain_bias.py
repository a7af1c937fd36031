"""The bias that errors of gains are expected to cause if nothing is calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.corrupt.drift import Correlated
from calstudy.corrupt.effects.gains import Bandpass
from calstudy.experiment.model import Variant
from calstudy.instrument.settings import Channels, Times
from calstudy.power.gain_bias import FALLEN, ErrorCovariance, GainBias, bias_terms, exponential
from calstudy.power.score import BANDS
from calstudy.power.settings import PowerSettings
from calstudy.power.tables import save_spectrum
from calstudy.products import spectra
from calstudy.products.graph import Graph, memoize, required, size_of
from calstudy.products.signal_loss import transfer
from calstudy.run.task import Input, Task

GAIN_BIAS = "gain-bias.h5"
LENGTHS = 30
"""Number of correlation lengths for which the law is evaluated besides the experiment's own."""


@memoize
def gain_bias(graph: Graph) -> Task:
    """Return the task of the expected bias; raises InputError if the effects are not those of the law."""
    experiment = graph.experiment
    effect, *others = (*experiment.corruption.effects, None)
    known = isinstance(effect, Bandpass) and isinstance(effect.shape, Correlated) and effect.drift is None
    if not isinstance(effect, Bandpass) or not known or others != [None]:
        raise InputError(
            "corruption.effects: the expected bias is that of a single effect; give one bandpass with "
            "shape: {kind: correlated} and no drift"
        )
    return ExpectGainBias(
        "expected bias of gain errors",
        effect=effect.with_defaults("seed"),
        channels=experiment.instrument.channels,
        times=experiment.instrument.times,
        power=experiment.power,
        foregrounds=spectra.variant_power(graph, "foregrounds", Variant(components=("foregrounds",))),
        signal=required(transfer(graph)).signal,
    )


class ExpectGainBias(Task, stage="gain-bias", version=2):
    """The bias that an effect on the gains is expected to cause, by delay spectra of foregrounds and EoR."""

    effect: Bandpass
    channels: Channels
    times: Times
    power: PowerSettings
    foregrounds: Input
    signal: Input

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write the expected bias to gain-bias.h5."""
        parts = spectra.read_common({"foregrounds": self.foregrounds, "signal": self.signal})
        effect, width = self.effect, self.channels.width
        shape = cast(Correlated, effect.shape)
        duration = self.times.integration * self.times.count
        per_block = -(-self.times.count // self.power.n_blocks(duration, self.times.integration))
        in_time = exponential(per_block, self.times.integration, effect.time)
        separations = width * np.arange(self.channels.count)

        def terms(correlated: Correlated) -> np.ndarray:
            errors = ErrorCovariance(correlated.correlation(separations), in_time, effect.common)
            # The tail of an exponential is far above what is neglected.
            if correlated.form == "gaussian" and errors.channels[len(separations) // 2] > FALLEN:
                return np.full((2, len(BANDS) - 1), np.nan)
            return bias_terms(**parts, errors=errors, edges=BANDS, buffer=self.power.wedge_buffer)

        lengths = np.geomspace(width / 2, width * self.channels.count, LENGTHS)
        own = terms(shape)
        found = GainBias(
            sigma=effect.sigma,
            length=shape.length,
            time=np.nan if effect.time is None else effect.time,
            common=effect.common,
            form=shape.form,
            bin_edges=np.array(BANDS),
            bias=effect.sigma**2 * own[0] + effect.sigma**4 * own[1],
            terms=own,
            lengths=lengths,
            terms_at=np.stack([terms(shape.model_copy(update={"length": length})) for length in lengths]),
        )
        save_spectrum(output / GAIN_BIAS, found)
        return {}

    def _cost(self) -> Cost:
        held = 8 * size_of(self).baselines * self.channels.count * COMPLEX128
        return Cost(2 + 1e-8 * LENGTHS * held / COMPLEX128, LIBRARIES_MEMORY + held, 1e5)
