"""One page about a run: its setup, its progress and its results."""
