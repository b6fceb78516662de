"""The Layout: the taxels of a robot at one resolution, as arrays."""
