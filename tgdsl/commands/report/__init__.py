"""Commands that tell of an installation."""
