"""The products of an experiment: the inputs of each, its cost, and the function that makes it."""
