"""Data of any shape become what calibration needs; nothing is invented, and everything that was changed is told."""

from __future__ import annotations

import numpy as np
import pytest
from observations import small_instrument
from pyuvdata import UVData
from toy import make_toy, scattered
from toy_data import make_uvdata

from calstudy.base.errors import InputError
from calstudy.base.gains import make_uvcal
from calstudy.base.visibilities import antenna_pairs, baseline_vectors, flag_cube, require_rectangular, to_cube
from calstudy.calibrate.sky_model import match_sky_model
from calstudy.instrument.telescope import make_template
from calstudy.realdata.halves import read_facts
from calstudy.realdata.reading import prepare, read_visibilities, share_times
from calstudy.realdata.selection import Selection, antenna_text, parse_values, select, split_selections


@pytest.fixture
def data(toy):
    return make_uvdata(toy, 3)


def test_complete_data_are_left_as_they_are(data):
    prepared, notes = prepare(data)
    assert notes == []
    assert np.array_equal(to_cube(prepared), to_cube(data))
    assert np.array_equal(antenna_pairs(prepared), antenna_pairs(data))


@pytest.mark.parametrize("order", ["baseline", "random"])
def test_any_order_becomes_time_major(data, order):
    shuffled = data.copy()
    if order == "baseline":
        shuffled.reorder_blts(order="baseline", minor_order="time")
    else:
        shuffled.reorder_blts(order=np.random.default_rng(1).permutation(data.Nblts))
    before = shuffled.copy()
    prepared, notes = prepare(shuffled)
    assert notes == []
    assert shuffled == before
    assert np.array_equal(to_cube(prepared), to_cube(data))
    prepared.check()


def test_baselines_that_are_reversed_in_some_samples_have_one_direction(data, tmp_path):
    """Each program has its own convention, and a night may have files of two."""
    mixed = data.copy()
    crosses = np.flatnonzero((mixed.ant_1_array != mixed.ant_2_array) & (mixed.time_array > mixed.time_array.min()))
    mixed.conjugate_bls(crosses[np.random.default_rng(4).random(crosses.size) < 0.5])
    prepared, notes = prepare(mixed)
    assert notes == []
    assert np.array_equal(antenna_pairs(prepared), antenna_pairs(data))
    assert np.allclose(to_cube(prepared), to_cube(data), rtol=1e-12)
    assert np.allclose(prepared.uvw_array, data.uvw_array)
    path = tmp_path / "mixed.uvh5"
    # pyuvdata still takes every baseline to be there at every time.
    mixed.blts_are_rectangular = False
    mixed.write_uvh5(path)
    assert read_facts((path,), Selection()).frame.n_baselines == len(antenna_pairs(data))
    # Those that are reversed in all samples are left as they are.
    data.conjugate_bls(np.arange(data.Nblts))
    kept = antenna_pairs(prepare(data)[0])
    assert np.array_equal(kept[:, ::-1], sorted(antenna_pairs(prepared).tolist(), key=lambda pair: pair[::-1]))


def test_missing_samples_are_flagged(data):
    keep = np.delete(np.arange(data.Nblts), [3, 40, 41])
    prepared, notes = prepare(data.select(blt_inds=keep, inplace=False))
    require_rectangular(prepared)
    prepared.check()
    assert notes == ["3 of 84 samples of a baseline at a time were missing and are flagged."]
    flags = flag_cube(prepared).reshape(84, 64)
    assert flags[[3, 40, 41]].all()
    assert not np.delete(flags, [3, 40, 41], 0).any()
    present = np.delete(np.arange(84), [3, 40, 41])
    assert np.array_equal(to_cube(prepared).reshape(84, -1)[present], to_cube(data).reshape(84, -1)[present])
    assert np.array_equal(prepared.time_array, data.time_array)
    assert np.array_equal(prepared.uvw_array, data.uvw_array)
    assert np.array_equal(prepared.baseline_array, data.baseline_array)


def test_samples_of_no_measurement_are_flagged_and_counted(data):
    """In pyuvdata's convention a sample with nsamples of zero holds no data."""
    data.nsample_array[5, 3] = 0
    data.nsample_array[6, 4], data.flag_array[6, 4] = 0, True
    prepared, notes = prepare(data)
    assert prepared.flag_array[5, 3].all()
    assert notes == ["1 samples are of no measurement (nsamples of 0) and were flagged."]
    # Programs that do not count leave all at zero: averages would be zero, and weights too.
    data.nsample_array[:] = 0
    uncounted, notes = prepare(data)
    assert notes == ["The file does not count measurements (all nsamples are 0); each sample counts as one."]
    assert (uncounted.nsample_array == 1).all()
    assert not uncounted.flag_array[5, 3].any()


def test_values_that_are_not_finite_are_flagged_and_counted(data):
    data.data_array[5, 3] = np.nan
    data.data_array[6, 4] = np.inf
    data.flag_array[6, 4] = True
    prepared, notes = prepare(data)
    assert prepared.flag_array[5, 3].all()
    assert notes == ["1 samples are not finite (NaN or infinite) and were flagged."]


def test_antennas_of_which_nothing_is_finite_are_named_and_can_be_written(tmp_path):
    data = make_uvdata(make_toy(scattered(5), autos=True), 2)
    autos = data.ant_1_array == data.ant_2_array
    data.data_array[autos] = np.abs(data.data_array[autos])
    data.data_array[(data.ant_1_array == 12) | (data.ant_2_array == 12)] = complex(np.nan, np.nan)
    data.data_array[0] = np.nan
    prepared, (note,) = prepare(data)
    assert note.endswith("are not finite (NaN or infinite) and were flagged, all that there are of antenna(s) 12.")
    prepared.write_uvh5(str(tmp_path / "data.uvh5"))


def test_data_without_common_times_are_refused(data):
    keep = [row for row in range(data.Nblts) if row % 28 < 2 or row < 28]
    with pytest.raises(InputError, match="only 38 % of the samples are present"):
        prepare(data.select(blt_inds=keep, inplace=False))


@pytest.mark.parametrize("times", [None, (0, 1), (1, 2)])
def test_a_plan_has_the_times_of_data_whose_averaging_differs(toy, tmp_path, times):
    """As they are once all baselines have the shortest integrations; also those of no sample before."""
    data = make_uvdata(toy, 4)
    short = data.ant_1_array == 10
    whole, averaged = (data.select(blt_inds=np.flatnonzero(chosen), inplace=False) for chosen in (short, ~short))
    averaged.downsample_in_time(n_times_to_avg=2, allow_drift=True)
    (whole + averaged).write_uvh5(str(tmp_path / "data.uvh5"))
    path, selection = tmp_path / "data.uvh5", Selection(times=times)
    facts = read_facts((path,), selection)
    prepared, _ = prepare(read_visibilities([path]), selection)
    assert np.array_equal(facts.times, np.unique(prepared.time_array))
    assert np.array_equal(facts.frame.pairs, antenna_pairs(prepared))
    assert facts.integration == prepared.integration_time[0]
    assert facts.copied


@pytest.mark.parametrize("case", ["last integration", "exposures", "gaps", "snapshot"])
def test_durations_that_differ_alike_for_all_baselines_are_counts(toy, case):
    """Nothing is copied: copies would put the noise of one sample into both halves of the data."""
    data = make_uvdata(toy, 1 if case == "snapshot" else 9)
    if case == "last integration":
        data.downsample_in_time(n_times_to_avg=4, allow_drift=True, keep_ragged=True)
    else:
        # Programs write the time of unflagged samples.
        data.integration_time[[3, 20]] *= 0.5
    if case == "gaps":
        # Of one baseline every other sample is missing, and of another all but a short one.
        number = np.arange(data.Nblts) // data.Nbls
        place = np.arange(data.Nblts) % data.Nbls
        data.select(blt_inds=np.flatnonzero(~((place == 5) & (number % 2 == 1)) & ~((place == 3) & (number > 0))))
    exposure = data.integration_time[:, None, None] * data.nsample_array
    prepared, notes = prepare(data)
    assert prepared.Ntimes == np.unique(data.time_array).size
    assert np.ptp(prepared.integration_time) == 0
    order = np.lexsort((data.baseline_array, data.time_array))
    known = prepared.nsample_array[:, 0, 0] > 0
    found = prepared.integration_time[:, None, None] * prepared.nsample_array
    assert np.allclose(found[known], exposure[order])
    assert any("with nsamples in proportion" in note for note in notes)
    metadata = data.copy(metadata_only=True)
    assert share_times(metadata, []) is False
    assert np.allclose(metadata.integration_time, prepared.integration_time[0])


def test_cross_hands_are_left_out_and_told(toy):
    both = make_uvdata(toy, 1, polarizations=(-5, -6))
    crossed = both.copy()
    crossed.polarization_array = np.array([-7, -8])
    crossed.check()
    prepared, notes = prepare(both + crossed)
    assert list(prepared.polarization_array) == [-5, -6]
    assert notes == ["Polarizations xy, yx are not calibrated."]
    with pytest.raises(InputError, match="no parallel hands"):
        prepare(crossed)


def test_phased_data_are_unphased(data):
    phased = data.copy()
    phased.phase(ra=0.3, dec=-0.4, cat_name="field", phase_frame="icrs")
    prepared, notes = prepare(phased)
    assert len(notes) == 1
    assert "drift scan" in notes[0]
    assert np.abs(to_cube(prepared) - to_cube(data)).max() < 1e-6 * np.abs(to_cube(data)).max()


def test_sky_models_are_matched_and_turned(data):
    sky = data.copy()
    sky.conjugate_bls(np.arange(0, 84, 2))
    sky.reorder_blts(order="baseline", minor_order="time")
    part = select(data, Selection(times=(1, 2), lengths=(0.0, 12.0)))
    prepared, _ = prepare(part)
    matched = match_sky_model(prepare(sky)[0], prepared)
    assert np.array_equal(to_cube(matched), to_cube(prepared))
    short = prepare(sky, Selection(frequencies=(170e6, None)))[0]
    with pytest.raises(InputError, match="lacks channels"):
        match_sky_model(short, prepared)
    with pytest.raises(InputError, match="lacks integrations"):
        match_sky_model(prepare(sky, Selection(times=(0, 0)))[0], prepared)
    with pytest.raises(InputError, match=r"lacks 4 baseline\(s\) of the data, such as"):
        match_sky_model(
            prepare(sky, Selection(antennas=("10", "12", "14", "16")))[0],
            prepare(data, Selection(antennas=("10", "12", "14", "16", "18")))[0],
        )


def test_sky_models_of_descending_channels_are_matched(data):
    sky = data.copy()
    sky.reorder_freqs(channel_order="-freq")
    assert np.array_equal(match_sky_model(sky, data).data_array, data.data_array)


def windows(data, starts, length):
    """Return data of spectral windows that start at these channels, in this order."""
    channels = np.concatenate([np.arange(start, start + length) for start in starts])
    made = data.copy()
    for name in ("freq_array", "channel_width"):
        setattr(made, name, getattr(data, name)[channels])
    for name in ("data_array", "flag_array", "nsample_array"):
        setattr(made, name, getattr(data, name)[:, channels])
    made.Nfreqs, made.Nspws, made.spw_array = channels.size, len(starts), np.arange(len(starts))
    made.flex_spw_id_array = np.repeat(made.spw_array, length)
    made.check()
    return made


def test_channels_of_windows_in_any_order_ascend(data):
    prepared, _ = prepare(windows(data, (32, 0, 48), 16))
    kept = data.select(freq_chans=[*range(16), *range(32, 64)], inplace=False)
    assert np.array_equal(prepared.freq_array, kept.freq_array)
    assert np.array_equal(prepared.data_array, kept.data_array)
    prepared.check()
    gains = make_uvcal(prepared, np.ones((prepared.telescope.Nants, 48, 3, 1), complex))
    assert np.array_equal(gains.freq_array, kept.freq_array)
    with pytest.raises(InputError, match=r"spectral windows overlap: one ends at 169.600 MHz, and the next starts at"):
        prepare(windows(data, (0, 20), 25))


def selected(texts):
    return parse_values(split_selections(texts), "--select ")


def test_selections_are_read_and_applied(data):
    selection = selected(
        ["antennas=10,ant12,16", "times=1..", "frequencies=165 MHz..170 MHz", "polarizations=ee", "lengths=0 m..500 m"]
    )
    assert selection.times == (1, None)
    part = select(data, selection)
    assert (part.Nants_data, part.Ntimes, part.Npols) == (3, 2, 1)
    assert part.freq_array.min() >= 165e6
    assert part.freq_array.max() <= 170e6


@pytest.mark.parametrize(
    ("text", "length"),
    [("lengths=14 m..50 m", 14), ("lengths=10 m..14 m", 14), ("lengths=28 m..28 m", 28), ("lengths=..42 m", 42)],
)
def test_all_baselines_of_the_length_of_an_end_are_selected(text, length):
    """Lengths are differences of positions in space, which are rounded."""
    data = make_template(small_instrument(layout={"kind": "hex", "side": 3, "spacing": "14 m"}, times={"count": 1}))
    lengths = np.linalg.norm(baseline_vectors(data), axis=1)
    found = np.linalg.norm(baseline_vectors(select(data, selected([text]))), axis=1)
    alike = [np.sum(np.abs(array - length) < 0.01) for array in (found, lengths)]
    assert alike[0] == alike[1] > 2
    assert found.size < lengths.size


def test_channels_at_the_ends_are_selected(data):
    frequencies = np.ravel(data.freq_array)
    low, high = frequencies[5] + 1e-6, frequencies[9] - 1e-6
    assert select(data, Selection(frequencies=(low, high))).Nfreqs == 5


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("antenna=3", "write one of antennas="),
        ("times=3", "write a range such as times=0..9"),
        ("times=a..b", "not a whole number"),
        ("frequencies=100..200", "has no unit"),
        ("antennas=999", "'999' is not in the data"),
        ("polarizations=xy", "not in the data, which have xx"),
        ("times=50..", "no integrations in this range; the data have 0 to 2"),
        ("times=-1..", "not a whole number of at least 0"),
        ("times=2..1", "exchange them"),
        ("frequencies=1 MHz..2 MHz", r"no channels in this range; the data have 160 MHz to 185\.2 MHz"),
        ("lengths=900 m..", r"no baselines in this range; the data have [\d.]+ m to [\d.]+ m"),
    ],
)
def test_bad_selections_are_one_sentence(data, text, match):
    with pytest.raises(InputError, match=match):
        select(data, selected([text]))


def test_files_come_back_as_written(data, tmp_path):
    data.write_uvh5(str(tmp_path / "a.uvh5"))
    assert np.array_equal(read_visibilities([tmp_path / "a.uvh5"]).data_array, data.data_array)
    parts = [data.select(times=[time], inplace=False) for time in np.unique(data.time_array)]
    paths = [tmp_path / f"{index}.uvh5" for index in range(3)]
    for part, path in zip(parts, paths, strict=True):
        part.write_uvh5(str(path))
    assert read_visibilities(paths).Ntimes == 3
    (tmp_path / "note.uvh5").write_text("no data")
    with pytest.raises(InputError, match="cannot be read as visibilities"):
        read_visibilities([tmp_path / "note.uvh5"])
    with pytest.raises(InputError, match="no such file"):
        read_visibilities([tmp_path / "none.uvh5"])
    assert isinstance(data, UVData)


def test_a_name_that_is_the_number_of_another_antenna_is_refused(data):
    swapped = data.copy()
    names = swapped.telescope.antenna_names
    names[0], names[1] = str(swapped.telescope.antenna_numbers[1]), str(swapped.telescope.antenna_numbers[0])
    with pytest.raises(InputError, match=r"antenna 12 and the number of '12'; write 'name:10' or 'number:10'"):
        prepare(swapped, Selection(antennas=("10", "14", "16")))


def test_numbers_and_names_of_antennas_are_told_apart(data):
    swapped = data.copy()
    names = swapped.telescope.antenna_names
    names[0], names[1] = "12", "10"
    assert [antenna_text(swapped, number) for number in (10, 12, 14)] == ["number:10", "number:12", "14"]
    for texts, numbers in ((("number:10", "14"), {10, 14}), (("name:10", "ant14"), {12, 14})):
        part = select(swapped, Selection(antennas=texts))
        assert set(antenna_pairs(part).ravel().tolist()) == numbers
    for text in ("number:7", "name:14", "number:ant14"):
        with pytest.raises(InputError, match=f"'{text}' is not in the data, which have 10, 12"):
            select(swapped, Selection(antennas=(text,)))
