"""Observations: features of a policy, computed from readings and joints."""
