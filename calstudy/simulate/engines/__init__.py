"""The simulators of visibilities."""
