"""The mutations of `mutations.py` can be made: their texts are in the package, once each."""

import pytest
from mutations import MUTATIONS


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.name)
def test_a_mutation_has_a_place(mutation):
    assert mutation.place().is_file()
    assert mutation.old != mutation.new
