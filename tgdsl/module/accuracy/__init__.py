"""Errors of readings: against a finer variant, against the kinds' float64 reference, and which alternatives there are."""
