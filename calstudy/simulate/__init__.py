"""Simulation of visibilities: the engines, and the approximations that limit their accuracy."""
