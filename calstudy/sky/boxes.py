"""Brightness of 21cmFAST, coeval boxes and lightcones: what their files hold, and their power spectra.

The sky is not sampled from a box, but drawn with its power spectrum (`calstudy.sky.eor`). A pixel of a map of nside 256
is about 36 Mpc wide, and a cell 1 to 2 Mpc: samples of a box at the centres of pixels would alias its power on small
scales, and averages within pixels need boxes for the whole sky. What is measured, T, bias and power, are second
moments, which the power spectrum decides.

Layouts, by py21cmfast 3.0 to 4.2 (files of 3.4.0 and 4.1.1 were read): version 3 has
``BrightnessTemp/brightness_temp`` or ``lightcones/brightness_temp`` with the attributes of ``user_params`` and
``cosmo_params``; version 4 puts fields and parameters of a box into ``BrightnessTemp/OutputFields`` and
``BrightnessTemp/InputParameters``, and the parameters of a lightcone into ``InputParameters``. Brightness is in mK and
lengths are in Mpc, without h.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.fft
from astropy import units
from astropy.cosmology import FLRW, Planck15, z_at_value

from calstudy.base.constants import HYDROGEN_LINE
from calstudy.base.errors import InputError
from calstudy.base.files import kept_while_unchanged
from calstudy.base.foreign_files import require_self_contained

FIELDS = (
    "lightcones/brightness_temp_with_rsds",
    "lightcones/brightness_temp",
    "BrightnessTemp/OutputFields/brightness_temp",
    "BrightnessTemp/brightness_temp",
)
"""Where brightness is, the one that is used first; an interferometer sees redshift space."""
DEFAULT_CELL = 1.5
"""Mpc; version 4 writes no size where it is the default."""
BINS_PER_DECADE = 20
"""With P ∝ k^-3, the mean of such a bin is 0.6 % above P at its mean log k; the modes of a bin scatter more."""
MEMORY_PER_CELL, SECONDS_PER_CELL = 12.0, 1e-7


@dataclass(frozen=True)
class Box:
    """What the file of a coeval box or a lightcone holds.

    `field` is the name of the brightness in the file, of `shape` cells, the line of sight last. `slices` are those
    without buffers. `cell` is the size of a cell across the line of sight, and `depth` along it, Mpc. A coeval box has
    a `redshift`; a lightcone has the comoving distances of its slices, Mpc, (Nslices,), in its own `cosmology`.
    """

    path: Path
    field: str
    shape: tuple[int, ...]
    slices: slice
    cell: float
    depth: float
    redshift: float | None = None
    distances: np.ndarray | None = None
    cosmology: FLRW | None = None

    def part(self, band: tuple[float, float]) -> slice:
        """Return the slices that count for a band, of which the centres of the first and the last channel are in Hz.

        All of a coeval box; of a lightcone, those of the redshifts of the band, and around them as many as make it as
        deep as wide, if it has them. Raises InputError if a lightcone does not cover the band.
        """
        if self.distances is None or self.cosmology is None:
            return self.slices
        near, far = self.cosmology.comoving_distance(redshifts_of(band)).to_value("Mpc")
        first, last = self.distances[0], self.distances[-1]
        if near < first - self.depth / 2 or far > last + self.depth / 2:
            ends = (float(z_at_value(self.cosmology.comoving_distance, end * units.Mpc)) for end in (first, last))
            raise _refused(
                self.path,
                "a lightcone from redshift {:.2f} to {:.2f} does not cover the band, {:.2f} to {:.2f}; use one that "
                "does, or change instrument.channels".format(*ends, *redshifts_of(band)),
            )
        wanted = max(far - near, self.cell * self.shape[0])
        count = min(int(np.ceil(wanted / self.depth)) + 1, len(self.distances))
        before = round(((near + far) / 2 - first) / self.depth - (count - 1) / 2)
        start = self.slices.start + min(max(before, 0), len(self.distances) - count)
        return slice(start, start + count)

    def n_cells(self, band: tuple[float, float]) -> int:
        """Return the number of cells that count for a band."""
        part = self.part(band)
        return self.shape[0] * self.shape[1] * (part.stop - part.start)


def redshifts_of(band: tuple[float, float]) -> np.ndarray:
    """Return the lowest and the highest redshift of a band in Hz, (2,)."""
    return HYDROGEN_LINE / np.array([max(band), min(band)]) - 1


@kept_while_unchanged(8)
def read_box(path: Path) -> Box:
    """Read the content of a file of 21cmFAST, without its cells; raises InputError if it has no brightness."""
    require_self_contained(path)
    try:
        with h5py.File(path, "r") as file:
            name = next((name for name in FIELDS if name in file), None)
            if name is None:
                raise _refused(path, "has no brightness_temp; use a coeval box or lightcone saved by 21cmFAST 3 or 4")
            if file[name].ndim != 3 or min(file[name].shape) < 2:
                raise _refused(path, f"{name} has shape {file[name].shape}; use a box or a rectilinear lightcone")
            return _lightcone(path, file, name) if name.startswith("lightcones") else _coeval(path, file, name)
    except InputError:
        raise
    except (OSError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise _refused(path, f"cannot be read as a file of 21cmFAST 3 or 4 ({error})") from None


@kept_while_unchanged(8)
def box_power(path: Path, band: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return k in 1/Mpc and P(k) in mK² Mpc³ of the part of a file that counts for a band in Hz.

    Raises InputError if there is no power in it.
    """
    box = read_box(path)
    with h5py.File(path, "r") as file:
        brightness = np.asarray(file[box.field][..., box.part(band)], dtype=np.float32)
    k, power = measure_power(brightness, box.cell, box.depth, periodic=box.distances is None)
    if not (len(k) and np.isfinite(power).all() and (power > 0).all()):
        raise _refused(path, f"{box.field} has no fluctuations, or not at all k; use a box that is not all ionized")
    return k, power


def measure_power(brightness: np.ndarray, cell: float, depth: float, periodic: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return k and P(k) = ⟨|∫ T(x) exp(-ikx) dx|²⟩ / volume, averaged over directions, in logarithmic bins of k.

    Brightness is in mK, (Nx, Ny, Nz), the line of sight last; it is overwritten, for boxes are large. `cell` and
    `depth` are the size of a cell across and along the line of sight, Mpc, and `periodic` is whether the latter is.

    Bins end at the Nyquist wavenumber of the larger size of a cell, and those without modes are left out. The smoothing
    by the cell is not corrected: k that an interferometer measures are far below that.

    The mean is removed: of a periodic box that of all cells, otherwise that of each slice, for the evolution of the
    mean has no structure on the sky, and interferometers do not see it. Lines of sight that are not periodic are
    tapered with sin², divided by its mean square, or what does not close would leak to high k.
    """
    taper = np.ones(brightness.shape[2])
    if not periodic:
        taper = np.sin(np.pi * (np.arange(len(taper)) + 0.5) / len(taper)) ** 2
    axes = None if periodic else (0, 1)
    brightness -= brightness.mean(axis=axes, dtype=float).astype(brightness.dtype)
    brightness *= taper.astype(brightness.dtype)
    volume = brightness.size * cell**2 * depth
    scale = volume / brightness.size**2 / np.mean(taper**2)
    transform = scipy.fft.rfftn(brightness, overwrite_x=True)
    k, power = _average(transform, (cell, cell, depth), brightness.shape, means=not periodic)
    return k, scale * power


def _average(
    transform: np.ndarray, sizes: tuple[float, float, float], shape: tuple[int, ...], means: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean log k, as k, and the mean |F|² of bins; `means`: without the modes of the means of slices."""
    across = 2 * np.pi * np.fft.fftfreq(shape[0], sizes[0]), 2 * np.pi * np.fft.fftfreq(shape[1], sizes[1])
    along = 2 * np.pi * np.fft.rfftfreq(shape[2], sizes[2])
    # A transform of real numbers has one of each pair of modes with opposite k, but for those that are their own.
    pairs = np.where((along == 0) | (2 * np.arange(len(along)) == shape[2]), 1.0, 2.0)
    lowest = min(2 * np.pi / (count * size) for count, size in zip(shape, sizes, strict=True))
    nyquist = np.pi / max(sizes)
    # The lowest k is in the middle of a bin, so that rounding does not decide where it is.
    n_bins = int(np.log10(nyquist / lowest) * BINS_PER_DECADE) + 2
    total = np.zeros((3, n_bins))
    for row, kx in zip(transform, across[0], strict=True):
        k = np.sqrt(kx**2 + across[1][:, None] ** 2 + along**2)
        used = (k > 0) & (k <= nyquist * (1 + 1e-9))
        if means and kx == 0:
            used[0] = False
        log_k = np.log10(k[used])
        place = ((log_k - np.log10(lowest)) * BINS_PER_DECADE + 0.5).astype(int)
        weight = np.broadcast_to(pairs, k.shape)[used]
        power = (row.real**2 + row.imag**2)[used]
        for sums, values in zip(total, (1.0, log_k, power), strict=True):
            sums += np.bincount(place, weight * values, n_bins)
    modes, log_k, power = total[:, total[0] > 0]
    return 10 ** (log_k / modes), power / modes


def _coeval(path: Path, file: h5py.File, name: str) -> Box:
    shape, group = file[name].shape, file["BrightnessTemp"]
    cell = _cell(_parameters(group if "InputParameters" in group else file)[0], shape)
    redshift = float(group.attrs["redshift"] if "redshift" in group.attrs else file.attrs["redshift"])
    return Box(path, name, shape, slice(0, shape[2]), cell, cell, redshift)


def _lightcone(path: Path, file: h5py.File, name: str) -> Box:
    size, cosmos = _parameters(file)
    shape = file[name].shape
    cell = _cell(size, shape)
    cosmology = Planck15.clone(H0=100 * cosmos["hlittle"], Om0=cosmos["OMm"], Ob0=cosmos["OMb"])
    start = int(file.attrs.get("lowz_buffer_pixels", 0))
    slices = slice(start, shape[2] - int(file.attrs.get("highz_buffer_pixels", 0)))
    known = next((item for item in ("lightcone_distances", "distances") if item in file), None)
    if known is None:
        nearest = cosmology.comoving_distance(float(file.attrs["redshift"])).to_value("Mpc")
        distances = nearest + cell * np.arange(shape[2])
    else:
        distances = file[known][...]
    distances = distances[slices]
    steps = np.diff(distances)
    if not len(steps) or steps.min() <= 0 or np.ptp(steps) > 1e-3 * steps.mean():
        raise _refused(path, "slices of a lightcone must be equally spaced in distance, as of with_equal_cdist_slices")
    if int(file.attrs.get("last_completed_lcidx", -1)) > start:
        raise _refused(path, "the lightcone is not finished; let 21cmFAST complete it")
    return Box(path, name, shape, slices, cell, float(steps.mean()), distances=distances, cosmology=cosmology)


def _parameters(group: h5py.Group) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return the parameters of the size, and those of the cosmology, in the names of 21cmFAST."""
    if "InputParameters" in group:
        found = group["InputParameters"]
        size = dict(found["simulation_options"].attrs)
        # Versions before 4.0.0 wrote the size under another name where it is not the default.
        default = {} if "_BOX_LEN" in size else {"LOWRES_CELL_SIZE_MPC": DEFAULT_CELL}
        return default | size, found["cosmo_params"].attrs
    return group["user_params"].attrs, group["cosmo_params"].attrs


def _cell(size: Mapping[str, Any], shape: tuple[int, ...]) -> float:
    """Return the size of a cell, Mpc."""
    return float(size["BOX_LEN"]) / shape[0] if "BOX_LEN" in size else float(size["LOWRES_CELL_SIZE_MPC"])


def _refused(path: Path, sentence: str) -> InputError:
    return InputError(f"sky.eor.path = {str(path)!r}: {sentence}")
