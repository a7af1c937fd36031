"""What a file can ask for: an experiment, a sweep, a collection, a run-time study."""
