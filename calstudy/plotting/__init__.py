"""Common parts of figures: the journal style, panels, axes of baseline length and delay, and files."""
