"""Regression: check that a study, made again, still gives its reference results."""
