"""What a file can ask for: an experiment, a sweep, realizations, a collection, a run-time study."""
