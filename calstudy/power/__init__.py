"""Delay power spectra: estimators, error bars, averages over cylinders and spheres, and their cosmology."""
