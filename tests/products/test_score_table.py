"""What the table of a comparison says of a calibrator."""

import pytest

from calstudy.products.comparison import score_table


def scores_of(transfer, error, **others):
    """Return scores in one band, with the processor time and the memory not known."""
    band = {"k": [0.1, 0.2], "transfer": transfer, "transfer_error": error, "bias": 0.0, "bias_error": 0.1, **others}
    scores = dict.fromkeys(("flux_scale", "gain_error_aligned", "gain_error_as_fitted", "held_out_chi_squared"))
    costs = {"cpu_seconds_per_integration": None, "peak_memory": None}
    return scores | costs | {"bands": [band], "by_status": {"converged": 1}}


def test_a_table_has_no_processor_time_of_scores_that_do_not_tell():
    scores = scores_of(0.5, 0.5)
    new = scores | {"cpu_seconds_per_integration": 0.123, "peak_memory": 2e9}
    old = scores | {"seconds_per_integration": 4.5, "peak_memory": 2e9}
    by_file = scores | {"cpu_seconds_per_integration": None, "peak_memory": None}
    table = score_table({"new": new, "old": old, "by file": by_file})
    place = table.columns.index("CPU s per integration")
    assert table.columns[place + 1] == "memory"
    assert [row[place] for row in table.rows] == ["0.12", "-", "-"]
    assert [row[place + 1] for row in table.rows] == ["2.0 GB", "2.0 GB", "-"]


@pytest.mark.parametrize(
    ("scores", "cell"),
    [
        (scores_of(0.42, 0.011, cross_transfer=0.425, linear_transfer=0.36), "0.420 ± 0.011 (linear 0.36)"),
        (scores_of(0.70, 0.011, cross_transfer=0.82, linear_transfer=0.70), "0.700 ± 0.011 (C 0.82)"),
        (scores_of(0.70, 0.011, cross_transfer=0.82, linear_transfer=0.66), "0.700 ± 0.011 (C 0.82, linear 0.66)"),
        (scores_of(0.70, 0.011, cross_transfer=None), "0.700 ± 0.011"),
        (scores_of(0.70, 0.40, cross_transfer=0.0), "not measured (0.70 ± 0.40)"),
        (scores_of(None, None, cross_transfer=None), "-"),
    ],
)
def test_t_has_beside_it_what_differs_from_it_by_more_than_its_error(scores, cell):
    assert score_table({"one": scores}).rows[0][1] == cell
