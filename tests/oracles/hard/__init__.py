"""Numerical hard cases of all kinds: risks, and errors of modules against their kinds' float64 definitions."""
