"""The sky: foreground sources from catalogues or source counts, diffuse emission, and the 21 cm signal."""
