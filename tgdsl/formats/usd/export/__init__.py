"""Robots out, as USD."""
