"""An edit that may change results raises a version, or says why they stay."""

from source_table import compare, read


def test_no_code_that_makes_products_changed_without_a_new_version_or_a_reason():
    table, faults = compare()
    changed = [module for module, row in table[1].items() if read()[1].get(module, row)[0] != row[0]]
    assert (table, faults) == (read(), []), (
        f"{faults or changed or 'stages or modules are new or gone'}: raise the version of every stage or plug-in "
        "whose results change and run 'python tests/source_table.py', or run it with a sentence: why results stay"
    )
