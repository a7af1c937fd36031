"""Calibration of measured data: reading, selection, output."""
