"""Where taxels sit, as numbers."""
