"""A first layout for a robot that nobody has described."""
