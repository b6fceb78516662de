"""What to compute, with nothing left to decide."""
