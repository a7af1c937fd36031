"""What an experiment makes: products, what each is made from, and what each costs."""
