"""The measurements of the steps of the validation ladder, one in each module."""
