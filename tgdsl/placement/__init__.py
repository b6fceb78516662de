"""Placement of taxels on a robot's links."""
