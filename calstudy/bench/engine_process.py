"""One engine's work in a process of its own: ``python -m calstudy.bench.engine_process REQUEST``."""

from __future__ import annotations

import json
import sys
import warnings
from typing import Any

import numpy as np

from calstudy.bench.engines import Work
from calstudy.instrument.beams import make_beam
from calstudy.instrument.settings import InstrumentSettings, MwaLayout
from calstudy.instrument.telescope import make_template, subset_template
from calstudy.resources import Usage
from calstudy.simulate.engine import make_engine
from calstudy.simulate.nodes import integration_times
from calstudy.simulate.settings import SimulationSettings
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.sky.settings import SyntheticSources

FEW = 200
"""Sources of the first, uncounted simulation, in which code is compiled and imported."""


def simulate(request: dict[str, Any]) -> Usage:
    """Simulate the work of a request, save the visibilities, and return what it took."""
    work = Work(**request["work"])
    instrument = InstrumentSettings(layout=MwaLayout(count=work.antennas))
    whole = make_template(instrument)
    times, channels = (_spread(axis, n) for axis, n in ((whole.Ntimes, work.times), (whole.Nfreqs, work.channels)))
    template = subset_template(whole, integration_times(whole)[times], whole.freq_array[channels])
    beam = make_beam(instrument.beam, instrument.channels)
    sky = make_foregrounds(SyntheticSources(count=work.sources), whole.freq_array).sky
    engine = make_engine(SimulationSettings(engine=request["engine"], precision=request["precision"]))
    engine.simulate(sky.select(component_inds=np.arange(FEW), inplace=False, run_check=False), beam, template)
    with Usage() as usage:
        cube = engine.simulate(sky, beam, template)
    np.save(request["path"], cube, allow_pickle=False)
    return usage


def _spread(length: int, count: int) -> np.ndarray:
    return np.unique(np.linspace(0, length - 1, count + 2).round().astype(int)[1:-1])


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    taken = simulate(json.loads(sys.argv[1]))
    print(json.dumps({"cpu_seconds": taken.cpu_seconds, "peak_memory": taken.peak_memory}))
