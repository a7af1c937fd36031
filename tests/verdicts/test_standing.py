"""Which calibrators of a comparison can be trusted, from scores that are made up."""

import math

import pytest

from calstudy.calibrate import records
from calstudy.verdicts import standing
from calstudy.verdicts.standing import advice, standing_table, standings, why_not_measured

WORLDS = ("ideal", "sources missing")


def case(bias, error, transfer=0.8, transfer_error=0.01):
    names = ("transfer", "transfer_error", "bias", "bias_error")
    return {"bands": [{"k": [0.1, 0.2], **dict(zip(names, (transfer, transfer_error, bias, error), strict=True))}]}


def standing_of(*cases, limit=0.1, refusals=()):
    scores = {world: {} if found is None else {"name": found} for world, found in zip(WORLDS, cases, strict=False)}
    (found,) = standings(scores, refusals, limit)
    return found


@pytest.mark.parametrize(
    ("bias", "error", "expected"),
    [
        (0.0, 0.01, "passes"),
        (0.07, 0.01, "passes"),
        # |bias| + 2 sigma is the limit and a little more.
        (0.08, 0.0101, "open"),
        (0.0, 0.06, "open"),
        (0.5, 0.21, "open"),
        (0.5, 0.19, "fails"),
        # Power that is missing is as wrong as power that is too much.
        (-0.5, 0.1, "fails"),
        (None, None, "open"),
    ],
)
def test_a_bias_is_below_the_limit_above_it_or_cannot_be_told(bias, error, expected):
    assert standing_of(case(bias, error)).standing == expected


def test_solves_that_did_not_converge_are_said_beside_the_numbers():
    cases = [{**case(0.0, 0.01), "by_status": {"converged": 2, **more}} for more in ({}, {"stalled": 1, "failed": 1})]
    assert str(standing_of(*cases)).endswith("T ≥ 0.80, 2 of 6 solves not converged")
    assert str(standing_of(cases[0])).endswith("T ≥ 0.80")


def test_what_is_kept_is_no_more_than_the_linear_response_says():
    """T by injection depends on where two fits stop, in either direction, and the linear response does not."""
    kept = {}
    for linear in (None, 0.6, 0.795, 0.9):
        found = case(0.0, 0.01)
        found["bands"][0]["linear_transfer"] = linear
        kept[linear] = standing_of(found, case(0.0, 0.01, transfer=0.85)).transfer
    # Within the error of T they are the same.
    assert kept == {None: 0.8, 0.6: 0.6, 0.795: 0.8, 0.9: 0.8}


def test_what_removes_the_eor_with_all_else_does_not_pass():
    """It has no bias, and nothing is left to be measured."""
    assert standing_of(case(0.0, 0.001, transfer=0.01)).standing == "fails"
    assert str(standing_of(case(0.0, 0.001, transfer=0.01))) == "fails in ideal (T 0.01)"
    assert standing_of(case(0.0, 0.01, transfer=0.04)).standing == "passes"
    assert "take" not in " ".join(advice(standings({"w": {"name": case(0.0, 0.001, transfer=0.0)}})))


def test_numbers_of_solves_that_all_stalled_do_not_pass():
    found = standing_of({**case(0.0, 0.001), "by_status": {"stalled": 4}})
    assert found.standing == "open"
    assert str(found).endswith("4 of 4 solves not converged; no solve converged there")
    assert standing_of({**case(0.0, 0.001), "by_status": {"stalled": 3, "converged": 1}}).standing == "passes"


def test_the_worst_world_decides_and_is_named():
    good, bad = case(0.0, 0.01), case(44.0, 9.0)
    assert standing_of(good, good).standing == "passes"
    assert str(standing_of(good, bad)) == "fails in sources missing (bias 44)"
    found = standing_of(case(0.0, 0.05), good)
    assert str(found) == "open in 1 of 2 worlds: bias < 0.1, T ≥ 0.80; errors 1.5 times smaller would tell"


def test_errors_that_are_smaller_by_the_stated_factor_tell():
    found = standing_of(case(0.05, 0.05))
    assert found.standing == "open"
    # The bias of a calibrator without one is about its error.
    assert standing_of(case(0.05 / 1.5001, 0.05 / 1.5001)).standing == "passes"


def test_factors_that_are_out_of_reach_are_not_named():
    assert str(standing_of(case(1e5, 1e8))).endswith("errors would have to be over 1000 times smaller")


def test_what_cannot_work_in_any_of_the_worlds_fails():
    (found, other) = standings({"w": {"name": case(0.0, 0.01)}}, [("w", "other", "no"), ("elsewhere", "third", "no")])
    assert (found.standing, other.calibrator, other.standing) == ("passes", "other", "fails")
    assert str(other) == "fails in w (cannot work)"


def test_the_number_for_which_a_calibrator_fails_is_named():
    # T is within two errors of what a solution can have.
    assert str(standing_of(case(5.0, 0.1, transfer=1.25, transfer_error=0.1))) == "fails in ideal (bias 5)"
    assert str(standing_of(case(5.0, 0.1, transfer=None))) == "fails in ideal (bias 5)"


def test_an_error_that_is_not_known_is_said():
    found = standing_of(case(5.0, None))
    assert found.standing == "open"
    assert "bias or its error not known" in str(found)
    assert "nan" not in str(found)


def test_what_is_no_solution_fails_though_its_bias_is_small():
    assert standing_of(case(0.0, 0.01, transfer=-155.0, transfer_error=10.0)).standing == "fails"
    assert standing_of(case(0.0, 0.01, transfer=1.3, transfer_error=0.2)).standing == "open"
    assert str(standing_of(case(0.0, 0.01), case(0.0, 0.01, transfer=3.0))) == "fails in sources missing (T 3)"


def test_a_calibrator_that_cannot_work_in_a_world_fails_there():
    found = standing_of(case(0.0, 0.01), None, refusals=[("sources missing", "name", "no redundant baselines")])
    assert str(found) == "fails in sources missing (cannot work)"
    found = {"name": case(0.0, 0.01)}
    (_, nowhere) = standings({"a": found, "b": found}, [(world, "other", "why") for world in "ab"])
    assert (nowhere.standing, str(nowhere)) == ("fails", "cannot work in any world")


def test_a_limit_of_ones_own_changes_the_answer():
    cases = case(0.2, 0.02), case(0.1, 0.02)
    assert standing_of(*cases, limit=0.3).standing == "passes"
    assert standing_of(*cases, limit=0.1).standing == "fails"


def test_the_answer_ranks_those_that_pass_by_t():
    scores = {
        "ideal": {
            "low": case(0.0, 0.01, 0.4),
            "high": case(0.0, 0.01, 0.9),
            "noisy": case(0.0, 0.1, 0.95),
            "biased": case(5.0, 0.1),
        }
    }
    found = standings(scores)
    assert advice(found) == [
        "Bias below 0.1 of the EoR in the world?",
        "k 0.1 to 0.2 h/Mpc: take high (bias < 0.02, T ≥ 0.90); no bias is seen; "
        "others that pass: low (bias < 0.02, T ≥ 0.40); "
        "open: noisy (bias < 0.2, T ≥ 0.95); 1 of 4 fail",
    ]
    assert advice([entry for entry in found if entry.calibrator == "biased"])[1:] == [
        "k 0.1 to 0.2 h/Mpc: no calibrator passes; 1 of 1 fail"
    ]
    rows = {row[0]: row[1] for row in standing_table(found).rows}
    assert rows["biased"] == "fails in ideal (bias 5)"
    assert math.isclose(found[0].upper_limit, 0.02)


def test_integrations_without_data_are_not_solves_that_failed():
    solved = {**case(0.0, 0.01, 0.9), "by_status": {"skipped": 4, "converged": 3, "stalled": 1}}
    assert "1 of 4 solves not converged" in standings({"w": {"one": solved}})[0].numbers


def test_a_small_bias_that_is_known_well_is_seen_beside_a_larger_one_that_may_be_noise():
    scores = {"noisy": {"one": case(0.03, 0.02, 0.9)}, "quiet": {"one": case(0.025, 0.002, 0.9)}}
    _, sentence = advice(standings(scores))
    assert "a bias is seen in quiet (0.025)" in sentence


def test_the_advice_names_what_breaks_a_calibrator_first_and_what_keeps_more_but_fails_in_few_worlds():
    scores = {
        "ideal": {"safe": case(0.0, 0.01, 0.4), "bold": case(0.0, 0.01, 0.7), "poor": case(5.0, 0.1, 0.9)},
        "sources missing": {"safe": case(0.03, 0.005, 0.4), "bold": case(0.5, 0.01, 0.6), "poor": case(9.0, 0.1, 0.9)},
    }
    _, sentence = advice(standings(scores))
    assert sentence == (
        "k 0.1 to 0.2 h/Mpc: take safe (bias < 0.04, T ≥ 0.40); a bias is seen in sources missing (0.03); "
        "bold keeps more (T ≥ 0.60), but fails in sources missing (bias 0.5); 2 of 3 fail"
    )


@pytest.mark.parametrize(
    ("transfer", "error", "reason"),
    [
        (0.8, 0.29, ""),
        (0.8, 0.31, "error 0.31"),
        (-0.09, 0.01, ""),
        (1.21, 0.01, "T 1.2"),
        (6178.0, 3394.0, "error 3.4e+03"),
        (math.nan, math.nan, "no modes"),
        (None, None, "no modes"),
    ],
)
def test_a_transfer_is_measured_if_it_is_a_part_of_the_signal_and_well_known(transfer, error, reason):
    """The first run on HERA's file printed 6178 +- 3394 as a result."""
    assert why_not_measured(transfer, error) == reason


def test_nothing_passes_whose_signal_loss_is_not_known():
    found = standing_of(case(0.0, 0.01, transfer=0.5, transfer_error=0.4))
    assert str(found) == "open in 1 of 1 worlds: bias < 0.02, T not measured; T is not measured there"


def test_the_smallest_t_is_not_said_of_worlds_where_it_is_not_measured():
    unknown = case(0.0, 0.01, transfer=0.3, transfer_error=0.4)
    found = standing_of(case(0.0, 0.01, transfer=0.8), unknown)
    told = "open in 1 of 2 worlds: bias < 0.02, T ≥ 0.80 where measured, 1 of 2 worlds; T is not measured there"
    assert str(found) == told
    # The same where a calibrator fails, or cannot work, in the other world.
    for lost, reason in ((case(9.0, 0.1, transfer=-0.5), "T -0.5"), (None, "cannot work")):
        failed = standing_of(case(0.0, 0.01, transfer=0.8), lost, refusals=[("sources missing", "name", "why")])
        assert advice([failed])[1] == (
            "k 0.1 to 0.2 h/Mpc: no calibrator passes; "
            f"name (T ≥ 0.80 where measured, 1 of 2 worlds) fails in sources missing ({reason})"
        )
    assert "where" not in str(standing_of(case(0.0, 0.01), case(0.0, 0.01)))


def test_worlds_that_decide_begin_with_the_refused_and_those_without_a_known_bias():
    biases = {"a": 1.0, "b": None, "c": 3.0, "d": None, "e": 2.0}
    scores = {world: {"name": case(bias, 0.01, transfer=5.0)} for world, bias in biases.items()}
    (found,) = standings({**scores, "f": {}}, [("f", "name", "no")])
    assert "".join(world.world for world in found.decisive) == "fbdcea"


def test_solves_are_settled_by_the_statuses_of_calibrations():
    assert standing.SETTLED == records.SETTLED
