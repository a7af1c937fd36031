"""The effects on the data, in families: gains, flags, added signals."""
