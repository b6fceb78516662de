"""Robots and scenes as USD."""
