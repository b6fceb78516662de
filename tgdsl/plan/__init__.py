"""The Plan: everything that is to be computed, as immutable data."""
