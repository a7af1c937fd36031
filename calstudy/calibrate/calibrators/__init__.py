"""The calibrators: one module each, found by its name."""
