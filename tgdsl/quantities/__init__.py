"""Quantities that kinds request of a scene, one folder each."""
