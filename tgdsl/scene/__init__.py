"""The compiled scene that an artefact carries."""
