"""Modes of vibration of solid bodies: what they are, and where they come from."""
