"""Experiment files: their schema, how they are read, and how their errors are reported."""
