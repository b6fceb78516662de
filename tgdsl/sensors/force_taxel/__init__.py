"""Force taxel: the solver's contact forces, distributed over the taxels near each contact. See `kind`."""
