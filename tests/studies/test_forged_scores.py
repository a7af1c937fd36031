"""What others submit reaches no file but their own, and a page only as numbers and plain text."""

import html
import json
import os
import re
import shutil
from hashlib import sha256

import h5py
import numpy as np
import pytest
from observations import small_instrument
from score_rows import row

from calstudy.base.errors import InputError
from calstudy.base.gain_files import read_gains
from calstudy.base.gains import make_uvcal
from calstudy.base.table import Table, one_line
from calstudy.base.visibilities import from_cube
from calstudy.calibrate.calibrators.given_gains import MANIFEST, DataSet, Manifest, find_returned, read_manifest
from calstudy.calibrate.sky_model import read_sky_model
from calstudy.instrument.telescope import make_template
from calstudy.realdata.reading import read_metadata, read_visibilities
from calstudy.sky.foregrounds import make_foregrounds
from calstudy.sky.settings import FileSources
from calstudy.studies.scores import Row, Scores, leaderboard, tables

NAMES = [
    "../gains",
    "../../store/calibrate/0123/gains",
    "/etc/passwd",
    "a/b",
    "..",
    ".hidden",
    "",
    "a\\b",
    "data-1\n",
    "data\x00",
    "~root",
    "x" * 200,
]


def manifest(name="data-1", **more):
    data = [{"name": name, "file": "data-1.uvh5", "digest": "d", **more}]
    return json.dumps({"calstudy": "0", "digest": "e", "data": data})


@pytest.mark.parametrize("name", NAMES)
def test_names_in_a_manifest_are_names_in_its_folder(name, tmp_path):
    for text in (manifest(name), manifest(file=name), json.dumps({**json.loads(manifest()), "sky_model": name})):
        (tmp_path / MANIFEST).write_text(text)
        with pytest.raises(InputError, match=r"manifest.json: is not a manifest .*(pattern|characters)"):
            find_returned(tmp_path, "d", None)


@pytest.fixture(scope="module")
def true_files(tmp_path_factory):
    """Gains and visibilities that nobody may read through a file of theirs."""
    folder = tmp_path_factory.mktemp("truth")
    template = make_template(small_instrument())
    shape = (template.Nants_telescope, template.Nfreqs, 1, template.Npols)
    make_uvcal(template, np.ones(shape, complex)).write_calh5(folder / "gains.calh5")
    cube = np.ones((template.Ntimes, template.Nbls, template.Nfreqs, template.Npols), complex)
    from_cube(template, cube).write_uvh5(folder / "data.uvh5")
    return folder


LINKS = ["gains.calh5", "world-1", "manifest.json", "data-1.model.uvh5", "in a table"]


@pytest.mark.parametrize("kind", LINKS)
def test_links_do_not_lead_out_of_the_folder(kind, true_files, tmp_path):
    outside, folder = tmp_path / "outside", tmp_path / "submitted"
    shutil.copytree(true_files, outside)
    world = folder / "world-1"
    world.mkdir(parents=True)
    (world / MANIFEST).write_text(manifest())
    shutil.copyfile(outside / "gains.calh5", world / "data-1.calh5")
    assert find_returned(folder, "d", None).gains == world / "data-1.calh5"
    if kind == "world-1":
        shutil.move(world, outside / "world")
        world.symlink_to(outside / "world")
    elif kind == "in a table":
        (world / "data-1.calh5").unlink()
        (world / "data-1.cal").mkdir()
        (world / "data-1.cal" / "table.dat").symlink_to(outside / "gains.calh5")
    else:
        name = "data-1.calh5" if kind == "gains.calh5" else kind
        (world / name).unlink(missing_ok=True)
        (outside / MANIFEST).write_text(manifest())
        (world / name).symlink_to(outside / {"manifest.json": MANIFEST}.get(kind, "gains.calh5"))
    with pytest.raises(InputError, match="is a link that leads out of"):
        find_returned(folder, "d", None)


def external_link(file, name, true):
    del file[name]
    file[name] = h5py.ExternalLink(os.path.relpath(true, file.filename), name)


def absolute_link(file, name, true):
    del file[name]
    file[name] = h5py.ExternalLink(str(true), name)


def group_link(file, name, true):
    group = name.rpartition("/")[0]
    del file[group]
    file[group] = h5py.ExternalLink(str(true), group)


def through_a_soft_link(file, name, true):
    del file[name]
    file["other"] = h5py.ExternalLink(str(true), name)
    file[name] = h5py.SoftLink("/other")


def unused_link(file, name, true):
    file.create_group("deep/down")["x"] = h5py.ExternalLink(str(true), name)


def dangling_link(file, name, true):
    file["x"] = h5py.ExternalLink("nowhere.h5", "x")


def raw_data(file, name, true):
    shape, kind = file[name].shape, file[name].dtype
    del file[name]
    file.create_dataset(name, shape, kind, external=[(str(true), 0, h5py.h5f.UNLIMITED)])


def raw_scalar(file, name, true):
    file.create_dataset("x", (4,), "u1", external=[("/etc/passwd", 0, 4)])


def virtual(file, name, true, path=None):
    layout = h5py.VirtualLayout(file[name].shape, file[name].dtype)
    layout[...] = h5py.VirtualSource(str(path or true), name, file[name].shape)
    del file[name]
    file.create_virtual_dataset(name, layout)


def virtual_of_itself(file, name, true):
    file["y"] = file[name]
    virtual(file, name, true, ".")


FORGERIES = [
    external_link,
    absolute_link,
    group_link,
    through_a_soft_link,
    unused_link,
    dangling_link,
    raw_data,
    raw_scalar,
    virtual,
    virtual_of_itself,
]


@pytest.mark.parametrize("forge", FORGERIES, ids=lambda forge: forge.__name__)
def test_hdf5_files_hold_their_own_data(forge, true_files, tmp_path):
    """At each door where a file of others comes in; the same files unchanged are read."""
    template = make_template(small_instrument())
    doors = {
        "gains.calh5": ("Data/gains", [lambda path: read_gains(path, "gains")]),
        "data.uvh5": (
            "Data/visdata",
            [
                lambda path: read_sky_model(path, template),
                lambda path: read_visibilities([path]),
                lambda path: read_metadata([path]),
                lambda path: make_foregrounds(FileSources(kind="file", path=path), np.array([1.5e8])),
            ],
        ),
    }
    for file, (name, readers) in doors.items():
        path = tmp_path / file
        shutil.copyfile(true_files / file, path)
        assert readers[0](path) is not None
        with h5py.File(path, "r+") as opened:
            forge(opened, name, true_files / file)
        for reader in readers:
            with pytest.raises(InputError, match=r"is an external link|is a virtual data set|is external raw data"):
                reader(path)


def submitted(folder, scores=None, band=None, name="mine", **more):
    content = Scores(calstudy="0", name="c", rows=(row("1", "mine", (0, 0), 0.1, (0.9, 0.9)),)).model_dump()
    found = content["rows"][0]
    found["calibrator"] = name
    for item in found["scores"]["bands"]:
        item.update(band or {})
    found["scores"].update(scores or {})
    content.update(more)
    (folder / f"{sha256(name.encode()).hexdigest()}.json").write_text(json.dumps(content))


NUMBERS = [
    {"band": {"transfer": "0.9"}},
    {"band": {"transfer": True}},
    {"band": {"transfer": [1.0]}},
    {"band": {"transfer": float("nan")}},
    {"band": {"transfer": float("inf")}},
    {"band": {"bias_error": -0.1}},
    {"band": {"transfer_error": -1e-9}},
    {"band": {"bias": "0.001 ± 0.001"}},
    {"band": {"bias": 1e300}},
    {"band": {"bias": 10**400}},
    {"band": {"k": [0.1, 0.2]}},
    {"band": {"k": [0.0, 9.0]}},
    {"scores": {"bands": []}},
    {"scores": {"bands": 3}},
    {"scores": {"flux_scale": "<b>1</b>"}},
    {"scores": {"gain_error_aligned": -1.0}},
    {"scores": {"by_status": {"<script>": 1}}},
    {"scores": {"by_status": {"converged": -3}}},
    {"scores": {"by_status": {"converged": 1.5}}},
    {"scores": {"peak_memory": "1 GB"}},
]


@pytest.mark.parametrize("forged", NUMBERS, ids=str)
def test_numbers_are_numbers_in_range(forged, tmp_path):
    submitted(tmp_path, **forged)
    with pytest.raises(InputError, match=r"is not a file of 'calstudy score --output' \(rows.0.scores: .*\)$"):
        leaderboard(tmp_path)


@pytest.mark.parametrize("transfer", [7, 1.2, 1e9, -3, -0.2, 2, 1.11, 1.5, 3, 100])
def test_more_than_all_of_the_signal_is_not_ranked(transfer, tmp_path):
    """The error of T is 0.1 here."""
    submitted(tmp_path, name="honest")
    submitted(tmp_path, name="forged", band={"transfer": transfer, "bias": 0.001, "bias_error": 0.0})
    text = leaderboard(tmp_path)
    assert re.findall(r"^\| (honest|forged) \| (.*) \|", text, re.MULTILINE)[:2] == [
        ("honest", "2 of 2, T 0.90 | -"),
        ("forged", "0 of 2 | -"),
    ]


def test_a_large_error_of_t_does_not_make_it_larger(tmp_path):
    submitted(tmp_path, name="forged", band={"transfer": 7, "transfer_error": 10})
    submitted(tmp_path, name="honest", band={"transfer": 1.0, "bias_error": 0.05})
    assert re.findall(r"^\| (honest|forged) \|", leaderboard(tmp_path), re.MULTILINE)[2:] == ["honest", "forged"]


TEXTS = [
    "<script>alert(1)</script>",
    "<img src=x onerror=alert(1)>",
    "mine\n# Winner",
    "mine\r\n\r\n| forged | 3 of 3 |",
    "[click](javascript:alert(1))",
    "![x](https://example.org/x.png)",
    "&lt;b&gt;",
    "`code`",
    "**bold**",
    "a | b",
    "https://example.org",
    "a\u202eb",
    "\x1b[31mred",
    "<!-- comment",
]


@pytest.mark.parametrize("text", TEXTS)
def test_names_are_plain_and_refusals_are_escaped(text, tmp_path):
    for forged in ({"name": text}, {"refusals": [["1", text, "why"]]}, {"refusals": [[text, "a", "why"]]}):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        submitted(folder, **forged)
        with pytest.raises(InputError, match="String should match pattern"):
            leaderboard(folder)
    submitted(tmp_path, refusals=[["1", "other", text]])
    [line] = [line for line in leaderboard(tmp_path).splitlines() if "cannot work here" in line]
    written = line.partition("here: ")[2]
    assert written == one_line(text)
    assert not re.search(r"<[A-Za-z/!?]|(?<!\\)[\[\]`*|!]|(?<!\\)://", written)
    # A reader sees the text itself, not its entities.
    shown = "".join(letter if letter.isprintable() else " " for letter in text).strip()
    assert html.unescape(re.sub(r"\\(.)", r"\1", written)) == shown
    table = Table(("a", text), [(text, "b")]).markdown()
    assert len(table.splitlines()) == 3
    assert not re.search(r"<[A-Za-z/!?]|\x1b|\u202e", table)


def test_a_row_is_verified_where_somebody_else_says_so_of_this_very_file(tmp_path):
    submitted(tmp_path)
    [path] = tmp_path.glob("*.json")
    (tmp_path / "verified.txt").write_text(f"{sha256(path.read_bytes()).hexdigest()}  A. Referee, 2026\n")
    assert "| mine | 2 of 2, T 0.90 | A. Referee, 2026 |" in leaderboard(tmp_path)
    submitted(tmp_path, band={"transfer": 0.99})
    assert "| mine | 2 of 2, T 0.99 | - |" in leaderboard(tmp_path)


def test_manifests_of_an_export_are_read(tmp_path):
    whole = Manifest(calstudy="0", digest="d", data=(DataSet(name="data-1", file="data-1.ms", digest="e"),))
    (tmp_path / MANIFEST).write_text(whole.model_dump_json())
    assert read_manifest(tmp_path / MANIFEST) == whole


def test_a_refusal_counts_in_a_world_without_rows():
    rows = (row("easy", "mine", (0, 0), 0.01, (0.9, 0.9)),)
    found = tables(Scores(calstudy="0", name="c", rows=rows, refusals=(("hard", "mine", "no redundant baselines"),)))
    assert list(found) == ["easy", "Which calibrator to trust"]
    assert found["Which calibrator to trust"].rows[0][1:] == 2 * ("fails in hard (cannot work)",)


def test_scores_of_files_have_the_linear_response_of_a_comparison():
    """T at the end of a fit depends on its path, and the smaller one counts."""
    made = row("world", "mine", [0.0, 0.0], 0.01, [0.5, 0.9])
    for linear, verdict in ((None, "passes"), (0.0, "fails")):
        known = {"linear_transfer": linear, "transfer_error": 0.02}
        scores = {**made.scores, "bands": [{**band, **known} for band in made.scores["bands"]]}
        rows = Row(**{**made.model_dump(), "scores": scores})
        found = tables(Scores(calstudy="0", name="mine", rows=(rows,)))["Which calibrator to trust"]
        assert verdict in str(found.rows[0][1]), found.rows
