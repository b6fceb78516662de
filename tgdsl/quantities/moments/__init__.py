"""Moments of objects' surfaces within each probe's radius."""
