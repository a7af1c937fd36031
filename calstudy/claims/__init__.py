"""The sentences of the paper as checks: each measures a number from the tables of a run and says PASS or FAIL."""
