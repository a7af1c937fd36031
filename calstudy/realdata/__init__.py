"""Measured data: settings, reading, the two halves that share the sky, their noise, and how well a calibration fits."""
