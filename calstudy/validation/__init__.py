"""The validation ladder: every stage of the chain tested against a known answer."""
