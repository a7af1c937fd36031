"""Read visibilities of the known part of the sky from a file, and match them to samples and order of the data."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calstudy.base.errors import InputError
from calstudy.base.feeds import with_feeds_of
from calstudy.base.foreign_files import require_self_contained
from calstudy.base.visibilities import from_cube, polarization_names, positions, to_cube

if TYPE_CHECKING:
    from pyuvdata import UVData


def read_sky_model(path: Path, template: UVData) -> UVData:
    """Read visibilities, in Jy, and return them with the metadata of an observation, at its samples.

    The file has any format of visibilities that pyuvdata reads. Antennas are matched by number; their positions may
    differ from those of the template, the metadata of the observation: rectangular, time-major, a drift scan.

    Raises InputError if the file cannot be read or takes data from other files, lacks baselines, integrations, channels
    or polarizations of the observation, or has flagged samples or values that are not finite among them.
    """
    from pyuvdata import UVData

    require_self_contained(path)
    try:
        sky = UVData.from_file(str(path))
    # Readers of eight formats raise whatever their libraries do; a file that cannot be read is the user's to mend.
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError, RuntimeError, ImportError) as error:
        raise InputError(f"{path}: cannot be read as visibilities ({type(error).__name__}: {error})") from None
    if sky.data_array is None:
        raise InputError(f"{path}: holds no visibilities")
    if any(entry["cat_type"] != "unprojected" for entry in sky.phase_center_catalog.values()):
        sky.unproject_phase()
    sky = match_sky_model(sky, template)
    if sky.Nblts != template.Nblts:
        raise InputError(f"{path}: lacks some baselines at some times")
    bad = sky.flag_array | ~np.isfinite(sky.data_array)
    if bad.any():
        raise InputError(f"{path}: {bad.sum()} samples are flagged or not finite; a sky model needs a value in each")
    order = np.argsort(template.baseline_array[: template.Nbls])
    cube = np.empty((template.Ntimes, template.Nbls, template.Nfreqs, template.Npols), complex)
    cube[:, order] = to_cube(sky)  # Which is in the order of the baselines' numbers.
    return from_cube(template, cube)


def common_baselines(sky: UVData, data: UVData, autos: bool) -> tuple[UVData, UVData, list[str]]:
    """Match a prepared sky model and prepared data in their baselines, and describe each change in one sentence.

    Cross-correlations that the sky model lacks are left out of the data. Autocorrelations that it lacks stay, with a
    sky model of zero, unless they are fitted (`autos`): weights may need them. Samples that are flagged in the sky
    model are flagged in the returned data. The inputs are from `calstudy.realdata.reading.prepare`, and not changed;
    the returned sky model has the samples of the returned data, in their order. Raises InputError if no
    cross-correlation is in both, all are zero or flagged in the sky model, or as `match_sky_model`.
    """
    known = {frozenset(pair) for pair in zip(sky.ant_1_array.tolist(), sky.ant_2_array.tolist(), strict=True)}
    pairs = list(zip(data.ant_1_array.tolist(), data.ant_2_array.tolist(), strict=True))
    modelled = np.array([frozenset(pair) in known for pair in pairs])
    are_autos = np.array([a == b for a, b in pairs])
    if not (modelled & ~are_autos).any():
        raise InputError("sky model: has none of the cross-correlations of the data (antennas are matched by number)")
    kept, notes = modelled | (are_autos & (not autos)), []
    if not kept.all():
        lost = sorted({pair for pair, keep in zip(pairs, kept, strict=True) if not keep})
        notes.append(f"{len(lost)} baselines that the sky model lacks are left out, such as {lost[0]}.")
        data = data.select(blt_inds=np.flatnonzero(kept), inplace=False)
        modelled = modelled[kept]
    whole = modelled.all()
    part = match_sky_model(sky, data if whole else data.select(blt_inds=np.flatnonzero(modelled), inplace=False))
    if not (~part.flag_array & (part.data_array != 0))[part.ant_1_array != part.ant_2_array].any():
        raise InputError("sky model: where the data are, all of it is zero or flagged; it must be visibilities")
    unknown = part.flag_array & ~data.flag_array[modelled]
    if not autos:
        unknown[part.ant_1_array == part.ant_2_array] = False
    if unknown.any():
        data = data.copy()
        data.flag_array[modelled] |= unknown
        notes.append(f"{unknown.sum()} samples that are flagged in the sky model, or missing there, were flagged.")
    part.data_array[part.flag_array] = 0
    if whole:
        return part, data, notes
    filled = from_cube(data, np.zeros((data.Ntimes, data.Nbls, data.Nfreqs, data.Npols), complex))
    filled.data_array[modelled] = part.data_array
    return filled, data, notes


def match_sky_model(sky: UVData, data: UVData) -> UVData:
    """Select the samples of prepared data, whose channels ascend, from a sky model, in their order.

    Feeds are those of the same directions. Raises InputError if baselines, integrations, channels or polarizations of
    the data are missing from the sky model.
    """
    sky = with_feeds_of(sky, data).copy()
    sky.reorder_freqs(channel_order="freq", spw_order="freq", run_check=False)
    wanted = np.unique(data.baseline_array)
    reverse = data.antnums_to_baseline(sky.ant_2_array, sky.ant_1_array)
    turned = np.flatnonzero(~np.isin(sky.baseline_array, wanted) & np.isin(reverse, wanted))
    if turned.size:
        sky.conjugate_bls(turned)
    missing = np.setdiff1d(wanted, sky.baseline_array)
    if missing.size:
        a, b = data.baseline_to_antnums(int(missing[0]))
        raise InputError(f"sky model: lacks {len(missing)} baseline(s) of the data, such as ({a}, {b})")
    times = [_closest(sky.time_array, time, 1e-6) for time in np.unique(data.time_array)]
    if None in times:
        raise InputError("sky model: lacks integrations of the data (times must agree within 0.1 s)")
    width = float(np.min(data.channel_width))
    channels = [_closest(sky.freq_array, frequency, 0.1 * width) for frequency in data.freq_array]
    if None in channels:
        raise InputError("sky model: lacks channels of the data")
    if not np.isin(data.polarization_array, sky.polarization_array).all():
        has, needs = (polarization_names(uvd.polarization_array) for uvd in (sky, data))
        raise InputError(f"sky model: has polarizations {has}, data {needs}")
    rows = np.isin(sky.baseline_array, wanted) & np.isin(sky.time_array, sky.time_array[times])
    sky.select(blt_inds=np.flatnonzero(rows), freq_chans=channels, polarizations=data.polarization_array)
    sky.reorder_pols(order=positions(sky.polarization_array, data.polarization_array), run_check=False)
    sky.reorder_blts(order="time", minor_order="baseline", run_check=False)
    return sky


def _closest(values: np.ndarray, wanted: float, tolerance: float) -> int | None:
    index = int(np.abs(values - wanted).argmin())
    return index if abs(values[index] - wanted) <= tolerance else None
