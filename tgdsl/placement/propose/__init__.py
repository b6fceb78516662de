"""A proposed layout for a robot that has none."""
