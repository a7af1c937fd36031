"""A table of one's own in ``outputs.tables``, and which names and requests are refused."""

from __future__ import annotations

import csv

import pytest
import yaml
from plugin_files import example
from tiny import tiny

from calstudy.base.errors import ExperimentError, InputError
from calstudy.results.reader import RunFolder
from calstudy.run.execution import Budget
from calstudy.studies.load import load_study
from calstudy.studies.study import run_study

NAME, CODE, _ = example("A table")
EMPTY = """
from calstudy.products.table import StudyTable

class Empty(StudyTable):
    def rows(self, job):
        return []
"""


def study_of(folder, *tables, **changes):
    """Return the tiny experiment with these tables, without figures."""
    (folder / NAME).write_text(CODE)
    data = {**tiny(folder), **changes}
    data["outputs"] = {**data["outputs"], "store": str(folder / "store"), "figures": [], "tables": list(tables)}
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(data))
    return load_study(path)


@pytest.fixture
def folder(tmp_path, shared_store):
    (tmp_path / "store").symlink_to(shared_store)
    return tmp_path


def test_it_is_in_the_run_folder_in_full_and_in_the_report_in_three_digits(folder):
    run = run_study(study_of(folder, NAME), Budget(workers=1))
    with (run.folder / "tables" / "band_power.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = RunFolder(run.folder)
    assert [row["variant"] for row in rows] == list(found.experiment().variants)
    # What is measured of the EoR alone is positive, and less than with foregrounds.
    power = {row["variant"]: float(row["power"]) for row in rows}
    assert 0 < power["eor"] < power["uncalibrated"]
    (shown,) = [table for table in found.shown if table.title == "Power of all variants"]
    assert dict(shown.rows)["eor"] == f"{power['eor']:.3g}"
    assert shown.title in (run.folder / "report.html").read_text()


def test_its_settings_and_its_code_are_in_its_key(folder):
    def key(table):
        return next(task.key for task in study_of(folder, table).tables if task.stage.name == "table")

    first = key(NAME)
    assert key({"kind": NAME, "max_k": "1 h/Mpc"}) != first
    (folder / "other.py").write_text(CODE.replace("nanmean", "nanmedian"))
    assert key("other.py") != first


@pytest.mark.parametrize(
    ("tables", "changes", "told"),
    [
        (["as-built.py"], {}, "outputs.tables.0: 'as-built' cannot name a table"),
        ([NAME, NAME], {}, "outputs.tables.1: 'band_power' cannot name a table, or does so already"),
        (["observed-results"], {}, "asks for 'observed-results', which is of files of the kind 'observed'"),
        ([NAME], {"realizations": {"draw": ["eor"], "count": 2}}, "outputs.tables: are tables of single runs"),
    ],
)
def test_what_cannot_be_had_is_told_when_the_file_is_read(tmp_path, tables, changes, told):
    (tmp_path / "as-built.py").write_text(CODE)
    with pytest.raises(ExperimentError) as caught:
        study_of(tmp_path, *tables, **changes)
    assert told in str(caught.value)


def test_a_product_that_a_study_lacks_is_no_table_of_it(tmp_path):
    study = study_of(tmp_path, "score", variants={"eor": {"components": ["eor"]}})
    with pytest.raises(InputError, match="asks for 'score', and there is no such product"):
        study.sized_to(Budget(workers=1))


def test_a_table_without_rows_is_refused(folder):
    (folder / "empty.py").write_text(EMPTY)
    with pytest.raises(InputError, match="table 'empty': rows must return one or more mappings"):
        run_study(study_of(folder, "empty.py"), Budget(workers=1))
