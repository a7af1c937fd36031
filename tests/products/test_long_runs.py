"""Which integrations of a long run are compared with the truth."""

import numpy as np
import pytest

from calstudy.products.agreement import MOST_INTEGRATIONS, spread


@pytest.mark.parametrize("count", [1, 56, MOST_INTEGRATIONS])
def test_a_short_run_is_compared_whole(count):
    places = np.arange(3, 3 + count)
    np.testing.assert_array_equal(spread(places, MOST_INTEGRATIONS), places)


def test_a_long_run_is_compared_from_its_start_to_its_end():
    places = 2 * np.arange(1000)
    chosen = spread(places, MOST_INTEGRATIONS)
    assert (len(chosen), chosen[0], chosen[-1]) == (MOST_INTEGRATIONS, 0, 1998)
    # At equal distances to one place.
    assert np.ptp(np.diff(chosen)) <= 2


def test_of_nothing_nothing_is_chosen():
    assert spread(np.arange(0), MOST_INTEGRATIONS).size == 0
