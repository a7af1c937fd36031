"""The products of an experiment: what each is made from, what it costs, and how it is made."""
