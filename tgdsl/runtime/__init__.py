"""Simulators and hardware that feed a module, and what shows its readings."""
