"""Regression: whether a study, made again, still gives the reference results that are kept of it."""
