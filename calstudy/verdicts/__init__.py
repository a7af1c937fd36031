"""Numbers held against criteria: thresholds, verdicts, statements of a paper, and the tables that list them."""
