"""The power spectrum estimators, one in each module."""
