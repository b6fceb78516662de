"""Imperfections of sensors: the knobs (`spec`), what they do (`stages`), and the numbers they draw (`random`)."""

from tgdsl.sensors.noise.spec import BASE, FORCE, PROBE, PROFILES, TAXEL, Knobs, NoiseField, NoiseSpec, built_in, resolve_noise

__all__ = ["BASE", "FORCE", "PROBE", "PROFILES", "TAXEL", "Knobs", "NoiseField", "NoiseSpec", "built_in", "resolve_noise"]
