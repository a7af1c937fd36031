"""Measured data: reading, selecting, halves that share the sky, their noise, and how well a calibration fits them."""
