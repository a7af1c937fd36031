"""Timings of engines, calibrators and solvers, and the scaling laws that are fitted to them."""
