"""Scenes, signals and states that oracles and hard cases are computed on."""
