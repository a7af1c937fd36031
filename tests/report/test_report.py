"""The report: complete, self-contained, and safe whatever a run is called."""

import base64
import dataclasses
import html.parser
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from report_content import CLAIM, MANIFEST, PNG, product

from calstudy.base.errors import InputError
from calstudy.base.table import Table, to_json
from calstudy.power.settings import PowerSettings
from calstudy.power.tables import save_spectrum
from calstudy.power.transfer import TransferFunction
from calstudy.products.signal_loss import SweepSummary, Transfer
from calstudy.report.page import page_of as rendered
from calstudy.report.page import read_contents, recorded_warnings, write_report
from calstudy.results.reader import RunFolder


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "manifest.json").write_text(json.dumps(MANIFEST))
    (tmp_path / "experiment.yaml").write_text("name: demo\ndescription: What it is <about>\n")
    (tmp_path / "figures").mkdir()
    for name in ("wedge", "spherical", "zebra"):
        (tmp_path / "figures" / f"{name}.png").write_bytes(PNG)
    (tmp_path / "tables").mkdir()
    return tmp_path


class Page(html.parser.HTMLParser):
    """Collects tags, attributes and text of a page, and checks that tags are closed."""

    VOID = ("meta", "img", "br", "input")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.words = ""
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.attributes += [(tag, name, value) for name, value in attributes]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words += data


def page_of(folder: Path) -> Page:
    return Page(write_report(folder).read_text())


def test_the_page_needs_nothing_but_itself(folder):
    page = page_of(folder)
    sources = [value for _, name, value in page.attributes if name == "src"]
    assert sources
    assert all(value.startswith("data:image/png;base64,") for value in sources)
    assert "url(" not in page.words
    assert "@import" not in page.words
    assert "link" not in {tag for tag, _, _ in page.attributes}
    # Links lead within the page, or to files of the run folder.
    links = [value for _, name, value in page.attributes if name == "href"]
    assert all(link.startswith("#") or (folder / link).is_file() for link in links)


def test_tables_of_one_subject_have_one_link_in_the_menu(folder):
    tables = [Table(("k",), [("1",)], title) for title in ("Scores: ideal", "Scores: no sky", "Stages")]
    contents = dataclasses.replace(read_contents(RunFolder(folder)), tables=tables)
    page = Page(rendered("page.html", contents=contents))
    links = [value for _, name, value in page.attributes if name == "href" and value.startswith("#table")]
    assert links == ["#table-1", "#table-3"]


def test_figures_are_in_the_page_as_they_are_in_the_folder(folder):
    page = page_of(folder)
    images = [value.split(",")[1] for tag, name, value in page.attributes if (tag, name) == ("img", "src")]
    assert [base64.b64decode(image) for image in images] == [PNG] * 3
    assert page.words.index("wedge: The <wedge>.") < page.words.index("spherical") < page.words.index("zebra")


def test_curves_say_what_their_bars_are_and_maps_have_none(folder):
    """Pictures may have 95 % bars."""
    curve = dict.fromkeys(("k", "power", "noise_error", "sample_error"), np.ones(2))
    np.savez(folder / "figures" / "zebra.npz", **{f"excised.residual.{name}": item for name, item in curve.items()})
    cube = dict.fromkeys(("k_perp", "k_parallel", "baseline_length", "horizon_delay", "delay"), np.ones(2))
    arrays = {f"residual.{name}": item for name, item in {**cube, "power": np.ones((2, 2))}.items()}
    np.savez(folder / "figures" / "wedge.npz", **arrays)
    words = page_of(folder).words
    assert "Power spectra (bars: 1 σ)" in words
    assert "Cylindrical power spectra{" in words


def test_captions_and_their_order_are_those_of_the_manifest(folder):
    captions = {"zebra": "Stripes & all.", "wedge": "", "gone": "Not drawn."}
    (folder / "manifest.json").write_text(json.dumps({**MANIFEST, "captions": captions}))
    found = [(picture.name, picture.caption) for picture in read_contents(RunFolder(folder)).pictures]
    assert found == [("zebra", "Stripes & all."), ("wedge", ""), ("spherical", "")]
    (folder / "manifest.json").write_text(json.dumps({"name": "old"}))
    found = [(picture.name, picture.caption) for picture in read_contents(RunFolder(folder)).pictures]
    assert found == [("spherical", ""), ("wedge", ""), ("zebra", "")]


def test_text_of_a_run_is_text_and_not_markup(folder):
    page = page_of(folder)
    assert "beam: <gaussian> & so on" in page.words
    assert "What it is <about>" in page.words


def rows(folder: Path, title: str) -> list[tuple[str, ...]]:
    return [
        tuple(row) for table in read_contents(RunFolder(folder)).tables if table.title == title for row in table.rows
    ]


def test_convergence_simulation_and_stages_are_told(folder):
    assert rows(folder, "Solver convergence") == [("V even", "7 converged, 1 max-steps", "4", "0.25 s")]
    assert rows(folder, "Accuracy of the simulation") == [
        ("foregrounds", "1.5e-11", "-55.5 dB (hann)"),
        ("eor", "not interpolated", ""),
    ]
    assert rows(folder, "Stages")[-1] == ("figure", "2", "2", "60 s", "2 min", "2.50 GB")
    assert read_contents(RunFolder(folder)).warnings == ["calibrate (V even): 1 of 8 solves did not converge"]


def test_warnings_that_differ_in_numbers_alone_are_given_once():
    said = [
        ("calibrate", "V even", "6 of 6 solves stalled, at 2.5e-01"),
        ("calibrate", "V odd", "5 of 6 solves stalled, at 1"),
        ("calibrate", "V odd", "noise dominates"),
        ("power", "V", "6 of 6 solves stalled, at 2.5e-01"),
    ]
    records = [{"stage": stage, "label": label, "notes": {"warnings": [text]}} for stage, label, text in said]
    assert recorded_warnings(records) == [
        "calibrate (V even, and 1 more): 6 of 6 solves stalled, at 2.5e-01",
        "calibrate (V odd): noise dominates",
        "power (V): 6 of 6 solves stalled, at 2.5e-01",
    ]


def test_claims_are_a_table_if_there_are_any(folder):
    assert rows(folder, "Claims of the paper") == []
    unknown = {**CLAIM, "measured": None, "uncertainty": None, "verdict": "not evaluated"}
    failed = {**CLAIM, "verdict": "contradicted"}
    (folder / "claims.json").write_text(json.dumps([CLAIM, unknown, failed]))
    found = rows(folder, "Claims of the paper")
    assert [row[-1] for row in found] == ["supported", "contradicted"]
    assert found[0][3] == "1.23 ± 0.10"
    page = page_of(folder)
    assert ("td", "class", "contradicted") in page.attributes
    assert "1 further claims were not evaluated" in page.words


def test_a_run_without_a_role_has_a_sentence_in_place_of_the_table(folder):
    told = product("claims", "claims", verdicts="", failed=[], without_role=["The run plays no role in mine: small."])
    (folder / "manifest.json").write_text(json.dumps({**MANIFEST, "products": [told]}))
    (folder / "claims.json").write_text("[]")
    assert "The run plays no role in mine: small." in page_of(folder).words
    (folder / "manifest.json").write_text(json.dumps({**MANIFEST, "products": []}))
    assert "Claims of the paper" not in page_of(folder).words


def save_transfer(path: Path, values: list[float], scale: float = 1.1) -> None:
    """Save T s^2; without one, a bin has no modes. A scale that is NaN leaves T alone, as of measured data."""
    numbers, error = np.array(values), np.full(len(values), 0.01)
    edges = 0.1 * np.arange(1, len(values) + 2)
    found = TransferFunction(
        **dict.fromkeys((item.name for item in dataclasses.fields(TransferFunction)), error)
        | {
            "bin_edges": edges,
            "k": edges[1:],
            "transfer": numbers if np.isnan(scale) else numbers / scale**2,
            "scale_free_transfer": numbers * scale / scale,
            "squared_coherence": numbers,
            "signal": numbers,
            "flux_scale": scale,
        }
        | {"squared_coherence_error": 2 * error}
    )
    save_spectrum(path, found)


def test_tables_of_products_are_in_the_page_as_they_were_written(folder):
    save_transfer(folder / "transfer-bands.outside-wedge.h5", [0.25, 0.9])
    save_transfer(folder / "transfer-bands.inside-wedge.h5", [0.03, float("nan")], scale=float("nan"))
    needed = dict.fromkeys(("signal", "response", "cross", "spectra", "scale"))
    shown = Transfer("signal loss", power=PowerSettings(), **needed).shown(folder)
    assert [tuple(row) for row in shown[0].rows] == [
        ("0.1 to 0.2", "0.250 ± 0.010", "0.250 ± 0.020", "0.030 ± 0.010"),
        ("0.2 to 0.3", "0.900 ± 0.010", "0.900 ± 0.020", "no modes"),
    ]
    assert rows(folder, "Signal loss") == []
    (folder / "tables" / "tables.json").write_text(to_json(shown))
    assert rows(folder, "Signal loss") == list(shown[0].rows)


def test_the_summary_of_a_sweep_is_shown_with_a_row_per_point(tmp_path):
    rows = [
        {
            "point": point,
            "region": region,
            **dict(zip(("k from [h/Mpc]", "k to [h/Mpc]"), band, strict=True)),
            **{"transfer": value, "transfer error": 0.01},
            **{f"transfer without flux scale{column}": free for column in ("", " error")},
        }
        for point, values, free in (("01-a", (0.5, 7.9), float("nan")), ("02-b", (0.25, 0.75), 0.1))
        for region in ("outside-wedge", "inside-wedge")
        for value, band in zip(values, ((0.1, 0.2), (0.2, 0.3)), strict=True)
    ]
    Table.of_records(rows).write_csv(tmp_path / "summary.csv")
    (table,) = SweepSummary("all points", points={}, measured={}).shown(tmp_path)
    assert table.columns == ("point", "k = 0.1 to 0.2 h/Mpc", "k = 0.2 to 0.3 h/Mpc")
    assert table.rows == [
        ("01-a", "0.500 ± 0.010", "not measured (7.900 ± 0.010)"),
        ("02-b", "0.100 ± 0.100", "0.100 ± 0.100"),
    ]


def test_what_the_run_wrote_and_is_gone_is_said(folder):
    products = [
        {"stage": "figure", "label": "wedge"},
        {"stage": "figure", "label": "gains"},
    ]
    content = json.loads((folder / "manifest.json").read_text())
    content["tables"] = ["comparison.json"]
    content["products"] = [{**content["products"][0], "label": "", **new} for new in products]
    (folder / "manifest.json").write_text(json.dumps(content))
    said = "missing, and written by the run: comparison.json, gains.png; run it again"
    assert read_contents(RunFolder(folder)).warnings[0] == said
    assert said in page_of(folder).words


def test_a_sweep_and_a_collection_lead_to_the_reports_of_their_parts(folder):
    points = [{"folder": "points/01-buffer=0ns", "changes": {}}]
    members = {"hex": "hex-12345678", "kept": "kept"}
    for name in members.values():
        (folder.parent / name).mkdir()
    (folder / "points" / "01-buffer=0ns").mkdir(parents=True)
    (folder / "points" / "01-buffer=0ns" / "report.html").touch()
    # A reference has no page.
    (folder.parent / "hex-12345678" / "report.html").touch()
    (folder / "manifest.json").write_text(
        json.dumps({"name": "both", "points": points, "members": members, "products": []})
    )
    links = [value for tag, name, value in page_of(folder).attributes if (tag, name) == ("a", "href")]
    assert "points/01-buffer=0ns/report.html" in links
    assert "../hex-12345678/report.html" in links
    assert not any("kept" in link for link in links)


def test_what_is_no_run_folder_is_told(folder, tmp_path_factory):
    empty = tmp_path_factory.mktemp("empty")
    with pytest.raises(InputError, match="not the folder of a finished run"):
        write_report(empty)
    (folder / "manifest.json").write_text("{")
    with pytest.raises(InputError, match="not valid JSON"):
        write_report(folder)
    for field in ("products", "tables", "captions", "parts", "stand_ins", "warnings", "versions", "machine"):
        for wrong in (3, "x", [1], None):
            (folder / "manifest.json").write_text(json.dumps({**MANIFEST, field: wrong}))
            with pytest.raises(InputError, match=rf"not the manifest of a run \({field}.*\); run the experiment again"):
                write_report(folder)
    (folder / "manifest.json").write_text("[]")
    with pytest.raises(InputError, match="not the manifest"):
        write_report(folder)


def test_the_same_folder_gives_the_same_page(folder):
    first = write_report(folder).read_bytes()
    assert write_report(folder).read_bytes() == first
    assert sorted(path.name for path in folder.iterdir() if path.name.startswith(".")) == []
    shutil.rmtree(folder / "figures")
    assert not re.search("Figures", page_of(folder).words)
