"""Force taxels: the solver's contact forces, shared out over the taxels near each contact."""
