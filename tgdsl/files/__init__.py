"""Files: where they are, written whole or not at all, and what is kept of earlier work."""
