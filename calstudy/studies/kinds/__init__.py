"""The built-in kinds of study, a file each."""
