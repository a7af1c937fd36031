"""Read and write the files of products."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calstudy.base.visibilities import keep_compiled_pyuvdata

if TYPE_CHECKING:
    from pyuvdata import UVData

VISIBILITIES, DATA, GAINS, AVERAGE = "visibilities.uvh5", "data.uvh5", "gains.calh5", "average.uvh5"
MODEL, RESIDUAL, SOLUTION = "model.uvh5", "residual.uvh5", "solution.json"
"""Files of simulated components, measurements, gains, averages and calibrations."""
COMPARISON, REALIZATIONS = "comparison.json", "realizations.json"
"""Scores of a comparison, and verdicts on the criteria for realizations."""
AGREEMENT, SKY_MODEL_ERROR, EXPECTED = "agreement.json", "sky-model.json", "expected-loss.h5"
SCORE_BINS, SCORE_BANDS, SCORE = "score-bins.h5", "score-bands.h5", "score.json"
TRANSFER, TRANSFER_BANDS = "transfer", "transfer-bands"
"""Names of transfer functions in `spectrum_file`, in bins and in bands of k."""


def spectrum_file(name: str, kind: str) -> str:
    """Return the name of the file with an averaged power spectrum of a variant, or with a transfer function.

    The kind is "wedge" for the cylindrical one; "all-modes", "outside-wedge" or "inside-wedge" for spherical ones.
    """
    return f"{name}.{kind}.h5"


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Send the warnings of libraries to the log instead of the terminal."""
    logging.captureWarnings(True)
    try:
        yield
    finally:
        logging.captureWarnings(False)


def read_visibilities(path: Path, times: np.ndarray | None = None) -> UVData:
    """Read a UVH5 product as it was written, or only some of its integrations (JD)."""
    from pyuvdata import UVData

    keep_compiled_pyuvdata()
    return UVData.from_file(path, file_type="uvh5", run_check=False, times=times)


def integration_times(path: Path) -> np.ndarray:
    """Return the times (JD) of the integrations of a UVH5 product, ascending."""
    from pyuvdata.uvdata import FastUVH5Meta

    return np.unique(FastUVH5Meta(path).time_array)


def read_in_parts(paths: Sequence[Path], samples: int) -> Iterator[tuple[range, list[UVData]]]:
    """Read UVH5 products of the same times in parallel, in pieces of consecutive integrations.

    A piece has at most `samples` visibilities of each file, but at least one integration. Yield the indices of its
    integrations in the run, and the data of each file.
    """
    from pyuvdata.uvdata import FastUVH5Meta

    header, times = FastUVH5Meta(paths[0]), integration_times(paths[0])
    step = max(1, samples // (header.Nbls * header.Nfreqs * header.Npols))
    for first in range(0, times.size, step):
        part = range(first, min(first + step, times.size))
        yield part, [read_visibilities(path, times[part.start : part.stop]) for path in paths]


def write_visibilities(uvd: UVData, path: Path, single: bool = False) -> None:
    """Write UVH5; `single` stores complex64, whose rounding (6e-8) is far below any noise that a study adds."""
    # Visibilities are not compressed, and are read fastest in one piece.
    uvd.write_uvh5(path, data_write_dtype=np.dtype(np.complex64 if single else np.complex128), chunks=None)


def read_json(path: Path) -> Any:
    """Read a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write a JSON file; raises ValueError for NaN and infinity, which JSON does not have."""
    path.write_text(json.dumps(value, indent=1, allow_nan=False), encoding="utf-8")
