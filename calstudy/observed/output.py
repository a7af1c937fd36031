"""Files of a calibration in standard formats, which replace existing ones only on request."""

from __future__ import annotations

import errno
import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from calstudy import __version__
from calstudy.base.errors import InputError, error_number, refusal_of_disk
from calstudy.calibrate.records import CalibrationResult
from calstudy.run.store import require_writable

GAINS, CALFITS, MODEL, RESIDUAL = "gains.calh5", "gains.calfits", "model.uvh5", "residual.uvh5"
SOLUTION, FIGURE, EXPECTED = "solution.json", "diagnostics", "expected-transfer"
FIGURE_FILES = tuple(f"{FIGURE}.{ending}" for ending in ("npz", "pdf", "png"))


def require_free(folder: Path, extras: Sequence[str], overwrite: bool) -> None:
    """Raise InputError if the folder cannot be written, or a file exists that may not be replaced.

    `extras` names the optional files: `CALFITS`, `EXPECTED`.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--output {folder}: is a file, not a folder")
    names = [GAINS, MODEL, RESIDUAL, SOLUTION, *FIGURE_FILES, *([CALFITS] if CALFITS in extras else [])]
    present = [name for name in names if (folder / name).exists()]
    if EXPECTED in extras:
        present += [path.name for path in sorted(folder.glob(f"{EXPECTED}.*.h5"))]
    if present and not overwrite:
        raise InputError(f"--output {folder}: holds {', '.join(present)} already; use --overwrite or another folder")
    require_writable(folder.absolute(), f"--output {folder}")


def describe(result: CalibrationResult, context: dict[str, Any]) -> dict[str, Any]:
    """Return the content of solution.json: the request, the changes of the data, and every solve.

    `context` has JSON types: settings, notes and the like.
    """
    summary = result.summary()
    return {
        "calstudy": __version__,
        **context,
        "solves": summary["solves"],
        "by_status": summary["by_status"],
        "seconds": summary["seconds"],
        "records": [record.detail() for record in result.solutions],
    }


@contextmanager
def writing_to(folder: Path) -> Iterator[None]:
    """Make a folder for the files of the block; raise InputError if the disk is full or the folder vanishes.

    Any other error is a bug, and passes.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except (OSError, RuntimeError) as error:
        vanished = error_number(error) == errno.ENOENT
        reason = "it was removed while it was written" if vanished else refusal_of_disk(error)
        if reason is None:
            raise
        raise InputError(
            f"--output {folder}: cannot be written ({reason}); make room or choose another folder, and run again"
        ) from None


def write_result(
    result: CalibrationResult,
    description: dict[str, Any],
    folder: Path,
    figure: Any,
    extras: Sequence[str] = (),
    expected: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write gains, model, residual, solution.json and the diagnostic figure; all of them or none.

    Parameters
    ----------
    description
        From `describe`.
    folder
        Made if it does not exist; files of the same names are replaced.
    figure
        A matplotlib figure and its arrays.
    extras
        `CALFITS` to write the gains as calfits as well.
    expected
        Expected transfer functions, by polarization.

    Raises
    ------
    InputError
        If the folder cannot be written, or was removed meanwhile.
    """
    from calstudy.plotting.save import save_figure
    from calstudy.power.tables import save_spectrum

    with writing_to(folder), tempfile.TemporaryDirectory(dir=folder, prefix=".writing-") as temporary:
        work = Path(temporary)
        result.gains.write_calh5(str(work / GAINS))
        if CALFITS in extras:
            result.gains.write_calfits(str(work / CALFITS))
        for name, uvd in ((MODEL, result.model), (RESIDUAL, result.residual)):
            uvd.write_uvh5(str(work / name), data_write_dtype=np.dtype(np.complex64))
        (work / SOLUTION).write_text(json.dumps(description, indent=1, allow_nan=False), encoding="utf-8")
        for polarization, transfer in (expected or {}).items():
            save_spectrum(work / f"{EXPECTED}.{polarization}.h5", transfer)
        picture, arrays = figure
        save_figure(picture, arrays, work, FIGURE)
        written = sorted(work.iterdir())
        for path in written:
            shutil.move(path, folder / path.name)
    return [folder / path.name for path in written]
