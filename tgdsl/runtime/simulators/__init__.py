"""What simulators of a module's scene have in common."""
