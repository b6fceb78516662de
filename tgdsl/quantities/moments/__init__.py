"""Moments of objects' surfaces about each probe."""
