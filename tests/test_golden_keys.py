"""The published experiments make the same products as before."""

from golden_keys import now, read


def test_keys_and_plans_of_the_published_experiments_are_those_of_the_table():
    before, after = read(), now()
    changed = [address for address in {**after, **before} if before.get(address) != after.get(address)]
    first = dict(reversed([(name, stage) for name, stage in changed]))
    told = ", ".join(f"{name} from stage {stage}" for name, stage in sorted(first.items()))
    assert not changed, (
        f"keys or costs changed in {told}; if that is meant (a version, a default or a setting of a stage changed), "
        "write the table again with 'python tests/golden_keys.py'"
    )
