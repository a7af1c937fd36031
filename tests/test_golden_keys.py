"""The published experiments make the same products as before."""

from golden_keys import now, read

WITH_OPTIONAL_PACKAGES = {"peers"}


def test_keys_and_plans_of_the_published_experiments_are_those_of_the_table():
    before, after = read(), now()
    names = {name for name, _ in after}
    left_out = {name for name, _ in before} - names
    assert names
    assert left_out <= WITH_OPTIONAL_PACKAGES
    before = {(name, stage): line for (name, stage), line in before.items() if name in names}
    changed = [address for address in {**after, **before} if before.get(address) != after.get(address)]
    first = dict(reversed([(name, stage) for name, stage in changed]))
    told = ", ".join(f"{name} from stage {stage}" for name, stage in sorted(first.items()))
    assert not changed, (
        f"keys or costs changed in {told}; if that is meant (a version, a default or a setting of a stage changed), "
        "write the table again with 'python tests/golden_keys.py'"
    )
