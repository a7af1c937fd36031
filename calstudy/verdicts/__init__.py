"""Criteria for numbers: thresholds, verdicts, statements of a paper, and tables of them."""
