"""What the steps of the validation ladder measure: one module each, with its parameters, what it reads, and how."""
