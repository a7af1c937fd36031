"""The effects on the data, one in each module."""
