"""Microphone: what a point hears of all sources of sound, later and fainter the farther they are."""
