"""Scenes as an artefact carries them."""
