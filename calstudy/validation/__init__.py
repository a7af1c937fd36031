"""The validation ladder: every stage of the chain proved against something that it cannot fool."""
