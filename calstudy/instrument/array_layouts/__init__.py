"""The built-in layouts of arrays, a file each, or a file for the layouts of one observatory."""
