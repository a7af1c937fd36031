"""Solvers of the calibration problem, one file each."""
