"""USD stages, imported as MJCF."""
