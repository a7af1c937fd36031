"""Which integrations of a long run, or of a large array, are compared with the truth."""

import numpy as np
import pytest

from calstudy.instrument.settings import Channels, Size
from calstudy.products.agreement import integrations_compared, spread


@pytest.mark.parametrize(
    ("antennas", "times", "compared"),
    [(36, 1, 1), (36, 56, 56), (36, 112, 112), (36, 2000, 112), (128, 56, 8), (350, 56, 1), (2000, 3, 1)],
)
def test_as_much_is_compared_as_of_twice_the_papers_run(antennas, times, compared):
    channels = Channels.model_construct(first=167e6, width=80e3, count=384)
    assert integrations_compared(Size(antennas, times, channels, 1, 100.0, 50.0)) == compared


@pytest.mark.parametrize("count", [1, 56])
def test_a_short_run_is_compared_whole(count):
    places = np.arange(3, 3 + count)
    np.testing.assert_array_equal(spread(places, count), places)


def test_a_long_run_is_compared_from_its_start_to_its_end():
    places = 2 * np.arange(1000)
    chosen = spread(places, 112)
    assert (len(chosen), chosen[0], chosen[-1]) == (112, 0, 1998)
    # At equal distances to one place.
    assert np.ptp(np.diff(chosen)) <= 2


def test_of_nothing_nothing_is_chosen():
    assert spread(np.arange(0), 5).size == 0
