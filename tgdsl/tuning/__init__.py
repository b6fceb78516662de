"""Sensors' fields chosen by measured error: what `accuracy` in a document means, on states of its scene."""
