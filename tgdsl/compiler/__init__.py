"""From documents and robots to Plans and modules."""
