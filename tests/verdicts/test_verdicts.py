"""Thresholds, verdicts and statements; their tables and files, which can be read back."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from rich.console import Console

from calstudy.base.table import Table, number
from calstudy.verdicts.criterion import AtLeast, AtMost, Criterion, Equal, Finding, Within
from calstudy.verdicts.statement import Sentence, Source, Unevaluated
from calstudy.verdicts.tables import (
    BY_SOLVER_JSON,
    BY_SOLVER_MARKDOWN,
    CLAIMS_JSON,
    CLAIMS_MARKDOWN,
    combined,
    from_json,
    measured,
    outcomes_of_sentences,
    show_verdicts,
    tally_of_sentences,
    to_json,
    to_markdown,
    write_claims,
    write_claims_by_solver,
)

SECTION = Source("Results", ("ours", "theirs"))
ROLES = {"ours": "a run of ours", "theirs": "a run of theirs"}


@dataclass(frozen=True)
class Run:
    """A run whose one result is a number."""

    name: str
    result: float


@SECTION.states("ours | theirs are alike", "ratio", Within(0.5, 2), "a factor of two")
def ratio_near_one(ours: Run, theirs: Run) -> Finding:
    if not theirs.result:
        raise Unevaluated("theirs is zero")
    return Finding(ours.result / theirs.result, 0.1)


def evaluate(ours: float, theirs: float):
    return ratio_near_one.evaluate({"ours": Run("a", ours), "theirs": Run("b", theirs)}, ROLES)


@given(st.floats(-10, 10), st.floats(1e-3, 3), st.floats(-5, 5))
def test_thresholds_are_what_they_say(value, uncertainty, bound):
    finding = Finding(value, uncertainty)
    assert AtLeast(bound).holds(finding) == (value >= bound)
    assert AtMost(bound).holds(finding) == (value <= bound)
    # Also where the uncertainty is not known.
    for within in (finding, Finding(value, math.inf)):
        assert Within(bound, bound + 1).holds(within) == (bound <= value <= bound + 1)
    assert AtLeast(bound, 2).holds(finding) <= AtLeast(bound).holds(finding)
    assert not (AtLeast(bound, 2).holds(finding) and AtMost(bound, 2).holds(finding))
    assert Equal(bound).holds(finding) == (abs(value - bound) <= 2 * uncertainty)


def test_a_number_decides_and_one_that_is_not_finite_does_not():
    criterion = Criterion("name", "section", "sentence", "quantity", AtMost(1), "because")
    outcomes = [criterion.judge(Finding(value, 0.0)).verdict for value in (0.5, 1.5, float("nan"), float("inf"))]
    assert outcomes == ["PASS", "FAIL", "not evaluated", "not evaluated"]
    assert criterion.judge(Finding(0.5, float("nan"))).reason == "the measured number is not finite"


def test_a_statement_is_measured_on_the_runs_that_play_its_roles_in_their_order():
    assert ratio_near_one.name == "ratio-near-one"
    verdict = evaluate(1.0, 4.0)
    assert (verdict.verdict, verdict.measured, verdict.runs) == ("contradicted", 0.25, ("a", "b"))
    assert evaluate(1.0, 1.0).verdict == "supported"


def stated(threshold, sentence="it is so", source=SECTION, name="of_a_number"):
    """A statement whose number is given to its `judge`."""

    def measure() -> Finding:
        raise NotImplementedError

    measure.__name__ = name
    return source.states(sentence, "number", threshold, "because")(measure)


@given(st.floats(-10, 10), st.floats(1e-3, 3), st.floats(-5, 5))
def test_the_95_percent_interval_decides_a_statement(value, uncertainty, bound):
    finding, outcomes = Finding(value, uncertainty), {}
    for threshold in (AtLeast(bound), AtMost(bound), Within(bound, bound + 1), Equal(bound)):
        verdict = stated(threshold).judge(finding)
        outcomes[type(threshold)] = verdict.verdict
        reach = (value - 2 * uncertainty, value + 2 * uncertainty)
        assume(all(abs(end - limit) > 1e-6 for end in reach for limit in (threshold.low, threshold.high)))
        inside = [threshold.low <= end <= threshold.high for end in reach]
        outside = reach[1] < threshold.low or reach[0] > threshold.high
        assert verdict.verdict == ("supported" if all(inside) else "contradicted" if outside else "undecided")
        assert verdict.smallest_effect == (2 * uncertainty if verdict.verdict == "undecided" else None)
    # What is not precise supports nothing, and both sides of a limit are open at once.
    assert outcomes[Equal] != "supported"
    assert (outcomes[AtLeast] == "undecided") == (outcomes[AtMost] == "undecided")


@pytest.mark.parametrize(
    ("finding", "threshold", "outcome"),
    [
        (Finding(3.0, 0.0), AtMost(3), "supported"),
        (Finding(3.1, 0.0), AtMost(3), "contradicted"),
        (Finding(0.0, 0.0), Equal(0), "supported"),
        # A bound decides where it is beyond the limit, and nothing else.
        (Finding(20_000, 0.0, "at least"), Within(1e3, 1e4), "contradicted"),
        (Finding(9000, 0.0, "at least"), Within(1e3, 1e4), "undecided"),
        (Finding(9000, 0.0, "at least"), AtLeast(1e3), "supported"),
        (Finding(9000, 0.0, "at most"), AtMost(1e4), "supported"),
        (Finding(900, 0.0, "at most"), AtLeast(1e3), "contradicted"),
        # What touches a limit is not beyond it, whatever the last digit.
        (Finding(0.12, 0.04), Within(0.2, 0.4), "undecided"),
        (Finding(0.3, 0.05), Within(0.2, 0.4), "supported"),
        # A scatter over baselines is no error of their median, unless the sentence is about it.
        (Finding(1.5, 1.0, "scatter"), AtMost(2), "supported"),
        (Finding(1.5, 1.0, "scatter"), AtMost(2, sigmas=2), "undecided"),
        (Finding(2.5, 1.0, "scatter"), AtMost(2), "contradicted"),
    ],
)
def test_numbers_without_error_bounds_and_scatters_decide(finding, threshold, outcome):
    verdict = stated(threshold).judge(finding)
    assert verdict.verdict == outcome
    assert from_json(to_json([verdict])) == [verdict]
    assert (finding.kind in measured(verdict)) == (finding.kind != "error")
    assert ("±" in measured(verdict)) == (finding.kind == "error" and finding.uncertainty > 0)


def test_what_would_have_been_seen_is_in_the_tables(tmp_path):
    verdict = stated(AtLeast(0, 2)).judge(Finding(0.016, 0.013))
    assert (verdict.verdict, measured(verdict)) == ("undecided", "0.016 ± 0.013; smallest effect seen 0.026")
    write_claims([verdict], tmp_path, "run")
    assert "smallest effect seen 0.026" in (tmp_path / CLAIMS_MARKDOWN).read_text()


def test_sentences_are_counted_and_statements_on_the_simulation_apart(tmp_path):
    both, simulated = Sentence("both", "this and that"), Source("Results", (), tests_simulation=True)
    yes, no, open_ = Finding(1, 0.1), Finding(-1, 0.1), Finding(0, 0.1)
    verdicts = [
        stated(AtLeast(0), both, name="first").judge(yes),
        stated(AtLeast(0), both, name="second").judge(no),
        stated(AtLeast(0), name="third").judge(open_),
        stated(AtLeast(0), Sentence("fourth", "so"), name="a").judge(yes),
        stated(AtLeast(0), Sentence("fourth", "so"), name="b").unevaluated("no run"),
        stated(AtLeast(0), both, simulated, "fifth").judge(open_),
        stated(AtLeast(0), "data", simulated, "sixth").judge(yes),
    ]
    assert outcomes_of_sentences(verdicts) == {"both": "mixed", "third": "undecided", "fourth": "undecided"}
    assert tally_of_sentences(verdicts) == (
        "3 sentences: 1 mixed, 2 undecided; "
        "5 statements: 2 supported, 1 contradicted, 1 undecided, 1 not evaluated; "
        "2 statements on the simulation alone: 1 supported, 1 undecided"
    )
    # Realizations decide, unless they do not evaluate a statement.
    later = [stated(AtLeast(0), name="third").judge(no), stated(AtLeast(0), both, name="first").unevaluated("no run")]
    together = combined([verdicts, later])
    assert [verdict.name for verdict in together] == [verdict.name for verdict in verdicts]
    assert outcomes_of_sentences(together) == {"both": "mixed", "third": "contradicted", "fourth": "undecided"}
    write_claims(verdicts, tmp_path, "run")
    text = (tmp_path / CLAIMS_MARKDOWN).read_text()
    assert tally_of_sentences(verdicts) in text.splitlines()
    assert "| fifth (simulation alone) | this and that [both] |" in text
    console = Console(record=True, width=200)
    show_verdicts(verdicts, "run", console)
    shown = console.export_text()
    assert tally_of_sentences(verdicts) in shown
    assert shown.count("(simulation alone)") == 2


def test_what_is_missing_is_said():
    alone = ratio_near_one.evaluate({"ours": Run("a", 1.0)}, ROLES)
    assert (alone.verdict, alone.reason, alone.measured) == ("not evaluated", "needs a run of theirs", None)
    zero = evaluate(1.0, 0.0)
    assert (zero.verdict, zero.reason, zero.runs) == ("not evaluated", "theirs is zero", ("a", "b"))


@pytest.mark.parametrize(
    ("value", "uncertainty", "text"),
    [
        (0.123456, None, "0.123"),
        (0.0, 0.0, "0"),
        (0.99531, 0.0034, "0.9953 ± 0.0034"),
        (-0.000658, 9.7e-5, "-0.000658 ± 0.000097"),
        (0.7, 0.4, "0.70 ± 0.40"),
        (10.0, 0.996, "10.00 ± 1.00"),
        (176.2, 86.7, "176 ± 87"),
        (5809.3, 892.1, "5809 ± 892"),
        (3.5741e6, 8.34e5, "3.57e+06 ± 8.3e+05"),
        (123456.0, 10.0, "1.23456e+05 ± 10"),
        (-123456.0, 4e6, "-1e+05 ± 4.0e+06"),
        (1.0, float("nan"), "1 (error not known)"),
        (3.0, float("inf"), "3 (error not known)"),
        (float("inf"), 1.0, "inf ± 1.0"),
    ],
)
def test_a_number_has_the_digits_that_its_uncertainty_leaves_meaning_to(value, uncertainty, text):
    assert number(value, uncertainty) == text


def test_json_reads_back_and_markdown_and_terminal_have_everything(tmp_path: Path):
    verdicts = [evaluate(1.0, 4.0), evaluate(1.0, 1.0), evaluate(1.0, 0.0)]
    assert from_json(to_json(verdicts)) == verdicts
    told = "1 sentence: 1 mixed; 3 statements: 1 supported, 1 contradicted, 1 not evaluated"
    assert tally_of_sentences(verdicts) == told
    text = to_markdown(verdicts, "title", ("claim", "the paper"), told, notes=["a small sky"])
    assert {told, "## Results", "Stand-in: a small sky."} <= set(text.splitlines())
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(rows) == 2 + len(verdicts)
    assert {line.replace("\\|", "").count("|") for line in rows} == {7}
    console = Console(record=True, width=160)
    show_verdicts(verdicts, "run", console, summary=told)
    shown = console.export_text()
    assert all(part in shown for part in (told, measured(verdicts[0]), "theirs is zero", "ratio"))
    write_claims(verdicts, tmp_path, "run")
    assert from_json((tmp_path / CLAIMS_JSON).read_text()) == verdicts
    assert (tmp_path / CLAIMS_MARKDOWN).read_text().startswith("# Claims of the paper: run\n")


def test_verdicts_with_several_solvers_are_side_by_side(tmp_path):
    columns = {
        "paper's": [evaluate(1.0, 4.0), evaluate(1.0, 0.0), evaluate(1.0, 0.0)],
        "ours": [evaluate(1.0, 1.0), evaluate(1.0, 1.0), evaluate(1.0, 0.0)],
    }
    write_claims_by_solver(columns, tmp_path, "both", ["a small sky"])
    # What neither could be evaluated on is left out.
    first, second = json.loads((tmp_path / BY_SOLVER_JSON).read_text())
    assert (first["name"], first["threshold"], first["quantity"]) == ("ratio-near-one", "from 0.5 to 2", "ratio")
    assert {name: (item["measured"], item["verdict"]) for name, item in first["solvers"].items()} == {
        "paper's": (0.25, "contradicted"),
        "ours": (1.0, "supported"),
    }
    assert second["solvers"]["paper's"]["reason"] == "theirs is zero"
    lines = (tmp_path / BY_SOLVER_MARKDOWN).read_text().splitlines()
    assert "- paper's: 1 sentence: 1 contradicted; 2 statements: 1 contradicted, 1 not evaluated" in lines
    assert "The verdict differs: ratio-near-one." in lines
    assert "Stand-in: a small sky." in lines
    headings, _, row, other = (line.replace("\\|", "").split(" | ") for line in lines if line.startswith("| "))
    assert headings[2:] == ["measured is", "must be", "paper's", "", "ours", " |"]
    assert row[3:] == ["from 0.5 to 2", "**0.25 ± 0.10**", "contradicted", "**1.00 ± 0.10**", "supported |"]
    assert other[4:6] == ["-", "not evaluated"]


def test_published_verdicts_can_be_read():
    published = sorted((Path(__file__).parents[2] / "figures").glob(f"*/{CLAIMS_JSON}"))
    assert published
    for path in published:
        verdicts = from_json(path.read_text())
        assert json.loads(to_json(verdicts)) == json.loads(path.read_text())


def test_a_table_has_its_cells_in_markdown_and_on_the_terminal():
    headings, rows = ("engine", "seconds"), [("dense, double", "0.1"), ("pyuvsim, double", "5")]
    table = Table(headings, rows, "title")
    lines = table.markdown().splitlines()
    assert lines[0] == "| engine | seconds |"
    assert lines[3] == "| pyuvsim, double | 5 |"
    console = Console(record=True, width=80)
    table.show(console)
    assert "dense, double" in console.export_text()
