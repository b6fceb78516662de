"""Scenes, signals and states of oracles and hard cases."""
