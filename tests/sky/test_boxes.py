"""Boxes of 21cmFAST: files of both versions, units, the power spectrum, and the part of a lightcone that counts."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from astropy.cosmology import Planck15
from scipy.stats import chi2, norm
from tiny import TINY, tiny

from calstudy.base.constants import HYDROGEN_LINE
from calstudy.base.errors import InputError
from calstudy.experiment.files import validate
from calstudy.power.cosmology import input_power
from calstudy.products.graph import Graph
from calstudy.products.realizations import inputs
from calstudy.sky.boxes import BINS_PER_DECADE, box_power, measure_power, read_box, redshifts_of
from calstudy.sky.eor import EorField
from calstudy.sky.settings import Eor
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.preflight import require_possible

CELLS, CELL = 64, 2.5
BAND = 180e6, 182e6
COSMOS = {"hlittle": Planck15.h, "OMm": Planck15.Om0, "OMb": Planck15.Ob0}
NEAREST, FARTHEST = Planck15.comoving_distance(redshifts_of(BAND)).to_value("Mpc")


def power_law(k):
    """P(k) in mK² Mpc³: 30 mK² in k³P/2π² at k = 0.2 per Mpc."""
    return 30 * 2 * np.pi**2 / 0.2**3 * (k / 0.2) ** -2.0


def drawn(shape, seed, cell=CELL):
    """A periodic Gaussian field with `power_law`, in mK: white noise, coloured."""
    white = np.fft.rfftn(np.random.default_rng(seed).standard_normal(shape))
    axes = [np.fft.fftfreq(shape[0], cell), np.fft.fftfreq(shape[1], cell), np.fft.rfftfreq(shape[2], cell)]
    k = 2 * np.pi * np.sqrt(sum(axis**2 for axis in np.meshgrid(*axes, indexing="ij")))
    k[0, 0, 0] = np.inf
    # White noise of unit variance per cell has the power of the volume of a cell.
    return np.fft.irfftn(white * np.sqrt(power_law(k) / cell**3), shape, axes=(0, 1, 2)).astype(np.float32)


def parameters(group, size, version):
    if version == 3:
        group.create_group("user_params").attrs.update({"HII_DIM": CELLS, **size})
        group.create_group("cosmo_params").attrs.update(COSMOS)
        return
    found = group.create_group("InputParameters")
    found.create_group("simulation_options").attrs.update({"HII_DIM": CELLS, **size})
    found.create_group("cosmo_params").attrs.update(COSMOS)


def coeval(path, brightness, version, redshift=6.85, size=None):
    """Write a box as `Coeval.save` does."""
    size = size or {"BOX_LEN": float(CELLS * CELL)}
    with h5py.File(path, "w") as file:
        box = file.create_group("BrightnessTemp")
        if version == 3:
            file.attrs["redshift"] = redshift
            box["brightness_temp"] = brightness
            parameters(file, size, 3)
        else:
            file.attrs["coeval"] = True
            box.attrs["redshift"] = redshift
            box["OutputFields/brightness_temp"] = brightness
            parameters(box, size, 4)
    return path


def lightcone(path, brightness, layout, nearest=NEAREST - 20.0, more=()):
    """Write a lightcone as `LightCone.save` does, of slices from a distance on; `layout` is 3.3, 3.4 or 4."""
    distances = nearest + CELL * np.arange(brightness.shape[-1])
    with h5py.File(path, "w") as file:
        file["lightcones/brightness_temp"] = brightness
        parameters(file, {"BOX_LEN": float(CELLS * CELL)}, int(layout))
        if layout == 3.3:
            file.attrs["redshift"] = np.interp(
                nearest, Planck15.comoving_distance(np.linspace(6, 8, 2001)).to_value("Mpc"), np.linspace(6, 8, 2001)
            )
        else:
            file["distances" if layout == 3.4 else "lightcone_distances"] = distances
        file.attrs.update(dict(more))
    return path


def assert_is_the_input(k, power, modes):
    """The mean of N independent complex modes over their P has 2N P̂/P from a χ² distribution of 2N, in all bins."""
    pulls = norm.ppf(chi2.cdf(2 * modes * power / power_law(k), 2 * modes))
    # One in 1e4 for the largest of 28 bins, and for all of them; the last bins have 1 % of scatter.
    assert np.abs(pulls).max() < 4.5
    assert chi2.ppf(5e-5, len(k)) < np.sum(pulls**2) < chi2.ppf(1 - 5e-5, len(k))


def independent_modes(shape, k_edges, means=True):
    """Pairs of modes in bins, counted over the whole grid."""
    axes = [np.fft.fftfreq(count, CELL) for count in shape]
    k = 2 * np.pi * np.sqrt(sum(axis**2 for axis in np.meshgrid(*axes, indexing="ij")))
    if not means:
        k[0, 0] = 0
    found, _ = np.histogram(k[k > 0], k_edges)
    return found[found > 0] / 2


def edges(shape):
    lowest, nyquist = 2 * np.pi / (CELL * max(shape)), np.pi / CELL
    inside = lowest * 10 ** ((np.arange(60) - 0.5) / BINS_PER_DECADE)
    return np.append(inside[inside < nyquist], nyquist * (1 + 1e-9))


@pytest.mark.parametrize("version", [3, 4])
def test_a_coeval_box_has_the_power_that_it_was_drawn_with(version, tmp_path):
    shape = (CELLS,) * 3
    path = coeval(tmp_path / "coeval.h5", drawn(shape, seed=version), version)
    k, power = box_power(path, BAND)
    assert read_box(path).redshift == 6.85
    assert k[0] == pytest.approx(2 * np.pi / (CELLS * CELL), rel=1e-6)
    assert_is_the_input(k, power, independent_modes(shape, edges(shape)))


@pytest.mark.parametrize("layout", [3.3, 3.4, 4])
def test_a_lightcone_has_the_power_that_it_was_drawn_with(layout, tmp_path):
    """Of a longer periodic field, so that the line of sight does not close; a steep mean is not in the power."""
    shape = (CELLS, CELLS, 80)
    brightness = drawn((CELLS, CELLS, 256), seed=4)[..., :80] + np.linspace(0, 1000, 80, dtype=np.float32)
    path = lightcone(tmp_path / "cone.h5", brightness, layout)
    part = read_box(path).part(BAND)
    k, power = box_power(path, BAND)
    depth = part.stop - part.start
    assert depth == CELLS + 1  # The band is 34 Mpc deep, less than the box is wide.
    modes = independent_modes((*shape[:2], depth), edges((*shape[:2], depth)), means=False)
    # The taper leaves ⟨w²⟩² / ⟨w⁴⟩ = 18/35 of the modes, and mixes neighbours: the lowest k are left out.
    assert_is_the_input(k[5:], power[5:], (18 / 35 * modes)[5:])


def test_a_plane_wave_has_a_quarter_of_its_square_times_the_volume():
    """A cos(kx) is two modes of A²V/4 each, of the six of the lowest k."""
    x = 2 * np.pi * np.arange(32) / 32
    wave = np.broadcast_to(7.0 + 3.0 * np.cos(x)[:, None, None], (32, 32, 32)).copy()
    k, power = measure_power(wave, 2.0, 2.0, periodic=True)
    assert k[0] == pytest.approx(2 * np.pi / 64)
    assert power[0] == pytest.approx(3.0**2 * 64.0**3 / 4 * 2 / 6)
    assert np.abs(power[1:]).max() < 1e-20 * power[0]


def test_a_lightcone_whose_line_of_sight_does_not_close_leaks_nothing_to_high_k():
    """Half a wave along the line of sight: without the taper it would have power at all k along it."""
    count = 64
    across = np.cos(2 * np.pi * np.arange(count) / count)[:, None, None]
    field = across * np.cos(np.pi * np.arange(count) / count) * np.ones((1, count, 1))
    tapered, rough = (measure_power(field.copy(), 2.0, 2.0, periodic=closed)[1] for closed in (False, True))
    assert tapered[-5:].max() < 1e-3 * rough[-5:].max()


def test_units_and_the_constant_beyond(tmp_path):
    """The input power of a study is that of the box, whatever h the study has, in its units; P is constant beyond."""
    path = coeval(tmp_path / "coeval.h5", drawn((CELLS,) * 3, seed=1), 4)
    k, power = box_power(path, BAND)
    settings = Eor(spectrum="box", path=path)
    for name, h in (("Planck15", Planck15.h), ("WMAP9", 0.6932)):
        np.testing.assert_allclose(input_power(settings, k / h, name, BAND), power * h**3, rtol=1e-9)
    ends = input_power(settings, [1e-4, 10.0], "Planck15", BAND)
    np.testing.assert_allclose(ends, power[[0, -1]] * Planck15.h**3, rtol=1e-9)


def test_a_sky_is_drawn_as_from_a_table_of_the_power_of_the_box(tmp_path):
    path = coeval(tmp_path / "coeval.h5", drawn((CELLS,) * 3, seed=2), 4)
    k, power = box_power(path, BAND)
    table = tmp_path / "power.txt"
    np.savetxt(table, np.column_stack([k / Planck15.h, power * Planck15.h**3]))
    frequencies = np.linspace(*BAND, 26)
    boxed, tabled = (
        EorField(Eor(spectrum=name, path=file, nside=16), frequencies)
        for name, file in (("box", path), ("table", table))
    )
    for ell in (5, 700):
        factors = boxed.covariance_factor(ell), tabled.covariance_factor(ell)
        np.testing.assert_allclose(*(factor @ factor.T for factor in factors), rtol=1e-9)
    np.testing.assert_allclose(boxed.maps(slice(0, 2)), tabled.maps(slice(0, 2)), rtol=1e-4, atol=1e-9)


def test_sizes_of_version_4(tmp_path):
    """Version 4 writes the size that was given: a length, a cell, or none for cells of 1.5 Mpc."""
    small = np.zeros((4, 4, 4), np.float32)
    for size, cell in (({"BOX_LEN": 8.0}, 2.0), ({"LOWRES_CELL_SIZE_MPC": 3.0}, 3.0), ({"DIM": 12}, 1.5)):
        path = coeval(tmp_path / f"{cell}.h5", small, 4, size=size)
        assert read_box(path).cell == cell


@pytest.mark.parametrize(("version", "size"), [(3, {"DIM": 12}), (4, {"_BOX_LEN": 8.0}), (4, {"BOX_LEN": "none"})])
def test_a_box_of_unknown_size_is_refused(tmp_path, version, size):
    path = coeval(tmp_path / "box.h5", np.zeros((4, 4, 4), np.float32), version, size=size)
    with pytest.raises(InputError, match="cannot be read as a file of 21cmFAST"):
        read_box(path)


def test_parts_of_a_lightcone(tmp_path):
    """A band at an end takes what is there; a deep band takes all of its redshifts; buffers are left out."""
    noise = np.random.default_rng(1).standard_normal((CELLS, CELLS, 100)).astype(np.float32)
    more = {"lowz_buffer_pixels": 8, "highz_buffer_pixels": 12}
    box = read_box(lightcone(tmp_path / "cone.h5", noise, 4, more=more))
    assert box.part(BAND) == slice(8, 8 + CELLS + 1)
    np.testing.assert_allclose(box.distances, NEAREST - 20.0 + CELL * np.arange(8, 88))
    deep = read_box(lightcone(tmp_path / "deep.h5", noise, 4, nearest=NEAREST - 20.0))
    low = np.interp(NEAREST + 180.0, *_distances())
    part = deep.part((HYDROGEN_LINE / (1 + low), BAND[1]))
    distances = deep.distances[part]
    assert distances[0] - CELL / 2 <= NEAREST
    assert distances[-1] + CELL / 2 >= NEAREST + 180.0
    assert abs(len(distances) - 180.0 / CELL) <= 2


def _distances():
    z = np.linspace(6, 8, 2001)
    return Planck15.comoving_distance(z).to_value("Mpc"), z


def test_redshift_space_is_preferred(tmp_path):
    noise = np.random.default_rng(1).standard_normal((8, 8, 80)).astype(np.float32)
    path = lightcone(tmp_path / "cone.h5", noise, 4)
    with h5py.File(path, "a") as file:
        file["lightcones/brightness_temp_with_rsds"] = 2 * noise
    assert read_box(path).field == "lightcones/brightness_temp_with_rsds"


def test_a_file_that_is_written_again_is_read_again(tmp_path):
    noise = np.random.default_rng(1).standard_normal((8, 8, 8)).astype(np.float32)
    path = tmp_path / "coeval.h5"
    (_, first), (_, second) = (box_power(coeval(path, noise, v, size=s), BAND) for v, s in ((4, None), (3, None)))
    np.testing.assert_allclose(first, second)
    _, third = box_power(coeval(path, 3 * noise, 4), BAND)
    np.testing.assert_allclose(third, 9 * first, rtol=1e-5)


def _no_box(path):
    with h5py.File(path, "w") as file:
        file["IonizedBox/xH_box"] = np.zeros((4, 4, 4))


NOISE = np.random.default_rng(3).standard_normal((8, 8, 80)).astype(np.float32)


@pytest.mark.parametrize(
    ("write", "sentence"),
    [
        (lambda path: path.write_text("0.1 1\n"), "cannot be read as a file of 21cmFAST 3 or 4"),
        (_no_box, "has no brightness_temp; use a coeval box or lightcone saved by 21cmFAST 3 or 4"),
        (lambda path: coeval(path, np.zeros((8, 8, 8), np.float32), 3), "has no fluctuations"),
        (lambda path: coeval(path, np.full((8, 8, 8), np.nan), 4), "has no fluctuations"),
        (lambda path: lightcone(path, NOISE[0], 4), r"has shape \(8, 80\); use a box or a rectilinear lightcone"),
        (
            lambda path: lightcone(path, NOISE, 3.4, nearest=NEAREST + 10),
            "from redshift 6.83 to 7.41 does not cover the band, 6.80 to 6.89; use one that does",
        ),
        (lambda path: lightcone(path, NOISE, 4, more={"last_completed_lcidx": 30}), "is not finished"),
    ],
)
def test_files_that_cannot_be_used_are_refused(write, sentence, tmp_path):
    path = tmp_path / "file.h5"
    write(path)
    with pytest.raises(InputError, match=sentence):
        box_power(path, BAND)


def test_slices_must_be_equally_far_apart(tmp_path):
    path = lightcone(tmp_path / "cone.h5", NOISE, 4)
    with h5py.File(path, "a") as file:
        file["lightcone_distances"][...] = NEAREST + np.arange(80.0) ** 1.1
    with pytest.raises(InputError, match="must be equally spaced in distance, as of with_equal_cdist_slices"):
        read_box(path)


def study(folder, path, **fields):
    eor = {"spectrum": "box", "path": str(path), "nside": 64}
    instrument = {**TINY["instrument"], "channels": {"first": f"{BAND[0]} Hz", "width": "100 kHz", "count": 21}}
    sky = {**TINY["sky"], "eor": eor}
    return ExperimentStudy(validate({**tiny(folder), "instrument": instrument, "sky": sky, **fields}, folder))


def test_a_plan_reads_what_a_file_holds(tmp_path):
    """A lightcone that lacks the band is refused, and a box of another redshift noted, before anything is simulated."""
    near, far = (coeval(tmp_path / f"{z}.h5", NOISE, 4, redshift=z) for z in (7.0, 7.2))
    assert study(tmp_path, near).notes == ()  # 2 % of 1 + z, as far as snapshots are apart, beyond 6.89.
    assert "a box of redshift 7.20 for a band of 6.80 to 6.89" in study(tmp_path, far).notes[0]
    cone = lightcone(tmp_path / "cone.h5", NOISE, 4, nearest=NEAREST + 10)
    with pytest.raises(InputError, match=r"does not cover the band, 6\.80 to 6\.89"):
        require_possible(study(tmp_path, cone).experiment)


def test_the_band_counts_for_realizations_of_a_box_and_no_other(tmp_path):
    """Pooling compares with the power of the part of a lightcone; without a box its keys are as before."""
    blocks = [{"draw": ["eor"], "count": 2}]
    boxed = study(tmp_path, lightcone(tmp_path / "cone.h5", NOISE, 4), realizations=blocks)
    plain = ExperimentStudy(validate({**tiny(tmp_path), "realizations": blocks}, tmp_path))
    for item, band in ((boxed, BAND), (plain, None)):
        reduced = [task for name, task in inputs(Graph(item.experiment)).items() if name.startswith("spectra:")]
        assert len(reduced) > 1
        assert all(task.settings.get("band") == band for task in reduced)


def test_memory_of_a_box_counts(tmp_path):
    """12 bytes for each of the cells that count: as read, and transformed."""
    small, large = (coeval(tmp_path / f"{count}.h5", np.ones((count,) * 3, np.float32), 4) for count in (4, 64))
    memory = [
        next(task.cost.memory for task in study(tmp_path, path).tasks if task.label == "eor 1/2")
        for path in (small, large)
    ]
    assert memory[1] - memory[0] == pytest.approx(12 * (64**3 - 4**3))
