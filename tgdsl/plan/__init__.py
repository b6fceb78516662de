"""The Plan: the whole computation as immutable data."""
