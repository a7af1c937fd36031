"""One page about a run: what was studied, how it went, what came out."""
