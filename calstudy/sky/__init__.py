"""Skies: foreground sources from catalogues or source counts, and fields of the 21 cm signal."""
