"""Robots in and out: MJCF, URDF, USD."""
