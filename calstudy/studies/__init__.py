"""The kinds of study: an experiment, a sweep, realizations, a collection, a comparison, run times, measured data."""
