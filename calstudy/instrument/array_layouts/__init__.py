"""The built-in layouts of arrays, by shape, of observatories, and from files."""
